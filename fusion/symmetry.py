"""The turn of a symmetric object that nobody can tell: which of its look-alikes is meant."""

from __future__ import annotations

import math

from fusion.compiled import njit
from fusion.nav_state import Array
from fusion.so3_kernels import exp_so3, log_so3, multiply, multiply_transposed_left


@njit(cache=True)
def twist_about(axis: Array, order: int, difference: Array, vector: Array) -> float:
    """Return by what turn (rad) about a symmetry axis a rotation `difference` (9,) is matched best; vector is scratch.

    order n > 1: a multiple of 2 pi / n; 0: any.
    """
    log_so3(difference, vector)
    angle = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    along = axis[0] * vector[0] + axis[1] * vector[1] + axis[2] * vector[2]
    sine = along * (math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5)
    twist = 2.0 * math.atan2(sine, math.cos(0.5 * angle))
    if order > 1:
        step = 2.0 * math.pi / order
        twist = step * math.floor(twist / step + 0.5)
    return twist


@njit(cache=True)
def fit_symmetry(R_m: Array, R_co: Array, axis: Array, order: int, R: Array, scratch: Array) -> None:
    """Turn a measured rotation R_m (9,), in place, about the symmetry axis to where it fits the prediction best.

    order 1: none; n > 1: by a multiple of 2 pi / n; 0: continuous, and then the variance about the axis in R (6, 6)
    becomes so large that only the two rows across it count. The best turn is the twist of R_m^T R_co about the axis.
    """
    if order == 1:
        return
    difference, vector, turn = scratch[0:9], scratch[9:12], scratch[12:21]
    multiply_transposed_left(R_m, R_co, difference)
    twist = twist_about(axis, order, difference, vector)
    exp_so3(twist * axis[0], twist * axis[1], twist * axis[2], turn)
    multiply(R_m, turn, difference)
    for i in range(9):
        R_m[i] = difference[i]
    if order == 0:
        for i in range(3):
            for j in range(3):
                a_i = R_m[3 * i] * axis[0] + R_m[3 * i + 1] * axis[1] + R_m[3 * i + 2] * axis[2]
                a_j = R_m[3 * j] * axis[0] + R_m[3 * j + 1] * axis[1] + R_m[3 * j + 2] * axis[2]
                R[i, j] += 1e3 * a_i * a_j
