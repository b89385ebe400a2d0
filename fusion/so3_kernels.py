"""Rotations for compiled loops: 3x3 matrices in flat row-major arrays, no allocation.

Same formulas as `poet_loc.core.geometry` (which the tests hold them against).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.compiled import njit

Array = NDArray[np.float64]

_SMALL = 1e-4


@njit(cache=True)
def copy(source: Array, target: Array) -> None:
    """Write as many numbers as target has; numba's assignment of slices compiles a message for sizes that differ."""
    for i in range(len(target)):
        target[i] = source[i]


@njit(cache=True)
def exp_so3(vx: float, vy: float, vz: float, out: Array) -> None:
    """Write Exp of a rotation vector (rad) into out (9,)."""
    angle2 = vx * vx + vy * vy + vz * vz
    if angle2 < _SMALL * _SMALL:
        first = 1.0 - angle2 / 6.0
        second = 0.5 - angle2 / 24.0
    else:
        angle = math.sqrt(angle2)
        first = math.sin(angle) / angle
        second = (1.0 - math.cos(angle)) / angle2
    out[0] = 1.0 - second * (vy * vy + vz * vz)
    out[1] = second * vx * vy - first * vz
    out[2] = second * vx * vz + first * vy
    out[3] = second * vx * vy + first * vz
    out[4] = 1.0 - second * (vx * vx + vz * vz)
    out[5] = second * vy * vz - first * vx
    out[6] = second * vx * vz - first * vy
    out[7] = second * vy * vz + first * vx
    out[8] = 1.0 - second * (vx * vx + vy * vy)


@njit(cache=True)
def from_quaternion(q: Array, out: Array) -> None:
    """Write the matrix of a quaternion q (4 or more, scalar last), of any norm but 0, into out (9,), which may be q."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    twice = 2.0 / (x * x + y * y + z * z + w * w)
    out[0], out[1], out[2] = 1.0 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)
    out[3], out[4], out[5] = twice * (x * y + z * w), 1.0 - twice * (x * x + z * z), twice * (y * z - x * w)
    out[6], out[7], out[8] = twice * (x * z - y * w), twice * (y * z + x * w), 1.0 - twice * (x * x + y * y)


@njit(cache=True)
def log_so3(m: Array, out: Array) -> None:
    """Write the rotation vector (rad, norm at most pi) of the matrix m (9,) into out (3,)."""
    # The quaternion first: stable at every angle (Shepperd's method).
    trace = m[0] + m[4] + m[8]
    if trace > m[0] and trace > m[4] and trace > m[8]:
        w, x, y, z = 1.0 + trace, m[7] - m[5], m[2] - m[6], m[3] - m[1]
    elif m[0] > m[4] and m[0] > m[8]:
        w, x, y, z = m[7] - m[5], 1.0 + m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6]
    elif m[4] > m[8]:
        w, x, y, z = m[2] - m[6], m[1] + m[3], 1.0 - m[0] + m[4] - m[8], m[5] + m[7]
    else:
        w, x, y, z = m[3] - m[1], m[2] + m[6], m[5] + m[7], 1.0 - m[0] - m[4] + m[8]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    norm_v = math.sqrt(x * x + y * y + z * z)
    norm = math.sqrt(w * w + norm_v * norm_v)
    half_sine = norm_v / norm
    if half_sine < 1e-6:
        factor = 2.0 / norm * (1.0 + half_sine * half_sine / 6.0)
    else:
        factor = 2.0 * math.atan2(norm_v, w) / norm_v
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@njit(cache=True)
def left_jacobian(vx: float, vy: float, vz: float, sign: float, out: Array) -> None:
    """Write J_l(sign * v) into out (9,); sign -1 gives the right Jacobian of v."""
    vx, vy, vz = sign * vx, sign * vy, sign * vz
    angle2 = vx * vx + vy * vy + vz * vz
    if angle2 < _SMALL * _SMALL:
        first = 0.5 - angle2 / 24.0
        second = 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = math.sqrt(angle2)
        first = (1.0 - math.cos(angle)) / angle2
        second = (angle - math.sin(angle)) / (angle2 * angle)
    _identity_plus(vx, vy, vz, first, second, out)


@njit(cache=True)
def left_jacobian_inverse(vx: float, vy: float, vz: float, sign: float, out: Array) -> None:
    """Write the inverse of J_l(sign * v) into out (9,); sign -1 gives that of the right Jacobian."""
    vx, vy, vz = sign * vx, sign * vy, sign * vz
    angle2 = vx * vx + vy * vy + vz * vz
    if angle2 < _SMALL * _SMALL:
        second = 1.0 / 12.0 + angle2 / 720.0
    else:
        half = 0.5 * math.sqrt(angle2)
        second = (1.0 - half * math.cos(half) / math.sin(half)) / angle2
    _identity_plus(vx, vy, vz, -0.5, second, out)


@njit(cache=True)
def _identity_plus(vx: float, vy: float, vz: float, first: float, second: float, out: Array) -> None:
    """Write I + first [v]x + second [v]x^2 into out (9,)."""
    out[0] = 1.0 - second * (vy * vy + vz * vz)
    out[1] = second * vx * vy - first * vz
    out[2] = second * vx * vz + first * vy
    out[3] = second * vx * vy + first * vz
    out[4] = 1.0 - second * (vx * vx + vz * vz)
    out[5] = second * vy * vz - first * vx
    out[6] = second * vx * vz - first * vy
    out[7] = second * vy * vz + first * vx
    out[8] = 1.0 - second * (vx * vx + vy * vy)


@njit(cache=True)
def multiply(a: Array, b: Array, out: Array) -> None:
    """Write a @ b into out (9,); out is neither a nor b."""
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]


@njit(cache=True)
def multiply_transposed_left(a: Array, b: Array, out: Array) -> None:
    """Write a^T @ b into out (9,); out is neither a nor b."""
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = a[i] * b[j] + a[3 + i] * b[3 + j] + a[6 + i] * b[6 + j]


@njit(cache=True)
def multiply_transposed_right(a: Array, b: Array, out: Array) -> None:
    """Write a @ b^T into out (9,); out is neither a nor b."""
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = a[3 * i] * b[3 * j] + a[3 * i + 1] * b[3 * j + 1] + a[3 * i + 2] * b[3 * j + 2]


@njit(cache=True)
def apply(a: Array, x: float, y: float, z: float, out: Array) -> None:
    """Write a @ (x, y, z) into out (3,)."""
    for i in range(3):
        out[i] = a[3 * i] * x + a[3 * i + 1] * y + a[3 * i + 2] * z


@njit(cache=True)
def apply_transposed(a: Array, x: float, y: float, z: float, out: Array) -> None:
    """Write a^T @ (x, y, z) into out (3,)."""
    for i in range(3):
        out[i] = a[i] * x + a[3 + i] * y + a[6 + i] * z


@njit(cache=True)
def times_skew(a: Array, x: float, y: float, z: float, out: Array) -> None:
    """Write a @ skew(x, y, z) into out (9,)."""
    for i in range(3):
        out[3 * i] = a[3 * i + 1] * z - a[3 * i + 2] * y
        out[3 * i + 1] = a[3 * i + 2] * x - a[3 * i] * z
        out[3 * i + 2] = a[3 * i] * y - a[3 * i + 1] * x


@njit(cache=True)
def orthonormalise(m: Array, gram: Array) -> None:
    """Pull m (9,) back onto SO(3), in place; gram (9,) is scratch.

    One step of X <- X (3 I - X^T X) / 2 (Newton's iteration for the polar factor): m is off by rounding only.
    """
    multiply_transposed_left(m, m, gram)
    for i in range(3):
        x, y, z = m[3 * i], m[3 * i + 1], m[3 * i + 2]
        for j in range(3):
            product = x * gram[j] + y * gram[3 + j] + z * gram[6 + j]
            m[3 * i + j] = 1.5 * m[3 * i + j] - 0.5 * product
