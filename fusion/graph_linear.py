"""Measurements linearised together, and their rows brought down to what a factor needs; no gtsam here.

Where a graph linearises each factor once, it needs no model that can be called again: what a keyframe's measurements
say there is one least-squares problem, and an orthogonal change of its rows leaves it as it is. So all rows of an
object become at most as many as it has private variables (its biases, its pose), and what is left over of all objects
becomes at most as many as the camera's motion has.
"""

from __future__ import annotations

import numpy as np

from fusion.columns import Columns, Fitted
from fusion.compiled import njit
from fusion.eskf import ACCEPTED, POSITION_ONLY, ROTATION_ONLY, cholesky
from fusion.graph_model import (
    BIAS_COLUMNS,
    EXTRINSIC_COLUMNS,
    MOTION_SIZE,
    OBJECT_COLUMNS,
    OFFSET_COLUMN,
    VELOCITY_COLUMNS,
    error_and_jacobian,
    motion_between,
    rate_at,
)
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP
from fusion.nav_state import (
    ACCEL_BIAS,
    AT_EXTRINSICS,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    BIASES,
    GYRO_BIAS,
    N_BIAS_KINDS,
    N_OBJECTS,
    SPREAD_SIZE,
    SPREADS,
    VELOCITY,
    Array,
    Ints,
)
from fusion.so3_kernels import copy

_NOTHING = 1e-10  # of a column's length: what rounding leaves of it


@njit(cache=True, _nrt=True)
def linearise(
    log: Columns,
    fitted: Fitted,
    first: int,
    end: int,
    keyframe_ns: int,
    odometry: bool,
    now: Array,
    start: Array,
    layout: Ints,
) -> tuple[Array, Ints]:
    """Linearise the measurements first..end-1 that passed the gate at a nominal array `start`, whitened and weighted.

    fitted says how the filter used them. The motion from the keyframe is integrated at the biases in the nominal array
    `now`; the object biases there are where their part is linearised, as they may have begun far from it, and the
    right-hand side is brought to `start`. Returns rows [A, b] with the columns that `columns_of` names, and where those
    of each object begin (K + 1,); those behind have nothing in the columns that belong to an object.
    """
    biases, x = now[GYRO_BIAS : ACCEL_BIAS + 3] if not odometry else np.zeros(6), np.empty(len(start))
    columns = columns_of(layout, not odometry and (layout[AT_TIME_OFFSET] >= 0 or log.stamps[first] != keyframe_ns))
    rows, owners, count = np.empty((6 * (end - first), len(columns) + 1)), np.empty(6 * (end - first), np.int64), 0
    here, stamp, motion, rate = np.copy(start), np.int64(-1), np.zeros(MOTION_SIZE), np.zeros(3)
    for i in range(3 if odometry else 0):  # it knows no velocity
        here[VELOCITY + i] = 0.0
    copy(now[layout[BIASES] :], here[layout[BIASES] :])
    for i in range(first, end):
        passed, kind, k = log.decisions[i] & ACCEPTED, log.kinds[i], log.objects[i]
        if passed == 0 or kind == ODOMETRY_STEP:
            continue
        above, below = 0 if passed & ROTATION_ONLY else 3, 6 if passed & POSITION_ONLY else 3
        if log.stamps[i] != stamp:
            stamp = log.stamps[i]
            motion = motion_between(log.imu_stamps, log.imu_values, keyframe_ns, stamp, biases, odometry)
            rate = rate_at(log.imu_stamps, log.imu_values, stamp, biases[0:3])
        copy(here, x)
        if kind == OBJECT_POSE and layout[N_BIAS_KINDS] > 0:
            at = layout[SPREADS] + SPREAD_SIZE * k
            copy(fitted.spreads[i], x[at : at + 3])
        seen = kind, k, above, below - above, fitted.rotations[i], log.translations[i]
        e, J = error_and_jacobian(*seen, rate, motion, x, layout)
        if kind == OBJECT_POSE:
            _bring_to(start, now, k, J, e, layout)
        _write_white(J, e, columns, fitted.covariances[i], above, fitted.weights[i], rows[count : count + len(e)])
        for _ in range(len(e)):
            owners[count] = k if kind == OBJECT_POSE else -1
            count += 1
    return _compress(rows[:count], owners[:count], layout[N_OBJECTS], private_size(layout))


@njit(cache=True)
def private_size(layout: Ints) -> int:
    """Return how many columns belong to an object: its biases and, where it is estimated, its pose."""
    return 6 * layout[N_BIAS_KINDS] + (6 if layout[AT_OBJECTS] >= 0 else 0)


@njit(cache=True, _nrt=True)
def columns_of(layout: Ints, velocity: bool) -> Ints:
    """Return which columns of a detection's Jacobian rows have, in this order.

    Biases and pose of the object, pose and (if asked for) velocity of the keyframe, extrinsics, time offset.
    """
    found, count = np.empty(BIAS_COLUMNS + 6 * layout[N_BIAS_KINDS], dtype=np.int64), 0
    parts = (
        (BIAS_COLUMNS, 6 * layout[N_BIAS_KINDS]),
        (OBJECT_COLUMNS, 6 if layout[AT_OBJECTS] >= 0 else 0),
        (0, 6),
        (VELOCITY_COLUMNS, 3 if velocity else 0),
        (EXTRINSIC_COLUMNS, 6 if layout[AT_EXTRINSICS] >= 0 else 0),
        (OFFSET_COLUMN, 1 if layout[AT_TIME_OFFSET] >= 0 else 0),
    )
    for at, size in parts:
        for c in range(size):
            found[count + c] = at + c
        count += size
    return found[:count]


@njit(cache=True)
def _bring_to(start: Array, now: Array, k: int, J: Array, e: Array, layout: Ints) -> None:
    """Say of an error with the object biases in `now` what it is, to first order, with those in `start`."""
    for kind in range(layout[N_BIAS_KINDS]):
        at = layout[BIASES] + 6 * (k + kind * layout[N_OBJECTS])
        for r in range(len(e)):
            for c in range(6):
                e[r] -= J[r, BIAS_COLUMNS + 6 * kind + c] * (now[at + c] - start[at + c])


@njit(cache=True)
def _write_white(J: Array, e: Array, columns: Ints, covariance: Array, first: int, weight: float, rows: Array) -> None:
    """Write error and Jacobian of a measurement as rows of unit noise that count as much as their weight."""
    for r in range(len(e)):
        rows[r, -1] = -e[r]
        for c in range(len(columns)):
            rows[r, c] = J[r, columns[c]]
    whiten_rows(covariance, first, rows)
    for r in range(len(e)):
        for c in range(rows.shape[1]):
            rows[r, c] *= np.sqrt(weight)


@njit(cache=True)
def whiten_rows(covariance: Array, first: int, rows: Array) -> None:
    """Bring rows of the covariance that begins at row and column `first` of this one to unit noise."""
    size, L = len(rows), np.zeros((len(rows), len(rows)))
    cholesky(covariance, first, size, L)
    for r in range(size):
        for s in range(r):
            for c in range(rows.shape[1]):
                rows[r, c] -= L[r, s] * rows[s, c]
        for c in range(rows.shape[1]):
            rows[r, c] /= L[r, r]


@njit(cache=True, _nrt=True)
def _compress(rows: Array, owners: Ints, n_objects: int, private: int) -> tuple[Array, Ints]:
    """Return as few rows that say the same, by object, and behind them what is left over of all; and where each begin.

    Nothing that is left over has any part in the private columns, so that it is one problem.
    """
    begins, count, left = np.zeros(n_objects + 1, dtype=np.int64), 0, 0
    turned, shared, block = np.zeros_like(rows), np.zeros_like(rows), np.empty_like(rows)
    for k in range(-1, n_objects):
        size = 0
        for r in range(len(rows)):
            if owners[r] == k:
                copy(rows[r], block[size])
                size += 1
        taken = triangularise(block[:size], private) if k >= 0 else 0
        for r in range(size):
            if r < taken:
                copy(block[r], turned[count + r])
            else:
                copy(block[r], shared[left])
                left += 1
        count += taken
        begins[k + 1] = count
    for r in range(triangularise(shared[:left], shared.shape[1] - 1)):
        copy(shared[r], turned[count])
        count += 1
    return turned[:count], begins


@njit(cache=True, _nrt=True)
def bias_rows(phi: Array, sigma: Array, first: Array, second: Array) -> Array:
    """Return the Gauss-Markov step second = phi first + w, w ~ sigma, between two object biases as rows [A, b] (6, 13).

    All (6,); both biases are linearised at what is given.
    """
    rows = np.zeros((6, 13))
    for i in range(6):
        rows[i, i], rows[i, 6 + i] = -phi[i] / sigma[i], 1.0 / sigma[i]
        rows[i, 12] = (phi[i] * first[i] - second[i]) / sigma[i]
    return rows


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
