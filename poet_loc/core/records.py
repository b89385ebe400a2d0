"""Frozen records that the stages hand to each other: columns of equal length, SI units, radians.

Stamps are int64 nanoseconds. `T_a_b` maps coordinates of b into a.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


class _Table:
    """Equal-length columns that are selected together."""

    def __len__(self) -> int:
        return len(self.stamps_ns)  # type: ignore[attr-defined]

    def __getitem__(self, index: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        columns = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        picked = {name: None if column is None else column[index] for name, column in columns.items()}
        return replace(self, **picked)  # type: ignore[type-var]


@dataclass(frozen=True)
class ObjectPoses(_Table):
    """What the pose sensor saw: one row per detection, sorted by stamp."""

    stamps_ns: Stamps
    frames: NDArray[np.int64]
    object_ids: NDArray[np.int64]
    instances: NDArray[np.int64]
    scores: Array
    T_cam_obj: RigidTransform
    covariances: Array | None = None
    """(N, 6, 6) of [e_r, e_t] in camera axes: R_measured = Exp(e_r) R_true, t_measured = t_true + e_t;
    rad^2, m^2; a row of NaN where a detection brings none."""


@dataclass(frozen=True)
class CameraPoses(_Table):
    """Camera poses from the solver or from elsewhere, one row per frame, sorted by stamp."""

    stamps_ns: Stamps
    frames: NDArray[np.int64]
    T_world_cam: RigidTransform
    covariances: Array | None = None
    """(N, 6, 6) of [e_r, e_t] with R = R_true Exp(e_r) and t = t_true + e_t; rad^2, m^2."""


@dataclass(frozen=True)
class ImuSamples(_Table):
    """IMU samples: angular velocity (N, 3) rad/s and specific force (N, 3) m/s^2 in imu axes."""

    stamps_ns: Stamps
    angular_velocity: Array
    specific_force: Array


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: fx, fy, cx, cy in pixels, distortion by name, (width, height)."""

    intrinsics: tuple[float, float, float, float]
    distortion_model: str = "none"
    distortion_coeffs: tuple[float, ...] = ()
    resolution: tuple[int, int] | None = None


@dataclass(frozen=True)
class ImuNoise:
    """Continuous-time noise densities of an IMU (Kalibr's names and units)."""

    gyroscope_noise_density: float
    """rad/s/sqrt(Hz)"""
    accelerometer_noise_density: float
    """m/s^2/sqrt(Hz)"""
    gyroscope_random_walk: float
    """rad/s^2/sqrt(Hz)"""
    accelerometer_random_walk: float
    """m/s^3/sqrt(Hz)"""
    update_rate: float
    """Hz"""


@dataclass(frozen=True)
class Calibration:
    """Camera, IMU and what lies between them."""

    T_cam_imu: RigidTransform | None = None
    timeshift_cam_imu_s: float = 0.0
    """t_imu = t_cam + timeshift_cam_imu (Kalibr's sign)."""
    camera: Camera | None = None
    imu: ImuNoise | None = None

    @property
    def timeshift_ns(self) -> int:
        """What turns a camera stamp into an IMU stamp."""
        return round(self.timeshift_cam_imu_s * 1e9)


@dataclass(frozen=True)
class Symmetry:
    """Rotations about an axis through the object's origin that leave its looks unchanged."""

    axis: tuple[float, float, float]
    """Unit vector in object axes."""
    order: int | Literal["continuous"]
    """n: turns by 2 pi / n; "continuous": every turn."""


@dataclass(frozen=True)
class Landmark:
    """An object whose pose in the world is known."""

    object_id: int
    T_world_obj: RigidTransform
    instance: int = 0
    name: str = ""
    covariance: Array | None = None
    """(6, 6) of xi with T_true = T_world_obj Exp(xi), [rotation, translation] in object axes; None: exact."""
    symmetry: Symmetry | None = None

    @property
    def key(self) -> tuple[int, int]:
        """The (object_id, instance) pair that names a landmark."""
        return self.object_id, self.instance


@dataclass(frozen=True)
class LandmarkMap:
    """The landmarks of one world, each (object_id, instance) once."""

    landmarks: tuple[Landmark, ...] = field(default_factory=tuple)

    def __len__(self) -> int:
        return len(self.landmarks)

    def __iter__(self):  # type: ignore[no-untyped-def]
        return iter(self.landmarks)

    @property
    def object_ids(self) -> NDArray[np.int64]:
        """(L,) object id of each landmark."""
        return np.array([landmark.object_id for landmark in self.landmarks], dtype=np.int64)

    @property
    def T_world_obj(self) -> RigidTransform:
        """L stacked poses, in the order of the landmarks."""
        return RigidTransform.concatenate([landmark.T_world_obj for landmark in self.landmarks])
