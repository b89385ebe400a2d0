"""Measurements linearised together, and their rows brought down to what a factor needs; no gtsam here.

Where a graph linearises each factor once, it needs no model that can be called again: what a keyframe's measurements
say there is one least-squares problem, and an orthogonal change of its rows leaves it as it is. So all rows of an
object become at most as many as it has private variables (its biases, its pose), and what is left over of all objects
becomes at most as many as the camera's motion has.
"""

from __future__ import annotations

import numpy as np

from fusion.compiled import njit
from fusion.eskf import POSITION_ONLY, ROTATION_ONLY, cholesky
from fusion.graph_model import (
    BIAS_COLUMNS,
    OBJECT_COLUMNS,
    error_and_jacobian,
    motion_between,
    rate_at,
)
from fusion.measurements import OBJECT_POSE
from fusion.nav_state import ACCEL_BIAS, BIASES, GYRO_BIAS, N_BIAS_KINDS, N_OBJECTS, VELOCITY, Array, Ints
from fusion.so3_kernels import copy

SHARED = 16  # columns that any measurement may have: pose, velocity, extrinsics, time offset; behind the private ones
_NOTHING = 1e-10  # of a column's length: what rounding leaves of it


@njit(cache=True, _nrt=True)
def linearise(
    first: int,
    passed: Ints,
    stamps: Ints,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    translations: Array,
    covariances: Array,
    weights: Array,
    keyframe_ns: int,
    motion_stamps: Ints,
    motion_values: Array,
    odometry: bool,
    now: Array,
    start: Array,
    layout: Ints,
) -> tuple[Array, Ints, Array, int]:
    """Linearise measurements first..first+len(passed) at a nominal array `start`, whitened and weighted.

    passed: which rows of each the gate let through; weights: of every measurement. The motion from the keyframe is
    integrated at the biases in the nominal array `now`; the object biases there are where their part is linearised, as
    they may have begun far from it, and the right-hand side is brought to `start`. Returns rows of each object
    (K, private, private + SHARED + 1) and how many, and those of all together (SHARED, SHARED + 1) and how many.
    Columns: biases, object pose, what SHARED says, the right-hand side.
    """
    biases, n_objects = now[GYRO_BIAS : ACCEL_BIAS + 3] if not odometry else np.zeros(6), layout[N_OBJECTS]
    private = 6 * layout[N_BIAS_KINDS] + 6
    rows, owners = np.zeros((6 * len(passed), private + SHARED + 1)), np.zeros(6 * len(passed), dtype=np.int64)
    x, here, count = np.empty(len(start)), np.copy(start), 0
    for i in range(3 if odometry else 0):  # it knows no velocity
        here[VELOCITY + i] = 0.0
    copy(now[layout[BIASES] :], here[layout[BIASES] :])
    for n in range(len(passed)):
        i = first + n
        if passed[n] == 0:
            continue
        above, end = 0 if passed[n] & ROTATION_ONLY else 3, 6 if passed[n] & POSITION_ONLY else 3
        motion = motion_between(motion_stamps, motion_values, keyframe_ns, stamps[i], biases, odometry)
        rate = rate_at(motion_stamps, motion_values, stamps[i], biases[0:3])
        copy(here, x)
        size = end - above
        e, J = error_and_jacobian(
            kinds[i], objects[i], above, size, rotations[i], translations[i], rate, motion, x, layout
        )
        for kind in range(layout[N_BIAS_KINDS] if kinds[i] == OBJECT_POSE else 0):
            at = layout[BIASES] + 6 * (objects[i] + kind * n_objects)
            for r in range(size):
                for c in range(6):
                    e[r] -= J[r, BIAS_COLUMNS + 6 * kind + c] * (now[at + c] - start[at + c])
        _whiten(J, e, covariances[i], above, weights[i])
        for r in range(size):
            _arrange(J[r], -e[r], rows[count], private)
            owners[count] = objects[i] if kinds[i] == OBJECT_POSE else -1
            count += 1
    return _compress(rows[:count], owners[:count], n_objects, private)


@njit(cache=True)
def _whiten(J: Array, e: Array, covariance: Array, first: int, weight: float) -> None:
    """Bring an error and its Jacobian to unit noise, and scale both by the root of a weight."""
    size, L = len(e), np.zeros((6, 6))
    cholesky(covariance, first, size, L)
    for r in range(size):
        for s in range(r):
            e[r] -= L[r, s] * e[s]
            for c in range(J.shape[1]):
                J[r, c] -= L[r, s] * J[s, c]
        e[r] /= L[r, r]
        for c in range(J.shape[1]):
            J[r, c] /= L[r, r]
    for r in range(size):
        e[r] *= np.sqrt(weight)
        for c in range(J.shape[1]):
            J[r, c] *= np.sqrt(weight)


@njit(cache=True)
def _arrange(J: Array, b: float, row: Array, private: int) -> None:
    """Write a Jacobian's row with the private columns first."""
    for c in range(private - 6):
        row[c] = J[BIAS_COLUMNS + c]
    for c in range(6):
        row[private - 6 + c] = J[OBJECT_COLUMNS + c]
    for c in range(OBJECT_COLUMNS):
        row[private + c] = J[c]
    row[private + OBJECT_COLUMNS] = J[OBJECT_COLUMNS + 6]
    row[private + SHARED] = b


@njit(cache=True, _nrt=True)
def _compress(rows: Array, owners: Ints, n_objects: int, private: int) -> tuple[Array, Ints, Array, int]:
    width = rows.shape[1]
    own, counts = np.zeros((n_objects, private, width)), np.zeros(n_objects, dtype=np.int64)
    shared, left = np.zeros((max(len(rows), SHARED), SHARED + 1)), 0
    block = np.empty_like(rows)
    for k in range(-1, n_objects):
        size = 0
        for r in range(len(rows)):
            if owners[r] == k:
                copy(rows[r], block[size])
                size += 1
        taken = triangularise(block[:size], private) if k >= 0 else 0
        for r in range(size):
            if r < taken:
                copy(block[r], own[k, r])
            else:
                copy(block[r, private:], shared[left])
                left += 1
        if k >= 0:
            counts[k] = taken
    return own, counts, shared, triangularise(shared[:left], SHARED)


@njit(cache=True)
def triangularise(A: Array, columns: int) -> int:
    """Turn rows by Householder reflections until the first columns are in echelon form; return how many rows that took.

    What is left of a column that those before it span is rounding and becomes zero.
    """
    rows, width, r = A.shape[0], A.shape[1], 0
    for c in range(columns):
        above, below = 0.0, 0.0
        for i in range(rows):
            if i < r:
                above += A[i, c] * A[i, c]
            else:
                below += A[i, c] * A[i, c]
        if below <= _NOTHING * _NOTHING * (above + below):
            for i in range(r, rows):
                A[i, c] = 0.0
            continue
        length = np.sqrt(below) if A[r, c] < 0.0 else -np.sqrt(below)
        scale = 1.0 / (below - length * A[r, c])
        A[r, c] -= length
        for j in range(c + 1, width):
            total = 0.0
            for i in range(r, rows):
                total += A[i, c] * A[i, j]
            for i in range(r, rows):
                A[i, j] -= scale * total * A[i, c]
        A[r, c] = length
        for i in range(r + 1, rows):
            A[i, c] = 0.0
        r += 1
    return r
