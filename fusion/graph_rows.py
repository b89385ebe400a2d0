"""Rows at the IMU's rate between smoothed keyframes: what both ends and the motion between them say of a moment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion import memory
from fusion.compiled import njit
from fusion.filter_motion import advance
from fusion.memory import IMU_AT, MODE, NOW, TRACKING, views, work_views
from fusion.nav_state import CORE, EXTRINSIC_ROTATION, OBJECTS, StateLayout
from fusion.so3_kernels import copy

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# The filter's propagation of P gives the noise; carried through three objects' columns, which are no part of the core,
# it gives the transition matrix beside it.
_LAYOUT = StateLayout(n_objects=3, objects=True)


@njit(cache=True)
def propagate_between(
    floats: Array,
    integers: Ints,
    imu_stamps: Ints,
    imu_values: Array,
    start: int,
    x: Array,
    stamps: Ints,
    core: Array,
    F: Array,
    Q: Array,
) -> None:
    """Carry a state x from `start` through stamps (N,): core (N, 21), F and Q (N, 15, 15) from x on."""
    m = views(floats, integers)
    w = work_views(m.work, len(m.P))
    copy(x, m.x[:OBJECTS])
    m.P[:, :] = 0.0
    for i in range(CORE):
        m.P[i, CORE + i] = m.P[CORE + i, i] = 1.0
    m.counters[NOW], m.counters[MODE] = start, TRACKING
    m.counters[IMU_AT] = np.searchsorted(imu_stamps, start, side="right") - 1
    for row in range(len(stamps)):
        advance(m, w, imu_stamps, imu_values, stamps[row])
        copy(m.x, core[row])
        for i in range(CORE):
            copy(m.P[i, CORE:], F[row, i])
            copy(m.P[i], Q[row, i])


class Between:
    """Rows between two keyframes, given the filter's model of the motion.

    Given both ends, the state at t has the mean f(x_1) + G (x_2 - F x_1) with G = Q_t F_t2^T Q^-1 and the covariance
    Q_t - G F_t2 Q_t beside that of the ends, where F = F_t2 F_t and Q = F_t2 Q_t F_t2^T + Q_t2 belong to the whole
    way. Source: T. D. Barfoot, "State Estimation for Robotics" (2017), section 3.4, for the filter's motion.
    """

    def __init__(self, imu_stamps: Ints, imu_values: Array, noise: Array, size: int) -> None:
        """size: how many of the core's errors keyframes have, 15 or (odometry) the 6 of the pose."""
        self._stamps, self._values, self._size = imu_stamps, imu_values, size
        self._floats, self._integers = memory.allocate(_LAYOUT)
        memory.views.py_func(self._floats, self._integers).noise[:] = noise

    def predict(self, start: int, x: Array, stamps: Ints) -> tuple[Array, Array, Array]:
        """Return core (N, 21), F and Q (N, size, size) from a state x at `start` to stamps after it."""
        count, size = len(stamps), self._size
        core, F, Q = np.empty((count, EXTRINSIC_ROTATION)), np.empty((count, CORE, CORE)), np.empty((count, CORE, CORE))
        buffers = self._floats, self._integers, self._stamps, self._values
        propagate_between(*buffers, start, x, stamps, core, F, Q)
        return core, np.ascontiguousarray(F[:, :size, :size]), np.ascontiguousarray(Q[:, :size, :size])

    def after(self, start: int, x: Array, P: Array, stamps: Ints) -> tuple[Array, Array]:
        """Return core and covariance (N, size, size) of rows after the last keyframe, whose covariance P is."""
        core, F, Q = self.predict(start, x, stamps)
        return core, F @ P @ np.swapaxes(F, 1, 2) + Q

    def between(self, ends: tuple[int, int], x: tuple[Array, Array], P: Array, stamps: Ints) -> tuple[Array, Array]:
        """Return core and covariance of rows between two keyframes, whose joint covariance (2 size, 2 size) P is."""
        core, F, Q = self.predict(ends[0], x[0], np.append(stamps, ends[1]))
        size = self._size
        F_rest = F[-1] @ np.linalg.inv(F[:-1])
        gain = Q[:-1] @ np.swapaxes(F_rest, 1, 2) @ _inverse(Q[-1])
        gap = _errors(core[-1], x[1][:EXTRINSIC_ROTATION])[:size]
        rows = _moved(core[:-1], gain @ gap)
        left = np.concatenate([F[:-1] - gain @ F[-1], gain], axis=2)
        covariance = left @ P @ np.swapaxes(left, 1, 2) + Q[:-1] - gain @ F_rest @ Q[:-1]
        return rows, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def _errors(from_core: Array, to_core: Array) -> Array:
    """Return the errors (15,) that take one core into another (`nav_state.local_state`)."""
    turn = Rotation.from_matrix(from_core[:9].reshape(3, 3)).inv() * Rotation.from_matrix(to_core[:9].reshape(3, 3))
    return np.concatenate([turn.as_rotvec(), (to_core - from_core)[9:]])


def _moved(core: Array, errors: Array) -> Array:
    """Return cores (N, 21) moved by errors (N, size) (`nav_state.retract_state`)."""
    moved, size = core.copy(), errors.shape[1]
    turned = Rotation.from_matrix(core[:, :9].reshape(-1, 3, 3)) * Rotation.from_rotvec(errors[:, :3])
    moved[:, :9] = turned.as_matrix().reshape(-1, 9)
    moved[:, 9 : 6 + size] += errors[:, 3:]
    return moved


def _inverse(Q: Array) -> Array:
    """Return the inverse of a covariance of mixed units, zero where nothing is uncertain."""
    scale = np.sqrt(np.diag(Q))
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.pinv(Q / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale))
