"""poet-loc convert kalibr."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.io.convert_kalibr import ConvertKalibrOptions, convert_kalibr


@dataclass(frozen=True)
class Arguments:
    """Kalibr's camchain and imu yaml become a log's calibration.yaml."""

    camchain: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAMCHAIN")]
    """camchain-imucam.yaml."""
    out: OutFolder
    """The log folder that gets calibration.yaml, or a .yaml file."""
    options: Flat[ConvertKalibrOptions] = field(default_factory=ConvertKalibrOptions)


def execute(arguments: Arguments) -> None:
    """Convert and say, in both directions, what the extrinsics are."""
    calibration = convert_kalibr(arguments.camchain, arguments.out, arguments.options)
    if calibration.T_cam_imu is not None:
        for name, T in (("T_cam_imu", calibration.T_cam_imu), ("T_imu_cam", calibration.T_cam_imu.inv())):
            t = ", ".join(f"{1e3 * value:.1f}" for value in T.translation)
            print(f"{name}: t = ({t}) mm, {T.rotation.magnitude() * 57.29577951:.2f} deg")
    print(f"timeshift_cam_imu: {calibration.timeshift_cam_imu_s:g} s (t_imu = t_cam + timeshift_cam_imu)")
