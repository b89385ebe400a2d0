"""Going back over a tape: what the future says of each state, and the smoothed rows (`fusion/smoother.py`)."""

from __future__ import annotations

import numpy as np

from fusion.compiled import njit
from fusion.eskf import inject, row_of_part, transport
from fusion.nav_state import (
    ACCEL_BIAS_ERROR,
    AT_BIASES,
    AT_CLONE,
    AT_GRAVITY,
    AT_TIME_OFFSET,
    CORE,
    EXTRINSIC_ROTATION,
    GYRO_BIAS_ERROR,
    N_ERROR,
    POSITION_ERROR,
    VELOCITY_ERROR,
    Array,
    Ints,
)
from fusion.tape import CLOCK, CLONING, CORRECTION, DECAY, FORGETTING, MEETING, ODOMETRY, ROW, STEP, TAIL


@njit(cache=True)
def unroll(
    tape: Array,
    end: int,
    layout: Ints,
    core_layout: Ints,
    gradient: Array,
    information: Array,
    core: Array,
    covariance: Array,
) -> None:
    """Go back over a tape and write the smoothed rows.

    gradient (n,) and information (n, n) hold what the future says of the state: zero after the last record, and left
    here as they are before the first. For a state x with covariance P the smoothed one is x (+) P gradient with
    P - P information P. core (rows, 21) and covariance (rows, 15, 15) are written.
    Source: G. J. Bierman, "Factorization Methods for Discrete Sequential Estimation" (1977), section X.1, the form of
    A. E. Bryson and M. Frazier: the smoother of Rauch, Tung and Striebel without its inverse of P, which known maps and
    objects not yet met make singular.
    """
    work = np.empty(17 * layout[N_ERROR] + 17 * 17 + 64)
    while end > 0:
        length, kind = int(tape[end - 2]), int(tape[end - 1])
        end -= TAIL + length
        record = tape[end : end + length]
        if kind == STEP:
            _back_over_step(record, layout, gradient, information, work)
        elif kind == CORRECTION:
            _back_over_correction(record, layout, gradient, information, work)
        elif kind == ROW:
            row = int(record[0])
            _smooth_row(record, core_layout, gradient, information, core[row], covariance[row], work)
        elif kind == ODOMETRY:
            _back_over_odometry(record, gradient, information, work)
        elif kind == MEETING:
            _back_over_meeting(record, layout[N_ERROR], gradient, information)
        elif kind == CLONING:
            _back_over_cloning(record, layout, gradient, information)
        elif kind == CLOCK:
            _back_over_clock(record, layout[AT_TIME_OFFSET], gradient, information)
        elif kind == FORGETTING:
            for i in range(int(record[1])):
                _scale(information, gradient, layout[N_ERROR], int(record[0]) + i, 0.0)
        else:  # DECAY of the biases, RESTART of everything
            first = layout[AT_BIASES] if kind == DECAY else 0
            for i in range(length):
                _scale(information, gradient, layout[N_ERROR], first + i, record[i])


@njit(cache=True)
def _scale(information: Array, gradient: Array, n: int, i: int, factor: float) -> None:
    if factor == 1.0:
        return
    gradient[i] *= factor
    for j in range(n):
        information[i, j] *= factor
    for j in range(n):
        information[j, i] *= factor


@njit(cache=True)
def _step_transposed_times(record: Array, at_gravity: int, X: Array, columns: int, push: Array) -> None:
    """X <- F^T X for the transition F of an IMU step (`imu.rows_times`); gravity's rows stand at at_gravity."""
    dt, blocks, basis = record[0], record[1:46], record[46:52]
    for i in range(3):
        for j in range(columns):
            push[i, j] = X[VELOCITY_ERROR + i, j] + 0.5 * dt * X[POSITION_ERROR + i, j]
    for i in range(3):
        for j in range(columns):
            X[VELOCITY_ERROR + i, j] += dt * X[POSITION_ERROR + i, j]
        for k in range(3):
            b, d, e = blocks[9 + 3 * k + i], blocks[27 + 3 * k + i], blocks[36 + 3 * k + i]
            for j in range(columns):
                X[GYRO_BIAS_ERROR + i, j] += b * X[k, j] + d * push[k, j]
                X[ACCEL_BIAS_ERROR + i, j] += e * push[k, j]
    for j in range(columns):
        x0, x1, x2 = X[0, j], X[1, j], X[2, j]
        for i in range(3):
            X[i, j] = blocks[i] * x0 + blocks[3 + i] * x1 + blocks[6 + i] * x2
            X[i, j] += blocks[18 + i] * push[0, j] + blocks[21 + i] * push[1, j] + blocks[24 + i] * push[2, j]
    if at_gravity >= 0:
        for i in range(2):
            for k in range(3):
                for j in range(columns):
                    X[at_gravity + i, j] += dt * basis[2 * k + i] * push[k, j]


@njit(cache=True)
def _back_over_step(record: Array, layout: Ints, gradient: Array, information: Array, work: Array) -> None:
    n, at_gravity = layout[N_ERROR], layout[AT_GRAVITY]
    push = work[: 3 * n].reshape((3, n))
    _step_transposed_times(record, at_gravity, gradient.reshape((n, 1)), 1, push)
    _step_transposed_times(record, at_gravity, information, n, push)
    # (F^T X) F: only the rows just made have columns still to do; X is symmetric.
    size = CORE + (2 if at_gravity >= 0 else 0)
    corner = work[3 * n : 3 * n + size * size].reshape((size, size))
    for i in range(size):
        for j in range(size):
            corner[j, i] = information[_place(i, at_gravity), _place(j, at_gravity)]
    _step_transposed_times(record, CORE if at_gravity >= 0 else -1, corner, size, push)
    for i in range(size):
        p = _place(i, at_gravity)
        for j in range(n):
            information[j, p] = information[p, j]
    for i in range(size):
        for j in range(size):
            value = 0.5 * (corner[i, j] + corner[j, i])
            information[_place(i, at_gravity), _place(j, at_gravity)] = value


@njit(cache=True, inline="always")
def _place(i: int, at_gravity: int) -> int:
    return i if i < CORE else at_gravity + i - CORE


@njit(cache=True)
def _fold(A: Array, shifts: Array, rows: Ints, gradient: Array, information: Array) -> None:
    """Go back over a map of the attitude's error by A that adds shifts (p, 9) of it to three rows from rows[p] each."""
    n = len(gradient)
    _fold_rows(A, shifts, rows, gradient.reshape((n, 1)), 1)
    _fold_rows(A, shifts, rows, information, n)
    _fold_rows(A, shifts, rows, information.T, n)


@njit(cache=True)
def _fold_rows(A: Array, shifts: Array, rows: Ints, X: Array, columns: int) -> None:
    for j in range(columns):
        x0, x1, x2 = X[0, j], X[1, j], X[2, j]
        for i in range(3):
            total = A[i] * x0 + A[3 + i] * x1 + A[6 + i] * x2
            for part in range(len(rows)):
                S, row = shifts[part], rows[part]
                total += S[i] * X[row, j] + S[3 + i] * X[row + 1, j] + S[6 + i] * X[row + 2, j]
            X[i, j] = total


@njit(cache=True)
def _back_over_odometry(record: Array, gradient: Array, information: Array, work: Array) -> None:
    A, shifts, rows = work[0:9], work[9:18].reshape((1, 9)), np.array([POSITION_ERROR])
    for i in range(3):
        for j in range(3):
            A[3 * i + j] = record[3 * j + i]
            shifts[0, 3 * i + j] = -record[9 + 3 * i + j]
    _fold(A, shifts, rows, gradient, information)


@njit(cache=True)
def _back_over_correction(record: Array, layout: Ints, gradient: Array, information: Array, work: Array) -> None:
    n, parts = layout[N_ERROR], int(record[0])
    rows = np.empty(parts, dtype=np.int64)
    for part in range(parts):
        rows[part] = row_of_part(layout, part)
    at = 10 + 9 * parts
    _fold(record[1:10], record[10:at].reshape((parts, 9)), rows, gradient, information)
    size, count = int(record[at]), int(record[at + 1])
    columns, at = record[at + 2 : at + 2 + count], at + 2 + count
    H, at = record[at : at + size * count].reshape((size, count)), at + size * count
    white, Z = record[at : at + size], record[at + size : at + size + size * n].reshape((size, n))
    U, M = work[: 6 * n].reshape((6, n)), work[6 * n : 6 * n + 36].reshape((6, 6))
    # gradient <- gradient + H^T (white - Z gradient)
    for r in range(size):
        M[0, r] = white[r]
        for i in range(n):
            M[0, r] -= Z[r, i] * gradient[i]
    for r in range(size):
        for c in range(count):
            gradient[int(columns[c])] += H[r, c] * M[0, r]
    _back_over_conditioning(H, columns, Z, information, U, M)


@njit(cache=True)
def _back_over_clock(record: Array, at: int, gradient: Array, information: Array) -> None:
    for i in range(len(record)):
        gradient[at] += record[i] * gradient[i]
        for j in range(len(gradient)):
            information[at, j] += record[i] * information[i, j]
    for i in range(len(record)):
        for j in range(len(gradient)):
            information[j, at] += record[i] * information[j, i]


@njit(cache=True)
def _back_over_conditioning(H: Array, columns: Array, Z: Array, information: Array, U: Array, M: Array) -> None:
    """information <- C^T information C + H^T H with C = I - Z^T H, as information - H^T U - U^T H."""
    size, count, n = len(H), len(columns), len(information)
    for r in range(size):
        for j in range(n):
            U[r, j] = 0.0
        for i in range(n):
            z = Z[r, i]
            for j in range(n):
                U[r, j] += z * information[i, j]
    for r in range(size):
        for q in range(size):
            M[r, q] = 1.0 if r == q else 0.0
            for i in range(n):
                M[r, q] += U[r, i] * Z[q, i]
    for r in range(size):
        for c in range(count):
            for q in range(size):
                U[r, int(columns[c])] -= 0.5 * M[r, q] * H[q, c]
    for r in range(size):
        for c in range(count):
            h, row = H[r, c], int(columns[c])
            for j in range(n):
                information[row, j] -= h * U[r, j]
            for j in range(n):
                information[j, row] -= h * U[r, j]


@njit(cache=True)
def _back_over_cloning(record: Array, layout: Ints, gradient: Array, information: Array) -> None:
    """Go back over xi = R theta, rho = dp + [p]x R theta: what the future says of the clone, it says of the pose."""
    n, at = layout[N_ERROR], layout[AT_CLONE]
    _give_to_pose(record, at, gradient)
    for j in range(n):
        _give_to_pose(record, at, information[:, j])
    for j in range(n):
        _give_to_pose(record, at, information[j])
    for i in range(6):
        _scale(information, gradient, n, at + i, 0.0)


@njit(cache=True)
def _give_to_pose(record: Array, at: int, X: Array) -> None:
    for i in range(3):
        X[POSITION_ERROR + i] += X[at + 3 + i]
        for k in range(3):
            X[i] += record[3 * k + i] * X[at + k] + record[9 + 3 * k + i] * X[at + 3 + k]


@njit(cache=True)
def _back_over_meeting(record: Array, n: int, gradient: Array, information: Array) -> None:
    own, count = int(record[0]), int(record[1])
    columns, G = record[2 : 2 + count], record[2 + count :].reshape((6, count))
    for r in range(6):
        for c in range(count):
            gradient[int(columns[c])] += G[r, c] * gradient[own + r]
            for i in range(n):
                information[i, int(columns[c])] += G[r, c] * information[i, own + r]
    for r in range(6):
        for c in range(count):
            for i in range(n):
                information[int(columns[c]), i] += G[r, c] * information[own + r, i]
    for r in range(6):
        _scale(information, gradient, n, own + r, 0.0)


@njit(cache=True)
def _smooth_row(
    record: Array, layout: Ints, gradient: Array, information: Array, core: Array, covariance: Array, work: Array
) -> None:
    n = len(gradient)
    for i in range(EXTRINSIC_ROTATION):
        core[i] = record[1 + i]
    P = record[1 + EXTRINSIC_ROTATION :].reshape((CORE, n))
    PL, error = work[: CORE * n].reshape((CORE, n)), work[CORE * n : CORE * n + CORE]
    scratch = work[CORE * n + CORE : CORE * n + CORE + 48]
    for a in range(CORE):
        error[a] = 0.0
        for i in range(n):
            error[a] += P[a, i] * gradient[i]
            PL[a, i] = 0.0
        for i in range(n):
            p = P[a, i]
            for j in range(n):
                PL[a, j] += p * information[i, j]
    for a in range(CORE):
        for b in range(a, CORE):
            total = P[a, b]
            for i in range(n):
                total -= PL[a, i] * P[b, i]
            covariance[a, b] = covariance[b, a] = total
    before = scratch[32:47]
    for i in range(15):
        before[i] = core[i]
    inject(core, error, layout, scratch)
    transport(covariance, before, core, error, layout, scratch)
