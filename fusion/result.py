"""What an estimator returns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.health import RunHealth
from poet_loc.core.trajectory import Trajectory

if TYPE_CHECKING:
    from fusion.calibrated import Calibrated

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class GateLog:
    """What became of every measurement, in order of time."""

    stamps_ns: Stamps
    """(M,) on the IMU's clock."""
    object_ids: NDArray[np.int64]
    """(M,) -1 for camera poses."""
    instances: NDArray[np.int64]
    nis: Array
    """(M,) normalised innovation squared of all six rows; NaN before the start."""
    nis_position: Array
    """(M,) of the position rows alone."""
    nis_rotation: Array
    """(M,) of the rotation rows alone."""
    position_accepted: NDArray[np.bool_]
    rotation_accepted: NDArray[np.bool_]
    released: NDArray[np.bool_]
    """(M,) the object was off the map, or turned where it stands and its rotation left out."""

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class FuseResult:
    """A fused trajectory with its uncertainty: rows at IMU samples and measurement stamps, from the start on."""

    name: str
    """fuse/<estimator>/<measurements>, as in summary.json."""
    stamps_ns: Stamps
    T_world_imu: RigidTransform
    velocity: Array
    """(N, 3) in world axes, m/s."""
    gyroscope_bias: Array
    """(N, 3) rad/s."""
    accelerometer_bias: Array
    """(N, 3) m/s^2."""
    sigmas: Array
    """(N, 15) 1-sigma of attitude (imu axes), position, velocity (world axes), gyroscope and accelerometer bias."""
    pose_covariances: Array
    """(N, 6, 6) of [e_r, e_t] with R_true = R Exp(e_r), t_true = t + e_t; rad^2, m^2."""
    gate: GateLog
    runtime_s: float
    motion: Literal["imu", "odometry", "imu+odometry", "constant-velocity"] = "imu"
    """What carried the state between measurements."""
    body: Literal["imu", "cam"] = "imu"
    """Whose trajectory T_world_imu is: the camera's where the log says nothing of an IMU."""
    restarts: int = 0
    """How often the filter was lost and started again."""
    noise_scale: tuple[float, float] = (1.0, 1.0)
    """How many times larger than stated the poses' 1-sigma of rotation and of position was taken in the end."""
    calibrated: Calibrated | None = None
    """Extrinsics, time offset, gravity and map as they were last estimated; None where all were taken as given."""
    health: RunHealth | None = None
    """When it was tracking, coasting or lost, and how each object's poses fared; `fuse.fuse` always says so."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def later(self, by_ns: int) -> Self:
        """Return the same states and decisions with stamps that are later by so much: on a clock that is ahead."""
        gate = replace(self.gate, stamps_ns=self.gate.stamps_ns + by_ns)
        return replace(self, stamps_ns=self.stamps_ns + by_ns, gate=gate)

    @property
    def trajectory(self) -> Trajectory:
        """T_world_imu over time."""
        return Trajectory(self.stamps_ns, self.T_world_imu)
