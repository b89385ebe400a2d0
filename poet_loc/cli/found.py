"""What an estimator found beside the trajectory, in words: 1-sigma, in whose axes, how far from what was given."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.calibrated import Calibrated
from poet_loc.cli.estimates import Estimates
from poet_loc.core.records import Calibration, LandmarkMap
from poet_loc.io.log_folder import Log

_ANCHOR_M = 1e-4  # the graph gives its anchor a least variance


def found_lines(estimates: Estimates) -> list[str]:
    """Return a line for each of extrinsics, time offset, gravity and map that each estimator was asked for."""
    return [
        f"{fused.name} found {line}"
        for fused in estimates.fused
        if fused.calibrated is not None
        for line in _lines(fused.calibrated, estimates.log)
    ]


def _lines(found: Calibrated, log: Log) -> Iterator[str]:
    given, told = log.calibration or Calibration(), found.as_plain()
    if "T_imu_cam" in told:
        yield _extrinsics(found, given, told)
    if "timeshift_cam_imu_s" in told:
        shift, sigma, was = told["timeshift_cam_imu_s"], told["timeshift_sigma_s"], given.timeshift_cam_imu_s
        yield f"timeshift_cam_imu {1e3 * shift:.1f} ms, 1-sigma {1e3 * sigma:.1f} ms, calibration {1e3 * was:.1f} ms"
    if "gravity_tilt_deg" in told:
        tilt, sigma = told["gravity_tilt_deg"], told["gravity_sigma_deg"]
        yield f"gravity {tilt:.2f} deg from the world's -z, 1-sigma {sigma:.2f} deg"
    if found.landmark_map is not None and len(found.landmark_map):
        yield _map(found.landmark_map, log.landmark_map)


def _extrinsics(found: Calibrated, given: Calibration, told: dict[str, Any]) -> str:
    place, turn = 1e3 * np.array(told["translation_sigma_m"]), np.array(told["rotation_sigma_deg"])
    line = f"T_cam_imu, 1-sigma {_three(place, 1)} mm in imu axes and {_three(turn, 2)} deg in camera axes"
    if given.T_cam_imu is None or found.T_imu_cam is None:
        return line
    return f"{line}, {_apart(found.T_imu_cam, given.T_cam_imu.inv())} from the calibration's"


def _map(found: LandmarkMap, given: LandmarkMap | None) -> str:
    R = np.array([landmark.covariance for landmark in found])
    turn, place = np.sqrt(np.einsum("nii->ni", R).reshape(-1, 2, 3).mean(axis=2)).T
    free = place > _ANCHOR_M
    line = f"{len(found)} of {len(given or found)} landmarks"
    if free.any():
        line += f", 1-sigma {_range(1e3 * place[free], 1)} mm and {_range(np.degrees(turn[free]), 2)} deg per axis"
    if len(free) - free.sum() == 1:
        anchor = found.landmarks[int(np.argmin(free))]
        line += f", {anchor.name or f'object {anchor.object_id}'} anchors the world"
    return line


def _apart(T: RigidTransform, other: RigidTransform) -> str:
    place = float(np.linalg.norm(T.translation - other.translation))
    return f"{1e3 * place:.1f} mm and {np.degrees((T.rotation.inv() * other.rotation).magnitude()):.2f} deg"


def _three(values: NDArray[np.float64], decimals: int) -> str:
    return " ".join(f"{value:.{decimals}f}" for value in values)


def _range(values: NDArray[np.float64], decimals: int) -> str:
    low, high = f"{values.min():.{decimals}f}", f"{values.max():.{decimals}f}"
    return low if low == high else f"{low} to {high}"
