"""poet-loc convert euroc."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.io.convert_euroc import ConvertEurocOptions, convert_euroc


@dataclass(frozen=True)
class Arguments:
    """A EuRoC (ASL) sequence becomes a log: IMU, calibration, image stamps, ground truth."""

    mav: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAV0")]
    """The mav0 folder, or the one that holds it."""
    out: OutFolder
    options: Flat[ConvertEurocOptions] = field(default_factory=ConvertEurocOptions)


def execute(arguments: Arguments) -> None:
    """Convert and say what came out."""
    log = convert_euroc(arguments.mav, arguments.out, arguments.options)
    assert log.imu is not None
    frames = 0 if log.frames is None else len(log.frames)
    truth = "with" if log.T_world_imu is not None else "without"
    print(f"{arguments.out}: {len(log.imu)} IMU samples, {frames} images, {truth} ground truth")
