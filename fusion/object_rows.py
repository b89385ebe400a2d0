"""The parts of an object pose's residual and Jacobian: rotation rows, position rows, and what its biases do to both."""

from __future__ import annotations

from fusion.compiled import njit
from fusion.nav_state import (
    AT_EXTRINSICS,
    AT_OBJECTS,
    BIASES,
    N_BIAS_KINDS,
    N_OBJECTS,
    SPREAD_SIZE,
    SPREADS,
    Array,
    Ints,
)
from fusion.so3_kernels import exp_so3, left_jacobian, log_so3, multiply, multiply_transposed_right


@njit(cache=True)
def sum_biases(x: Array, k: int, layout: Ints, bias: Array, spread: Array) -> None:
    """Write an object's spread (turning, across, along) and the sum of its biases (6,), times that."""
    for i in range(6):
        bias[i] = 0.0
    for kind in range(layout[N_BIAS_KINDS]):
        at = layout[BIASES] + 6 * (k + kind * layout[N_OBJECTS])
        for i in range(6):
            bias[i] += x[at + i]
    for i in range(3 if layout[N_BIAS_KINDS] > 0 else 0):
        spread[i] = x[layout[SPREADS] + SPREAD_SIZE * k + i]
        bias[i] *= x[layout[SPREADS] + SPREAD_SIZE * k]
        bias[3 + i] *= x[layout[SPREADS] + SPREAD_SIZE * k + 1 + i // 2]


@njit(cache=True)
def write_object_residual(
    R_m: Array, t_m: Array, R_co: Array, p_co: Array, axes: Array, bias: Array, residual: Array, work: Array
) -> None:
    """Write measured minus predicted; leave Exp of the rotation bias in work[18:27]."""
    biased, turn, block = work[9:18], work[18:27], work[27:36]
    exp_so3(bias[0], bias[1], bias[2], turn)
    multiply(turn, R_co, biased)
    multiply_transposed_right(R_m, biased, block)
    log_so3(block, residual)
    for i in range(3):
        away = axes[3 * i] * bias[3] + axes[3 * i + 1] * bias[4] + axes[3 * i + 2] * bias[5]
        residual[3 + i] = t_m[i] - p_co[i] - away


@njit(cache=True)
def write_rotation_rows(
    R_ic: Array, R_co: Array, inverse: Array, layout: Ints, at_object: int, H: Array, work: Array
) -> None:
    """Write the rotation rows.

    r(x (+) d) = Log(Exp(r) Exp(-Exp(b) delta)) with delta = -phi - R_ic^T theta + R_co omega.
    """
    product, turn, block = work[9:18], work[18:27], work[27:36]
    multiply(inverse, turn, block)
    if layout[AT_EXTRINSICS] >= 0:
        put(H, 0, 6, -1.0, block)
    multiply_transposed_right(block, R_ic, product)
    put(H, 0, 0, -1.0, product)
    if layout[AT_OBJECTS] >= 0:
        multiply(block, R_co, product)
        put(H, 0, at_object, 1.0, product)


@njit(cache=True)
def write_position_rows(
    R_ic: Array, R_wc: Array, p_io: Array, p_co: Array, layout: Ints, at_object: int, H: Array, work: Array
) -> None:
    """Write the position rows of p_co = R_ic^T (R_wi^T (p_wo - p_wi) - p_ic)."""
    block = work[9:18]
    transposed_times_skew(R_ic, p_io, block)
    put(H, 3, 0, 1.0, block)
    for i in range(3):
        for j in range(3):
            H[3 + i, 3 + j] = -R_wc[3 * j + i]
    if layout[AT_EXTRINSICS] >= 0:
        for i in range(3):
            for j in range(3):
                H[3 + i, 9 + j] = -R_ic[3 * j + i]
        H[3, 7], H[3, 8], H[4, 6] = -p_co[2], p_co[1], p_co[2]
        H[4, 8], H[5, 6], H[5, 7] = -p_co[0], -p_co[1], p_co[0]
    if layout[AT_OBJECTS] >= 0:
        for i in range(3):
            for j in range(3):
                H[3 + i, at_object + 3 + j] = R_wc[3 * j + i]


@njit(cache=True)
def bias_position_rows(bias: Array, count: int, H: Array) -> None:
    """Turn and stretch the position rows so far: t = (1 + c2) p + (-c1, c0, 0) x p."""
    c0, c1, c2 = bias[3], bias[4], bias[5]
    for j in range(count):
        h0, h1, h2 = H[3, j], H[4, j], H[5, j]
        H[3, j] = (1.0 + c2) * h0 + c0 * h2
        H[4, j] = (1.0 + c2) * h1 + c1 * h2
        H[5, j] = (1.0 + c2) * h2 - c0 * h0 - c1 * h1


@njit(cache=True)
def write_bias_columns(
    bias: Array, spread: Array, axes: Array, inverse: Array, kinds: int, start: int, H: Array, work: Array
) -> None:
    """Write the columns of the biases, of which each half acts by its spread."""
    jacobian, block = work[9:18], work[27:36]
    left_jacobian(bias[0], bias[1], bias[2], 1.0, jacobian)
    multiply(inverse, jacobian, block)
    for i in range(9):
        block[i] *= spread[0]
        axes[i] *= spread[2] if i % 3 == 2 else spread[1]
    for kind in range(kinds):
        put(H, 0, start + 6 * kind, 1.0, block)
        put(H, 3, start + 6 * kind + 3, 1.0, axes)


@njit(cache=True)
def put(H: Array, row: int, column: int, sign: float, block: Array) -> None:
    """Write a 3x3 block, times sign, into H."""
    for i in range(3):
        for j in range(3):
            H[row + i, column + j] = sign * block[3 * i + j]


@njit(cache=True)
def transposed_times_skew(a: Array, v: Array, out: Array) -> None:
    """Write a^T [v]x (9,)."""
    for i in range(3):
        out[3 * i] = a[3 + i] * v[2] - a[6 + i] * v[1]
        out[3 * i + 1] = a[6 + i] * v[0] - a[i] * v[2]
        out[3 * i + 2] = a[i] * v[1] - a[3 + i] * v[0]
