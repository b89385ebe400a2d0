"""What an estimator has found out beside the trajectory: extrinsics, time offset, gravity, the map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from fusion.memory import Memory
from fusion.nav_state import EXTRINSIC_ROTATION, GRAVITY, OBJECT_SIZE, OBJECTS, TIME_OFFSET, pose_at
from fusion.prepare import Problem
from poet_loc.core.records import Calibration, Landmark, LandmarkMap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Calibrated:
    """The newest estimate of what `FuseOptions.estimate` switches on; None for what was taken as given."""

    T_imu_cam: RigidTransform | None = None
    extrinsic_covariance: Array | None = None
    """(6, 6) of [e_r, e_t] with R_true = R Exp(e_r), t_true = t + e_t of T_imu_cam; rad^2, m^2."""
    timeshift_cam_imu_s: float | None = None
    """t_imu = t_cam + timeshift_cam_imu: the calibration's and what was found beside it."""
    timeshift_sigma_s: float | None = None
    gravity: Array | None = None
    """(3,) in world axes, m/s^2."""
    gravity_sigma: float | None = None
    """1-sigma of its direction, rad, the larger of two."""
    landmark_map: LandmarkMap | None = None
    """Every landmark whose pose in the world is known by now, with its covariance."""

    @property
    def T_cam_imu(self) -> RigidTransform | None:
        """The extrinsics in Kalibr's direction."""
        return None if self.T_imu_cam is None else self.T_imu_cam.inv()

    def applied_to(self, calibration: Calibration) -> Calibration:
        """Return a calibration with what was found in it."""
        if self.T_imu_cam is not None:
            calibration = replace(calibration, T_cam_imu=self.T_cam_imu)
        if self.timeshift_cam_imu_s is not None:
            calibration = replace(calibration, timeshift_cam_imu_s=self.timeshift_cam_imu_s)
        return calibration

    def as_plain(self) -> dict[str, Any]:
        """Return what calibrated.json holds: values and 1-sigmas of all but the map, which is a file of its own."""
        found: dict[str, Any] = {}
        if self.T_imu_cam is not None and self.extrinsic_covariance is not None:
            sigma = np.sqrt(np.maximum(np.diag(self.extrinsic_covariance), 0.0))
            found["T_imu_cam"] = self.T_imu_cam.as_matrix().tolist()
            found["rotation_sigma_deg"] = np.degrees(sigma[:3]).tolist()
            found["translation_sigma_m"] = sigma[3:].tolist()
        if self.timeshift_cam_imu_s is not None:
            found["timeshift_cam_imu_s"], found["timeshift_sigma_s"] = self.timeshift_cam_imu_s, self.timeshift_sigma_s
        if self.gravity is not None and self.gravity_sigma is not None:
            tilt = math.hypot(self.gravity[0], self.gravity[1]), -float(self.gravity[2])
            found["gravity_m_s2"], found["gravity_tilt_deg"] = self.gravity.tolist(), math.degrees(math.atan2(*tilt))
            found["gravity_sigma_deg"] = math.degrees(self.gravity_sigma)
        return found


def calibrated(m: Memory, problem: Problem) -> Calibrated | None:
    """Read a filter's memory; None where nothing beside the trajectory was estimated."""
    layout, covariance = problem.layout, m.P
    found = Calibrated()
    if layout.extrinsics:
        part = layout.error_slice("extrinsics")
        found = replace(
            found,
            T_imu_cam=pose_at(m.x, EXTRINSIC_ROTATION),
            extrinsic_covariance=covariance[part, part].copy(),
        )
    if layout.time_offset:
        part = layout.error_slice("time_offset")
        found = replace(
            found,
            timeshift_cam_imu_s=problem.calibration.timeshift_cam_imu_s + float(m.x[TIME_OFFSET]),
            timeshift_sigma_s=math.sqrt(max(float(covariance[part, part].item()), 0.0)),
        )
    if layout.gravity:
        part = layout.error_slice("gravity")
        largest = float(np.linalg.eigvalsh(covariance[part, part])[-1])
        found = replace(found, gravity=m.x[GRAVITY : GRAVITY + 3].copy(), gravity_sigma=math.sqrt(max(largest, 0.0)))
    if layout.objects and problem.landmark_map is not None:
        landmarks = enumerate(problem.landmark_map)
        seen = tuple(_landmark(m, problem, k, landmark) for k, landmark in landmarks if m.known[k] > 0.0)
        found = replace(found, landmark_map=LandmarkMap(seen))
    estimated = layout.extrinsics or layout.time_offset or layout.gravity or layout.objects
    return found if estimated else None


def _landmark(m: Memory, problem: Problem, k: int, landmark: Landmark) -> Landmark:
    """The filter's position error is in world axes, a landmark's in its own."""
    T_world_obj = pose_at(m.x, OBJECTS + OBJECT_SIZE * k)
    part = problem.layout.error_slice("objects", k)
    to_object = block_diag(np.eye(3), T_world_obj.rotation.as_matrix().T)
    covariance = to_object @ m.P[part, part] @ to_object.T
    return replace(landmark, T_world_obj=T_world_obj, covariance=covariance)
