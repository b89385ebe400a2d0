"""A vote: where a measurement puts the imu, up to its object's symmetry, and where the integrated motion had it."""

from __future__ import annotations

import math

from fusion.compiled import njit
from fusion.nav_state import Array
from fusion.so3_kernels import apply, apply_transposed, exp_so3, multiply, multiply_transposed_right
from fusion.symmetry import twist_about

# Poses of the imu as voted (0-11) and as integrated (12-23), then the distance of the object, the object in imu axes
# seen from the imu, and in the world; its symmetry: axis in the world, order (1 none, 0 continuous); its number, -1: a
# camera pose; variances of the whole error: of attitude (rad^2), of place across and along the arm (m^2).
(
    VOTE_DISTANCE,
    VOTE_ARM,
    VOTE_PLACE,
    VOTE_AXIS,
    VOTE_ORDER,
    VOTE_OBJECT,
    VOTE_TURN,
    VOTE_ACROSS,
    VOTE_ALONG,
    VOTE_SIZE,
) = (24, 25, 28, 31, 34, 35, 36, 37, 38, 39)

_STANDS = math.sin(math.radians(20.0))  # an axis nearer to the vertical says nothing of the heading
_APART = 0.1  # m, objects that tell a heading


@njit(cache=True)
def fit_vote(vote: Array, R: Array, out: Array, scratch: Array) -> None:
    """Write the pose (12,) of the imu that a vote asks for; of all that a symmetry allows, the nearest to R (9,)."""
    if vote[VOTE_ORDER] == 1.0:
        for i in range(12):
            out[i] = vote[i]
        return
    difference, vector, axis, arm = scratch[0:9], scratch[9:12], vote[31:34], vote[25:28]
    multiply_transposed_right(R, vote[0:9], difference)
    twist = twist_about(axis, int(vote[VOTE_ORDER]), difference, vector)
    exp_so3(twist * axis[0], twist * axis[1], twist * axis[2], difference)
    multiply(difference, vote[0:9], out)
    apply(out, arm[0], arm[1], arm[2], vector)
    for i in range(3):
        out[9 + i] = vote[VOTE_PLACE + i] - vector[i]


@njit(cache=True)
def turn_of_vote(vote: Array, turn: int, up: Array, C: Array, scratch: Array) -> bool:
    """Write how a vote turns the integrated motion, by which of its object's look-alikes; False: it does not say.

    What a continuous symmetry leaves open follows from up (3,), against gravity (zero: not felt), unless it stands.
    """
    difference, axis, u, turned = scratch[0:9], vote[31:34], scratch[9:12], scratch[12:21]
    multiply_transposed_right(vote[0:9], vote[12:21], C)
    angle = 0.0
    if vote[VOTE_ORDER] > 1.0:
        angle = 2.0 * math.pi * turn / vote[VOTE_ORDER]
    elif vote[VOTE_ORDER] == 0.0:
        across = math.sqrt(axis[0] ** 2 + axis[1] ** 2)
        apply(C, up[0], up[1], up[2], u)
        # Both up directions, across the axis: x along what is left of z there, y = axis x x.
        zx, zy, zz = -axis[2] * axis[0], -axis[2] * axis[1], 1.0 - axis[2] * axis[2]
        x = u[0] * zx + u[1] * zy + u[2] * zz
        y = u[0] * axis[1] - u[1] * axis[0]
        if across < _STANDS or x * x + y * y <= (_STANDS * across) ** 2 * _squared(up):
            return False
        angle = -math.atan2(y, x)
    if angle != 0.0:
        exp_so3(angle * axis[0], angle * axis[1], angle * axis[2], difference)
        multiply(difference, C, turned)
        for i in range(9):
            C[i] = turned[i]
    return True


@njit(cache=True)
def turn_of_pair(one: Array, other: Array, up: Array, C: Array, scratch: Array) -> bool:
    """Write how two objects of one stamp turn the integrated motion: by the line between them and the vertical.

    Where nothing feels gravity (up is zero) the symmetry axis of the first stands in its place. Source: H. Black, "A
    passive system for determining the attitude of a satellite", AIAA J. 2 (1964), which is known as TRIAD.
    """
    seen, known, a, b = scratch[0:9], scratch[9:18], scratch[18:21], scratch[21:24]
    apply(one[12:21], one[25] - other[25], one[26] - other[26], one[27] - other[27], a)
    for i in range(3):
        b[i] = one[VOTE_PLACE + i] - other[VOTE_PLACE + i]
    if _squared(up) > 0.0:
        found = _frame(up[0], up[1], up[2], a, seen) and _frame(0.0, 0.0, 1.0, b, known)
    else:
        axis, in_imu, moved = one[31:34], scratch[24:27], scratch[27:30]
        apply_transposed(one[0:9], axis[0], axis[1], axis[2], in_imu)
        apply(one[12:21], in_imu[0], in_imu[1], in_imu[2], moved)
        found = _frame(moved[0], moved[1], moved[2], a, seen) and _frame(axis[0], axis[1], axis[2], b, known)
    multiply_transposed_right(known, seen, C)
    return found


@njit(cache=True)
def _squared(v: Array) -> float:
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@njit(cache=True)
def _frame(x: float, y: float, z: float, b: Array, out: Array) -> bool:
    """Write the right-handed frame (9,), columns e1 along (x, y, z), e2 across both; False where b hardly leaves e1."""
    norm = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    u, v, w = y * b[2] - z * b[1], z * b[0] - x * b[2], x * b[1] - y * b[0]
    norm = math.sqrt(u * u + v * v + w * w)
    if norm < _APART:
        return False
    u, v, w = u / norm, v / norm, w / norm
    out[0], out[3], out[6] = x, y, z
    out[1], out[4], out[7] = u, v, w
    out[2], out[5], out[8] = y * w - z * v, z * u - x * w, x * v - y * u
    return True
