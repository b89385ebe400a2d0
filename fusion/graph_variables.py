"""The graph's variables and how each stands in the filter's nominal array and error state.

Keys: x pose T_world_imu, v velocity, b IMU bias (gtsam's order: accelerometer, gyroscope) per keyframe; e T_imu_cam,
d time offset, g gravity, o T_world_obj per object; c one object's bias at one keyframe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.graph_arrangement import CLONE, GRAVITY_VECTOR, IMU_BIAS, POSE, VECTOR
from fusion.nav_state import (
    ACCEL_BIAS,
    EXTRINSIC_ROTATION,
    GRAVITY,
    GYRO_BIAS,
    OBJECT_SIZE,
    OBJECTS,
    TIME_OFFSET,
    VELOCITY,
    StateLayout,
    gravity_tangent,
)

Array = NDArray[np.float64]

EXTRINSICS, OFFSET, GRAVITY_KEY = (int(gtsam.symbol(name, 0)) for name in "edg")
_POSES, _VELOCITIES, _IMU_BIASES, _OBJECTS, _OBJECT_BIASES = (int(gtsam.symbol(name, 0)) for name in "xvboc")
_EYE = np.eye(3)
_SMALLEST_VARIANCE = 1e-14  # an exact prior has no information matrix
_LENGTH_OF_GRAVITY = 1e-3  # m/s^2


def pose_key(k: int) -> int:
    """Return the key of keyframe k's pose."""
    return _POSES + k


def velocity_key(k: int) -> int:
    """Return the key of keyframe k's velocity."""
    return _VELOCITIES + k


def imu_bias_key(k: int) -> int:
    """Return the key of keyframe k's IMU bias."""
    return _IMU_BIASES + k


def object_key(k: int) -> int:
    """Return the key of an object's pose."""
    return _OBJECTS + k


def object_bias_key(count: int) -> int:
    """Return the key of one object's bias at one keyframe; they are counted through."""
    return _OBJECT_BIASES + count


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """Return the matrix of these blocks; scipy's takes half a millisecond for a keyframe's."""
    matrix, row, column = np.zeros(np.sum([block.shape for block in blocks], axis=0)), 0, 0
    for block in blocks:
        rows, columns = block.shape
        matrix[row : row + rows, column : column + columns] = block
        row, column = row + rows, column + columns
    return matrix


def pose3(x: Array, at: int) -> gtsam.Pose3:
    """Return the pose that stands in the nominal array."""
    return gtsam.Pose3(gtsam.Rot3(x[at : at + 9].reshape(3, 3)), x[at + 9 : at + 12])


def imu_bias(x: Array) -> gtsam.imuBias.ConstantBias:
    """Return the IMU bias that stands in the nominal array."""
    return gtsam.imuBias.ConstantBias(x[ACCEL_BIAS : ACCEL_BIAS + 3], x[GYRO_BIAS : GYRO_BIAS + 3])


@dataclass(frozen=True)
class Variable:
    """A variable: its key, its errors in the filter's error state, its place in the nominal array.

    This one is a vector that the filter holds as it is.
    """

    key: int
    errors: range
    at: int
    kind: ClassVar[int] = VECTOR

    @property
    def size(self) -> int:
        """Size of its tangent in gtsam."""
        return len(self.errors)

    def insert(self, values: gtsam.Values, x: Array) -> None:
        """Add it to values with what stands in the nominal array."""
        values.insert(self.key, x[self.at : self.at + self.size])

    @property
    def place(self) -> slice:
        """Its place in the nominal array."""
        return slice(self.at, self.at + self.size)

    def read(self, values: gtsam.Values, x: Array) -> None:
        """Write its value into the nominal array."""
        x[self.at : self.at + self.size] = values.atVector(self.key)

    def to_filter(self, x: Array) -> Array:
        """Return the derivative of the filter's errors by gtsam's tangent."""
        return np.eye(self.size)

    def from_filter(self, x: Array) -> Array:
        """Return the derivative of gtsam's tangent by the filter's errors."""
        return np.asarray(np.linalg.inv(self.to_filter(x)))

    def slack(self, x: Array) -> Array:
        """Return the covariance in gtsam's tangent that a prior has beside that of the filter's errors."""
        return _SMALLEST_VARIANCE * np.eye(self.size)


class PoseVariable(Variable):
    """A Pose3: gtsam measures its translation error in its own axes, the filter in the axes around it."""

    kind = POSE

    def insert(self, values: gtsam.Values, x: Array) -> None:
        """Add it to values with what stands in the nominal array."""
        values.insert(self.key, pose3(x, self.at))

    def read(self, values: gtsam.Values, x: Array) -> None:
        """Write its value into the nominal array."""
        T = values.atPose3(self.key)
        x[self.at : self.at + 9] = T.rotation().matrix().ravel()
        x[self.at + 9 : self.at + 12] = T.translation()

    @property
    def place(self) -> slice:
        """Its place in the nominal array."""
        return slice(self.at, self.at + OBJECT_SIZE)

    def to_filter(self, x: Array) -> Array:
        """Return the derivative of the filter's errors by gtsam's tangent."""
        return block_diagonal([_EYE, x[self.at : self.at + 9].reshape(3, 3)])


class CloneVariable(PoseVariable):
    """The pose at the last odometry: the filter's clone of it has its error in world axes."""

    kind = CLONE

    def to_filter(self, x: Array) -> Array:
        """Return the derivative of [xi, rho], R_true = Exp(xi) R and p_true = Exp(xi) p + rho, by gtsam's tangent."""
        return np.asarray(pose3(x, self.at).AdjointMap())


class ImuBiasVariable(Variable):
    """The IMU's bias: [accelerometer, gyroscope] in gtsam, [gyroscope, accelerometer] in the filter."""

    kind = IMU_BIAS

    def insert(self, values: gtsam.Values, x: Array) -> None:
        """Add it to values with what stands in the nominal array."""
        values.insert(self.key, imu_bias(x))

    def read(self, values: gtsam.Values, x: Array) -> None:
        """Write its value into the nominal array."""
        bias = values.atConstantBias(self.key)
        x[GYRO_BIAS : GYRO_BIAS + 3], x[ACCEL_BIAS : ACCEL_BIAS + 3] = bias.gyroscope(), bias.accelerometer()

    def to_filter(self, x: Array) -> Array:
        """Return the derivative of the filter's errors by gtsam's tangent."""
        return np.roll(np.eye(6), 3, axis=0)


class GravityVariable(Variable):
    """Gravity: a vector whose length is all but fixed in gtsam, two angles in the filter."""

    kind = GRAVITY_VECTOR

    @property
    def size(self) -> int:
        """Size of its tangent in gtsam."""
        return 3

    def to_filter(self, x: Array) -> Array:
        """Return the derivative of the filter's errors by gtsam's tangent."""
        return np.asarray(np.linalg.pinv(self.from_filter(x)))

    def from_filter(self, x: Array) -> Array:
        """Return the derivative of gtsam's tangent by the filter's errors."""
        return gravity_tangent(x[GRAVITY : GRAVITY + 3])

    def slack(self, x: Array) -> Array:
        """Return the covariance in gtsam's tangent that a prior has beside that of the filter's errors."""
        g = x[GRAVITY : GRAVITY + 3]
        return super().slack(x) + _LENGTH_OF_GRAVITY**2 * np.outer(g, g) / (g @ g)


def keyframe_variables(k: int, with_imu: bool, plain: bool = False) -> list[Variable]:
    """Return the variables of keyframe k: the pose, and with an IMU velocity and biases (plain: as a vector)."""
    pose = PoseVariable(pose_key(k), range(6), 0)
    if not with_imu:
        return [pose]
    biases = Variable if plain else ImuBiasVariable
    return [
        pose,
        Variable(velocity_key(k), range(6, 9), VELOCITY),
        biases(imu_bias_key(k), range(9, 15), GYRO_BIAS),
    ]


def static_variables(layout: StateLayout) -> list[Variable]:
    """Return what is estimated once for all keyframes, but for the objects."""
    found: list[Variable] = []
    if layout.extrinsics:
        found.append(PoseVariable(EXTRINSICS, errors_of(layout, "extrinsics"), EXTRINSIC_ROTATION))
    if layout.time_offset:
        found.append(Variable(OFFSET, errors_of(layout, "time_offset"), TIME_OFFSET))
    if layout.gravity:
        found.append(GravityVariable(GRAVITY_KEY, errors_of(layout, "gravity"), GRAVITY))
    return found


def object_variable(layout: StateLayout, k: int) -> Variable:
    """Return the variable of an estimated object pose."""
    return PoseVariable(object_key(k), errors_of(layout, "objects", k), OBJECTS + OBJECT_SIZE * k)


def errors_of(layout: StateLayout, name: str, index: int = 0, kind: int = 0) -> range:
    """Return where a part stands in the error state."""
    part = layout.error_slice(name, index, kind)
    return range(part.start, part.stop)


def joint_prior(variables: Sequence[Variable], x: Array, P: Array) -> gtsam.NonlinearFactor:
    """Return the filter's Gaussian on some variables, at their place in the nominal array, as one factor."""
    at = [i for variable in variables for i in variable.errors]
    to_gtsam = block_diagonal([variable.from_filter(x) for variable in variables])
    slack = block_diagonal([variable.slack(x) for variable in variables])
    covariance = to_gtsam @ P[np.ix_(at, at)] @ to_gtsam.T + slack
    scale = 1.0 / np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance * np.outer(scale, scale))
    sizes = [variable.size for variable in variables]
    whitener = np.split(np.linalg.solve(root, np.diag(scale)), np.cumsum(sizes)[:-1], axis=1)
    together, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Diagonal.Sigmas(np.ones(len(covariance)))
    terms = [(variable.key, part) for variable, part in zip(variables, whitener, strict=True)]
    together.add(gtsam.GaussianConditional(terms, 1, np.zeros(len(covariance)), unit))
    here = gtsam.Values()
    for variable in variables:
        variable.insert(here, x)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(together), here)
