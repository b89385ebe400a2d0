"""What the report needs to see of a fused result: its shape, so that fusion is not imported here."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.records import LandmarkMap

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]

STATE_AXES = ("rx", "ry", "rz", "px", "py", "pz", "vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")
"""The columns of `Fused.sigmas`."""


class Gates(Protocol):
    """What the gate decided about each of M measurements of an object."""

    @property
    def stamps_ns(self) -> Stamps:
        """(M,)"""

    @property
    def object_ids(self) -> NDArray[np.int64]:
        """(M,)"""

    @property
    def instances(self) -> NDArray[np.int64]:
        """(M,)"""

    @property
    def nis_position(self) -> Array:
        """(M,) squared Mahalanobis distance of the position rows, 3 degrees of freedom; NaN where there was none."""

    @property
    def nis_rotation(self) -> Array:
        """(M,) of the rotation rows, likewise."""

    @property
    def position_accepted(self) -> Mask:
        """(M,)"""

    @property
    def rotation_accepted(self) -> Mask:
        """(M,)"""


class Calibrated(Protocol):
    """What was estimated beside the trajectory."""

    @property
    def landmark_map(self) -> LandmarkMap | None:
        """The map as it was found; None where it was taken as given."""

    @property
    def timeshift_cam_imu_s(self) -> float | None:
        """The time offset as it was found, likewise."""


class HasStates(Protocol):
    """What states.csv holds of a fused result, at N stamps."""

    @property
    def stamps_ns(self) -> Stamps:
        """(N,)"""

    @property
    def T_world_imu(self) -> RigidTransform:
        """N poses"""

    @property
    def velocity(self) -> Array:
        """(N, 3) m/s, world axes"""

    @property
    def gyroscope_bias(self) -> Array:
        """(N, 3) rad/s"""

    @property
    def accelerometer_bias(self) -> Array:
        """(N, 3) m/s^2"""

    @property
    def sigmas(self) -> Array:
        """(N, 15) 1-sigma in the order of STATE_AXES: attitude (imu axes, rad), position, velocity, biases; SI"""


class Fused(HasStates, Protocol):
    """A fused trajectory: the state and its 1-sigma at N stamps."""

    @property
    def name(self) -> str:
        """`fuse/<estimator>/<measurements>`"""

    @property
    def pose_covariances(self) -> Array | None:
        """(N, 6, 6) of [e_r, e_t], rotation on the right in imu axes, translation in world axes"""

    @property
    def gate(self) -> Gates | None:
        """What happened to each measurement"""

    @property
    def runtime_s(self) -> float | None:
        """s"""

    def later(self, by_ns: int) -> Self:
        """The same with stamps, also the gate's, that are later by so much."""

    @property
    def calibrated(self) -> Calibrated | None:
        """None where nothing beside the trajectory was estimated"""
