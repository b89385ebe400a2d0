"""What the IMU says of two keyframes, for a graph that linearises each factor once; no gtsam here.

It is the filter's own propagation: the samples are integrated once, and the filter's noise, that of gaps and what the
samples themselves show among it, is the graph's too.
"""

from __future__ import annotations

import numpy as np

from fusion.compiled import njit
from fusion.graph_linear import whiten_rows
from fusion.imu import mean_until, propagate_covariance, propagate_nominal, rows_times, transition_blocks
from fusion.nav_state import (
    AT_GRAVITY,
    CORE,
    LAYOUT_SIZE,
    N_ERROR,
    OBJECTS,
    POSITION,
    POSITION_ERROR,
    VELOCITY_ERROR,
    Array,
    Ints,
)
from fusion.so3_kernels import (
    apply,
    apply_transposed,
    left_jacobian_inverse,
    log_so3,
    multiply_transposed_left,
    times_skew,
)

LINK_SIZES = 6, 3, 6, 6, 3, 6, 3  # columns of a link: pose, velocity and biases of both keyframes, gravity

SMALLEST_DENSITY = 1e-8  # a noise density of zero has no information matrix
INTEGRATION = 1e-5  # m/sqrt(s): what the midpoint rule leaves


@njit(cache=True, _nrt=True)
def link_keyframes(
    stamps: Ints, values: Array, start: int, end: int, noise: Array, gravity: bool, origin: Array, now: Array
) -> Array:
    """Return what the IMU says of two keyframes as white rows (15, .) [A, b], and carry `now` from one to the other.

    The first keyframe is linearised at the nominal array `origin`, the second at what `now` becomes; noise is the
    filter's. Columns are LINK_SIZES, gravity's if asked for; poses in gtsam's tangent, biases as in the filter.
    """
    x, F, Q = np.copy(origin[:OBJECTS]), np.eye(CORE), np.zeros((CORE, CORE))
    _integrate(stamps, values, start, end, noise, x, now, F, Q)
    seconds, gap = (end - start) * 1e-9, np.zeros(CORE)
    _local(now, x, gap)
    rows = np.zeros((CORE, 2 * CORE + (4 if gravity else 1)))
    for i in range(CORE):
        Q[i, i] += SMALLEST_DENSITY**2 * seconds
        for j in range(CORE):
            rows[i, j] = -F[i, j]
        rows[i, CORE + i], rows[i, -1] = 1.0, gap[i]
    for i in range(3):
        Q[POSITION_ERROR + i, POSITION_ERROR + i] += INTEGRATION**2 * seconds
        if gravity:
            rows[POSITION_ERROR + i, 2 * CORE + i] = -0.5 * seconds * seconds
            rows[VELOCITY_ERROR + i, 2 * CORE + i] = -seconds
    _take_into_second(gap, now, rows)
    whiten_rows(Q, 0, rows)
    _turn_position(rows, POSITION_ERROR, origin)
    _turn_position(rows, CORE + POSITION_ERROR, now)
    return rows


@njit(cache=True)
def _integrate(
    stamps: Ints, values: Array, start: int, end: int, noise: Array, x: Array, other: Array, F: Array, Q: Array
) -> None:
    """Carry two nominal arrays through the samples; F and Q become the first one's transition and noise."""
    layout, work, mean = np.zeros(LAYOUT_SIZE, dtype=np.int64), np.zeros(64), np.zeros(6)
    layout[N_ERROR], layout[AT_GRAVITY] = CORE, -1
    blocks, basis, core, scratch = np.zeros(45), np.zeros(6), np.zeros((CORE + 2, CORE)), np.zeros((3, CORE))
    k, now = np.searchsorted(stamps, start, side="right") - 1, start
    while now < end:
        stop = mean_until(stamps, values, k, now, end, mean)
        dt, interval = (stop - now) * 1e-9, (stamps[k + 1] - stamps[k]) * 1e-9
        propagate_nominal(other, dt, mean[0:3], mean[3:6], work)
        propagate_nominal(x, dt, mean[0:3], mean[3:6], work)
        transition_blocks(dt, work, blocks)
        propagate_covariance(Q, blocks, dt, interval, noise, values[k + 1], basis, layout, core, scratch)
        rows_times(blocks, dt, basis, -1, F, CORE, scratch)
        now, k = stop, k + 1


@njit(cache=True)
def _local(x: Array, other: Array, error: Array) -> None:
    """Write the errors (15,) that take a core x into another (`nav_state.local_state`)."""
    turn = np.zeros(9)
    multiply_transposed_left(x, other, turn)
    log_so3(turn, error)
    for i in range(CORE - POSITION_ERROR):
        error[POSITION_ERROR + i] = other[POSITION + i] - x[POSITION + i]


@njit(cache=True)
def _take_into_second(gap: Array, R: Array, rows: Array) -> None:
    """Let the error be in the axes of the second keyframe (attitude R), as gtsam's is: a gap turns with them."""
    J, body = np.zeros(9), np.zeros(3)
    for first in (POSITION_ERROR, VELOCITY_ERROR):
        apply_transposed(R, gap[first], gap[first + 1], gap[first + 2], body)
        times_skew(R, body[0], body[1], body[2], J)
        for i in range(3):
            for j in range(3):
                rows[first + i, CORE + j] -= J[3 * i + j]
    left_jacobian_inverse(gap[0], gap[1], gap[2], 1.0, J)
    for i in range(3):
        for j in range(3):
            rows[i, CORE + j] = J[3 * i + j]
    left_jacobian_inverse(gap[0], gap[1], gap[2], -1.0, J)
    for c in range(CORE):
        apply(J, rows[0, c], rows[1, c], rows[2, c], body)
        for i in range(3):
            rows[i, c] = body[i]


@njit(cache=True)
def _turn_position(rows: Array, at: int, R: Array) -> None:
    """Let three columns be of a position in the axes of a body with the attitude R (9,): dp = R rho."""
    for row in rows:
        x, y, z = row[at], row[at + 1], row[at + 2]
        for i in range(3):
            row[at + i] = x * R[i] + y * R[3 + i] + z * R[6 + i]
