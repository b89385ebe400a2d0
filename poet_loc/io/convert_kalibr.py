"""Kalibr's results become a log's calibration.yaml: camchain-imucam.yaml and imu.yaml, T_cam_imu or T_imu_cam."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration
from poet_loc.io.calibration_yaml import names_imu_cam, read_calibration, write_calibration


@dataclass(frozen=True)
class ConvertKalibrOptions:
    """Which of Kalibr's files become the calibration."""

    imu: Path | None = None
    """imu.yaml with the noise densities; without it the log's own stay, where it has them."""
    camera: str = "cam0"
    """Which camera of the chain: cam0, cam1, .."""
    holds: Literal["as named", "T_cam_imu", "T_imu_cam"] = "as named"
    """What the chain's transform is, where it is not what its key says; T_imu_cam is inverted."""
    overwrite: bool = False
    """Replace a calibration that is there."""


def convert_kalibr(camchain: str | Path, out: str | Path, options: ConvertKalibrOptions | None = None) -> Calibration:
    """Write OUT/calibration.yaml (or OUT itself, where it ends in .yaml) and return what it holds.

    Kalibr's T_cam_imu maps imu coordinates into cam, t_imu = t_cam + timeshift_cam_imu: both are kept.
    """
    options = options or ConvertKalibrOptions()
    out = Path(out)
    target = out if out.suffix in (".yaml", ".yml") else out / "calibration.yaml"
    calibration = read_calibration(camchain, options.camera)
    named = "T_imu_cam" if names_imu_cam(camchain, options.camera) else "T_cam_imu"
    if calibration.T_cam_imu is not None and options.holds not in ("as named", named):
        calibration = replace(calibration, T_cam_imu=calibration.T_cam_imu.inv())
    if options.imu is not None:
        noise = read_calibration(options.imu).imu
        if noise is None:
            raise InputError("has no noise densities of an IMU", path=options.imu, fix="give Kalibr's imu.yaml")
        calibration = replace(calibration, imu=noise)
    if target.exists():
        if not options.overwrite:
            raise InputError("is there already", path=target, fix="pass --overwrite or choose another place")
        calibration = replace(calibration, imu=calibration.imu or read_calibration(target).imu)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_calibration(target, calibration)
    return calibration
