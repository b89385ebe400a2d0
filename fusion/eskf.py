"""The error-state Kalman filter's update: innovation, gate, correction, and what a correction does to the covariance.

Written for compiled loops: the covariance stays symmetric because every update subtracts Z^T Z with Z = L^-1 H P
and S = L L^T (no inverse, no symmetrising), and the rows of H outside a measurement's own columns are never touched.
`fusion/reference_filter.py` is the same filter in plain numpy and filterpy, which the tests hold this one against.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.compiled import njit
from fusion.imu import write_gravity_basis
from fusion.memory import Memory, Work
from fusion.nav_state import (
    ACCEL_BIAS_ERROR,
    AT_BIASES,
    AT_CLONE,
    AT_EXTRINSICS,
    AT_GRAVITY,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    BIASES,
    CLONE,
    EXTRINSIC_ROTATION,
    GRAVITY,
    GYRO_BIAS_ERROR,
    N_BIAS_KINDS,
    N_ERROR,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    POSITION_ERROR,
    TIME_OFFSET,
    VELOCITY,
    Array,
    Ints,
)
from fusion.so3_kernels import apply, exp_so3, multiply, multiply_transposed_left, orthonormalise

REJECTED, POSITION_ONLY, ROTATION_ONLY, ACCEPTED = 0, 1, 2, 3  # bit 0: position used, bit 1: rotation used


@njit(cache=True)
def innovation(m: Memory, w: Work, count: int) -> None:
    """Write P H^T as rows (6, n) into w.PHt and S = H P H^T + R (6, 6) into w.S, from `count` columns of H."""
    n, P, H, PHt = m.layout[N_ERROR], m.P, w.H, w.PHt
    for r in range(6):
        for i in range(n):
            PHt[r, i] = 0.0
    for c in range(count):
        column = m.columns[c]
        for r in range(6):
            h = H[r, c]
            if h != 0.0:
                for i in range(n):
                    PHt[r, i] += h * P[column, i]
    for r in range(6):
        for s in range(r, 6):
            total = w.R[r, s]
            for c in range(count):
                total += H[s, c] * PHt[r, m.columns[c]]
            w.S[r, s] = w.S[s, r] = total


@njit(cache=True)
def cholesky(S: Array, first: int, size: int, L: Array) -> bool:
    """Write the Cholesky factor of S[first:first+size, same] into L; return False where S is not positive."""
    for i in range(size):
        for j in range(i + 1):
            total = S[first + i, first + j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if total <= 0.0:
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@njit(cache=True)
def whiten(L: Array, residual: Array, first: int, size: int, white: Array) -> float:
    """Write L^-1 residual[first:first+size] into white and return its squared norm, the NIS."""
    nis = 0.0
    for i in range(size):
        total = residual[first + i]
        for k in range(i):
            total -= L[i, k] * white[k]
        white[i] = total / L[i, i]
        nis += white[i] * white[i]
    return nis


@njit(cache=True)
def gate(S: Array, residual: Array, limits: Array, partial: float, L: Array, white: Array, nis: Array) -> int:
    """Decide what of a measurement to use; write its NIS [both, rotation, position] into nis (3,).

    limits (3,) are chi-square limits for both, rotation alone, position alone. A rotation that contradicts the
    state does not cost the position its update (partial >= 1), nor the other way round (partial >= 2).
    """
    nis[0] = nis[1] = nis[2] = np.inf
    if cholesky(S, 3, 3, L):
        nis[2] = whiten(L, residual, 3, 3, white)
    if not cholesky(S, 0, 6, L):
        return REJECTED
    nis[0] = whiten(L, residual, 0, 6, white)
    nis[1] = white[0] * white[0] + white[1] * white[1] + white[2] * white[2]
    if nis[0] <= limits[0]:
        return ACCEPTED
    if partial >= 1.0 and nis[2] <= limits[2]:
        return POSITION_ONLY
    if partial >= 2.0 and nis[1] <= limits[1]:
        return ROTATION_ONLY
    return REJECTED


@njit(cache=True)
def correct(m: Memory, w: Work, first: int, size: int) -> None:
    """Kalman update with rows first..first+size (size 3 or 6) of a measurement: state and covariance in place."""
    if not cholesky(w.S, first, size, w.L):
        return
    whiten(w.L, w.residual, first, size, w.white)
    _gain(m, w, first, size)
    _condition(m.P, w.Z, size)
    before = w.scratch[32:50]
    for i in range(15):
        before[i] = m.x[i]
    for i in range(3):
        before[15 + i] = m.x[GRAVITY + i]
    inject(m.x, w.error, m.layout, w.scratch)
    transport(m.P, before, m.x, w.error, m.layout, w.scratch)
    if m.layout[AT_TIME_OFFSET] >= 0:
        transport_clock(m, w, before)


@njit(cache=True)
def _gain(m: Memory, w: Work, first: int, size: int) -> None:
    """Write Z = L^-1 H P and the mean error Z^T L^-1 residual."""
    n, Z, error = m.layout[N_ERROR], w.Z, w.error
    for i in range(n):
        error[i] = 0.0
    for r in range(size):
        for i in range(n):
            Z[r, i] = w.PHt[first + r, i]
        for q in range(r):
            factor = w.L[r, q]
            for i in range(n):
                Z[r, i] -= factor * Z[q, i]
        factor = 1.0 / w.L[r, r]
        for i in range(n):
            Z[r, i] *= factor
            error[i] += Z[r, i] * w.white[r]


@njit(cache=True)
def _condition(P: Array, Z: Array, size: int) -> None:
    """P <- P - Z^T Z with the first `size` (3 or 6) rows of Z."""
    n = len(P)
    for i in range(n):
        z0, z1, z2 = Z[0, i], Z[1, i], Z[2, i]
        if size == 6:
            z3, z4, z5 = Z[3, i], Z[4, i], Z[5, i]
            for j in range(n):
                total = z0 * Z[0, j] + z1 * Z[1, j] + z2 * Z[2, j]
                P[i, j] -= total + (z3 * Z[3, j] + z4 * Z[4, j] + z5 * Z[5, j])
        else:
            for j in range(n):
                P[i, j] -= z0 * Z[0, j] + z1 * Z[1, j] + z2 * Z[2, j]


@njit(cache=True)
def inject(x: Array, error: Array, layout: Ints, scratch: Array) -> None:
    """Move the nominal state by an error state, in place (`nav_state.retract_state`)."""
    _turn(x, 0, error, 0, scratch)
    for i in range(12):
        x[POSITION + i] += error[POSITION_ERROR + i]
    at = layout[AT_EXTRINSICS]
    if at >= 0:
        _move_pose(x, EXTRINSIC_ROTATION, error, at, scratch)
    if layout[AT_TIME_OFFSET] >= 0:
        x[TIME_OFFSET] += error[layout[AT_TIME_OFFSET]]
    if layout[AT_GRAVITY] >= 0:
        _turn_gravity(x, error, layout[AT_GRAVITY], scratch)
    for k in range(layout[N_OBJECTS] if layout[AT_OBJECTS] >= 0 else 0):
        _move_pose(x, OBJECTS + OBJECT_SIZE * k, error, layout[AT_OBJECTS] + 6 * k, scratch)
    if layout[AT_BIASES] >= 0:
        for i in range(6 * layout[N_OBJECTS] * layout[N_BIAS_KINDS]):
            x[layout[BIASES] + i] += error[layout[AT_BIASES] + i]
    if layout[AT_CLONE] >= 0:
        _move_clone(x, layout[CLONE], error, layout[AT_CLONE], scratch)


@njit(cache=True)
def _turn(x: Array, start: int, error: Array, at: int, scratch: Array) -> None:
    turn, turned = scratch[0:9], scratch[9:18]
    exp_so3(error[at], error[at + 1], error[at + 2], turn)
    multiply(x[start : start + 9], turn, turned)
    orthonormalise(turned, turn)
    for i in range(9):
        x[start + i] = turned[i]


@njit(cache=True)
def _move_pose(x: Array, start: int, error: Array, at: int, scratch: Array) -> None:
    _turn(x, start, error, at, scratch)
    for i in range(3):
        x[start + 9 + i] += error[at + 3 + i]


@njit(cache=True)
def _move_clone(x: Array, start: int, error: Array, at: int, scratch: Array) -> None:
    """Move the clone by its error in world axes: R <- Exp(xi) R, p <- Exp(xi) p + rho."""
    turn, turned, moved = scratch[0:9], scratch[9:18], scratch[18:21]
    exp_so3(error[at], error[at + 1], error[at + 2], turn)
    multiply(turn, x[start : start + 9], turned)
    apply(turn, x[start + 9], x[start + 10], x[start + 11], moved)
    orthonormalise(turned, turn)
    for i in range(9):
        x[start + i] = turned[i]
    for i in range(3):
        x[start + 9 + i] = moved[i] + error[at + 3 + i]


@njit(cache=True)
def _turn_gravity(x: Array, error: Array, at: int, scratch: Array) -> None:
    basis = scratch[0:6]
    write_gravity_basis(x, basis)
    before = after = 0.0
    for i in range(3):
        before += x[GRAVITY + i] ** 2
        x[GRAVITY + i] += basis[2 * i] * error[at] + basis[2 * i + 1] * error[at + 1]
        after += x[GRAVITY + i] ** 2
    for i in range(3):
        x[GRAVITY + i] *= math.sqrt(before / after)


@njit(cache=True)
def transport(P: Array, before: Array, x: Array, error: Array, layout: Ints, scratch: Array) -> None:
    """Carry P from the tangent space of the state before a correction to that of the state after it.

    Heading and position cannot be told from a bias that all objects share, whatever the filter believes they are. That
    direction stays unobservable only if errors are compared in world axes about the world's origin (the right-invariant
    error: R_true = Exp(xi) R, p_true = Exp(xi) p + rho, v likewise), so P is carried along with xi, rho, nu held:
    theta+ = R+^T R- theta, dp+ = dp + [p- - p+]x R- theta, and so for velocity and estimated object positions.
    Without it the filter grows sure of what it cannot know.
    Source: A. Barrau and S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE TAC 62 (2017).
    """
    n = layout[N_ERROR]
    G, skewed = scratch[0:9], scratch[9:18]
    multiply_transposed_left(x, before, G)
    for part in range(parts_carried(layout)):
        lever_of_part(layout, part, before, x, error, skewed)
        _add_rows_and_columns(P, n, row_of_part(layout, part), skewed)
    _turn_rows_and_columns(P, n, G, scratch)


@njit(cache=True)
def transport_clock(m: Memory, w: Work, before: Array) -> None:
    """Carry P on for the time offset, whose error d moves attitude, position and velocity by w, v and a times d.

    Noise in w, v and a would tell the filter of d: of a camera at rest, that moves as corrections change their mind. So
    P is carried along with the errors held that the state has at the camera's time, R Exp(w d), p + v d and v + a d:
    theta+ += (R+^T R- w- - w+) d, dp+ += (v- - v+ + (R- w-) x (p+ - p-)) d, dv+ += (a- - a+ + (R- w-) x (v+ - v-)) d.
    before (18,) is R, p, v and gravity before the correction. The nine factors are left in w.scratch[50:59].
    """
    x, error, G, turned, u = m.x, w.error, w.scratch[0:9], w.scratch[9:18], w.scratch[50:59]
    multiply_transposed_left(x, before, G)
    apply(G, w.rate[0], w.rate[1], w.rate[2], turned[0:3])
    apply(before, w.rate[0], w.rate[1], w.rate[2], turned[3:6])
    apply(before, w.force[0], w.force[1], w.force[2], turned[6:9])
    for i in range(3):
        u[i] = turned[i] - w.rate[i] + error[GYRO_BIAS_ERROR + i]
        j, k = (i + 1) % 3, (i + 2) % 3
        for part in range(2):
            at = POSITION + 3 * part
            u[3 + 3 * part + i] = turned[3 + j] * (x[at + k] - before[at + k])
            u[3 + 3 * part + i] -= turned[3 + k] * (x[at + j] - before[at + j])
        u[3 + i] += before[VELOCITY + i] - x[VELOCITY + i]
        u[6 + i] += turned[6 + i] + before[15 + i] - x[GRAVITY + i]
    for i in range(3):
        w.rate[i] -= error[GYRO_BIAS_ERROR + i]
        w.force[i] -= error[ACCEL_BIAS_ERROR + i]
    apply(x, w.force[0], w.force[1], w.force[2], turned[0:3])
    for i in range(3):
        u[6 + i] -= turned[i]
    at, P = m.layout[AT_TIME_OFFSET], m.P
    for i in range(9):
        for j in range(len(P)):
            P[i, j] += u[i] * P[at, j]
    for j in range(len(P)):
        for i in range(9):
            P[j, i] += u[i] * P[j, at]


@njit(cache=True)
def parts_carried(layout: Ints) -> int:
    """Return how many parts of the error a correction carries along: position, velocity, positions of the objects."""
    return 2 + (layout[N_OBJECTS] if layout[AT_OBJECTS] >= 0 else 0)


@njit(cache=True)
def row_of_part(layout: Ints, part: int) -> int:
    """Return the first error state of such a part."""
    return POSITION_ERROR + 3 * part if part < 2 else layout[AT_OBJECTS] + 6 * (part - 2) + 3


@njit(cache=True)
def lever_of_part(layout: Ints, part: int, before: Array, x: Array, error: Array, out: Array) -> None:
    """Write [p- - p+]x R- (9,) of such a part."""
    if part < 2:
        at = POSITION + 3 * part
        dx, dy, dz = before[at] - x[at], before[at + 1] - x[at + 1], before[at + 2] - x[at + 2]
    else:
        row = row_of_part(layout, part)
        dx, dy, dz = -error[row], -error[row + 1], -error[row + 2]
    for j in range(3):
        out[j] = dy * before[6 + j] - dz * before[3 + j]
        out[3 + j] = dz * before[j] - dx * before[6 + j]
        out[6 + j] = dx * before[3 + j] - dy * before[j]


@njit(cache=True)
def _add_rows_and_columns(P: Array, n: int, row: int, block: Array) -> None:
    """P <- G P G^T where G adds block @ attitude error to three rows."""
    for i in range(3):
        b0, b1, b2 = block[3 * i], block[3 * i + 1], block[3 * i + 2]
        for j in range(n):
            P[row + i, j] += b0 * P[0, j] + b1 * P[1, j] + b2 * P[2, j]
    for i in range(3):
        b0, b1, b2 = block[3 * i], block[3 * i + 1], block[3 * i + 2]
        for j in range(n):
            P[j, row + i] += b0 * P[j, 0] + b1 * P[j, 1] + b2 * P[j, 2]


@njit(cache=True)
def _turn_rows_and_columns(P: Array, n: int, G: Array, scratch: Array) -> None:
    """P <- G P G^T where G turns the attitude error."""
    for j in range(n):
        p0, p1, p2 = P[0, j], P[1, j], P[2, j]
        for i in range(3):
            P[i, j] = G[3 * i] * p0 + G[3 * i + 1] * p1 + G[3 * i + 2] * p2
    for j in range(n):
        p0, p1, p2 = P[j, 0], P[j, 1], P[j, 2]
        for i in range(3):
            P[j, i] = G[3 * i] * p0 + G[3 * i + 1] * p1 + G[3 * i + 2] * p2
