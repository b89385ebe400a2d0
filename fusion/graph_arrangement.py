"""Where a graph's variables stand in the filter's nominal array and error state, and what they say put there.

One compiled call for all of them: they are a few numbers each, and what is called for each costs more. No gtsam here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion.compiled import njit
from fusion.imu import write_gravity_basis
from fusion.nav_state import GRAVITY, OBJECT_SIZE, Array, Ints
from fusion.so3_kernels import apply, exp_so3, left_jacobian, multiply

if TYPE_CHECKING:
    from fusion.graph_variables import Variable

# How a variable's tangent in gtsam becomes the filter's errors. Vectors: as they are. Poses: gtsam measures the
# translation error in the pose's own axes. The clone's error is in world axes. Biases of the IMU: gtsam has the
# accelerometer's first. Gravity: a vector in gtsam, two angles in the filter.
VECTOR, POSE, CLONE, IMU_BIAS, GRAVITY_VECTOR = range(5)


class Arrangement:
    """Variables, one behind the other, whatever their keys."""

    def __init__(self, variables: Sequence[Variable]) -> None:
        rows = [(v.kind, v.at, v.size, len(v.errors)) for v in variables]
        self._table = np.array(rows, dtype=np.int64).reshape(-1, 4)
        self.errors = np.array([i for v in variables for i in v.errors], dtype=np.int64)

    def settle(self, origin: Array, x: Array, twin: Array, step: Array, root: Array) -> Array:
        """Write into two nominal arrays what comes of a step in gtsam's tangents from a third one.

        Returns rows of gtsam's tangents, one for each, as rows of the filter's errors there.
        """
        errors = np.empty((len(self.errors), root.shape[1]))
        settle(self._table, origin, x, twin, step, root, errors)
        return errors


@njit(cache=True)
def settle(table: Ints, origin: Array, x: Array, twin: Array, step: Array, root: Array, errors: Array) -> None:
    """Do what `Arrangement.settle` says; a row of the table: kind, place, size of the tangent, number of errors."""
    first, row = 0, 0
    for i in range(len(table)):
        kind, at, size, count = table[i, 0], table[i, 1], table[i, 2], table[i, 3]
        own, rows = step[first : first + size], root[first : first + size]
        if kind in (POSE, CLONE):
            _move_pose(origin[at : at + OBJECT_SIZE], own, x[at : at + OBJECT_SIZE])
            _turn(kind == CLONE, x[at : at + OBJECT_SIZE], rows, errors[row : row + count])
        elif kind == GRAVITY_VECTOR:
            for j in range(size):
                x[at + j] = origin[at + j] + own[j]
            _tilt(x, rows, errors[row : row + count])
        else:
            shift = 3 if kind == IMU_BIAS else 0
            for j in range(size):
                source = (j + shift) % size
                x[at + j] = origin[at + j] + own[source]
                for c in range(root.shape[1]):
                    errors[row + j, c] = rows[source, c]
        for j in range(at, at + (OBJECT_SIZE if kind in (POSE, CLONE) else size)):
            twin[j] = x[j]
        first, row = first + size, row + count


@njit(cache=True)
def _move_pose(origin: Array, step: Array, pose: Array) -> None:
    """pose <- origin Exp(step), both [R (9), p (3)] of a nominal array."""
    turn, jacobian, shift = np.zeros(9), np.zeros(9), np.zeros(3)
    exp_so3(step[0], step[1], step[2], turn)
    multiply(origin, turn, pose)
    left_jacobian(step[0], step[1], step[2], 1.0, jacobian)
    apply(jacobian, step[3], step[4], step[5], shift)
    apply(origin, shift[0], shift[1], shift[2], pose[9:12])
    for i in range(3):
        pose[9 + i] += origin[9 + i]


@njit(cache=True)
def _turn(world: bool, pose: Array, rows: Array, errors: Array) -> None:
    """Write a pose's errors: [theta, R rho], or in world axes [R theta, R rho + p x R theta]."""
    for c in range(rows.shape[1]):
        for i in range(3):
            errors[3 + i, c] = pose[3 * i] * rows[3, c] + pose[3 * i + 1] * rows[4, c] + pose[3 * i + 2] * rows[5, c]
            errors[i, c] = rows[i, c]
        if world:
            for i in range(3):
                errors[i, c] = pose[3 * i] * rows[0, c] + pose[3 * i + 1] * rows[1, c] + pose[3 * i + 2] * rows[2, c]
            errors[3, c] += pose[10] * errors[2, c] - pose[11] * errors[1, c]
            errors[4, c] += pose[11] * errors[0, c] - pose[9] * errors[2, c]
            errors[5, c] += pose[9] * errors[1, c] - pose[10] * errors[0, c]


@njit(cache=True)
def _tilt(x: Array, rows: Array, errors: Array) -> None:
    """Write gravity's two angles; its basis has orthogonal columns as long as gravity."""
    basis, squared = np.zeros(6), 0.0
    write_gravity_basis(x, basis)
    for i in range(3):
        squared += x[GRAVITY + i] * x[GRAVITY + i]
    for c in range(rows.shape[1]):
        for k in range(2):
            errors[k, c] = (basis[k] * rows[0, c] + basis[2 + k] * rows[1, c] + basis[4 + k] * rows[2, c]) / squared
