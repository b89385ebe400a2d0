"""Start and restart: the pose that the votes of the last second agree on.

Every detection of a known landmark votes for a pose of the imu. While the filter integrates the IMU (at the start from
a level attitude of unknown heading, position and velocity), each vote says how the integrated motion must be turned
and shifted to become the true one. Votes of one truth agree on that correction although the camera moves; gross
errors scatter. A correction that would tilt the measured gravity is refused before it may vote.
"""

from __future__ import annotations

import math

from fusion.compiled import njit
from fusion.nav_state import Array, Ints
from fusion.so3_kernels import apply, exp_so3, log_so3, multiply, multiply_transposed_left, multiply_transposed_right

# A vote: where the detection puts the imu, where the integrated motion had it, and how far away the object is.
VOTE_ROTATION, VOTE_POSITION, MOTION_ROTATION, MOTION_POSITION, VOTE_DISTANCE, VOTE_SIZE = 0, 9, 12, 21, 24, 25

# Places in the options of the start.
(
    MIN_VOTES,
    LONGEST_WINDOW_S,
    MAX_ANGLE,
    MAX_DISTANCE,
    MAX_LEVER,
    MAX_SPEED,
    MAX_TILT,
    START_WINDOW_S,
    START_MIN_SPAN_S,
    LOST_WINDOW_S,
    LOST_SHARE,
    LOST_MIN_VOTES,
    MIN_SHARE,
) = range(13)


@njit(cache=True)
def _shift(votes: Array, i: int, C: Array, origin: Array, gravity: Array, since: float, out: Array) -> None:
    """Write where a correction C puts the displacement that the integrated motion had at vote i.

    origin holds position and velocity that are taken off the integrated motion: what it got wrong may be large.
    Integrated under a tilted gravity, it is off by (g - C g) t^2 / 2 beside that.
    """
    x = votes[i, 21] - origin[0] - since * origin[3]
    y = votes[i, 22] - origin[1] - since * origin[4]
    z = votes[i, 23] - origin[2] - since * origin[5]
    apply(C, x, y, z, out)
    for j in range(3):
        turned = C[3 * j] * gravity[0] + C[3 * j + 1] * gravity[1] + C[3 * j + 2] * gravity[2]
        out[j] += 0.5 * (gravity[j] - turned) * since * since


@njit(cache=True)
def _correction(votes: Array, i: int, origin: Array, gravity: Array, since: float, C: Array, d: Array) -> None:
    """Write the correction that vote i asks for: p_true = C (p_integrated - origin) + d."""
    multiply_transposed_right(votes[i, 0:9], votes[i, 12:21], C)
    _shift(votes, i, C, origin, gravity, since, d)
    for j in range(3):
        d[j] = votes[i, 9 + j] - d[j]


@njit(cache=True)
def _tilt(C: Array, up: Array) -> float:
    """Return the angle (rad) between the corrected up direction and world z."""
    norm = math.sqrt(up[0] ** 2 + up[1] ** 2 + up[2] ** 2)
    if norm == 0.0:  # nothing feels gravity
        return 0.0
    z = (C[6] * up[0] + C[7] * up[1] + C[8] * up[2]) / norm
    return math.acos(min(1.0, max(-1.0, z)))


@njit(cache=True)
def _agree(
    votes: Array,
    i: int,
    C: Array,
    d: Array,
    v: Array,
    origin: Array,
    gravity: Array,
    since: float,
    cosine: float,
    distance: float,
    scratch: Array,
) -> bool:
    """Tell whether vote i lies within an angle and a distance of the correction (C, d + v * since)."""
    turned, shift = scratch[0:9], scratch[9:12]
    multiply(C, votes[i, 12:21], turned)
    trace = 0.0
    for j in range(9):
        trace += turned[j] * votes[i, j]
    if 0.5 * (trace - 1.0) < cosine:
        return False
    _shift(votes, i, C, origin, gravity, since, shift)
    total = 0.0
    for j in range(3):
        total += (votes[i, 9 + j] - shift[j] - d[j] - v[j] * since) ** 2
    return total <= distance * distance


@njit(cache=True)
def largest_agreement(
    votes: Array,
    stamps: Ints,
    first: int,
    head: int,
    now: int,
    up: Array,
    origin: Array,
    gravity: Array,
    options: Array,
    C: Array,
    d: Array,
    v: Array,
    inlier: Ints,
    scratch: Array,
) -> tuple[int, float]:
    """Find the correction most votes agree on; write it to C (9,), d (3,), v (3,); return how many and their span (s).

    votes is a ring whose entries first..head-1 (modulo its length, a power of two) count; inlier (ring length) marks
    those that agree. origin (6,) is the position and velocity that the correction replaces; v is fitted to the agreeing
    votes, so that at stamp `now` position and velocity become d and v. scratch holds 96 floats.
    """
    mask, best, best_i, cosine = len(stamps) - 1, 0, -1, math.cos(options[MAX_ANGLE])
    for j in range(3):
        v[j] = 0.0
    for a in range(first, head):
        i = a & mask
        _correction(votes, i, origin, gravity, (stamps[i] - now) * 1e-9, C, d)
        if _tilt(C, up) > options[MAX_TILT]:
            continue
        count = _mark(votes, stamps, first, head, now, origin, gravity, options, cosine, i, C, d, v, inlier, scratch)
        if count > best:
            best, best_i = count, i
    if best_i < 0:
        return 0, 0.0
    _correction(votes, best_i, origin, gravity, (stamps[best_i] - now) * 1e-9, C, d)
    _mark(votes, stamps, first, head, now, origin, gravity, options, cosine, best_i, C, d, v, inlier, scratch)
    for _ in range(3):
        _refine(votes, stamps, first, head, now, origin, gravity, options, cosine, C, d, v, inlier, scratch)
    count, oldest, newest = 0, now, stamps[best_i]
    for a in range(first, head):
        j = a & mask
        if inlier[j]:
            count, oldest, newest = count + 1, min(oldest, stamps[j]), max(newest, stamps[j])
    return count, max(0.0, (newest - oldest) * 1e-9)


@njit(cache=True)
def _mark(
    votes: Array,
    stamps: Ints,
    first: int,
    head: int,
    now: int,
    origin: Array,
    gravity: Array,
    options: Array,
    cosine: float,
    seed: int,
    C: Array,
    d: Array,
    v: Array,
    inlier: Ints,
    scratch: Array,
) -> int:
    """Mark and count the votes that agree with the correction of one of them, which knows no velocity yet."""
    count = 0
    for b in range(first, head):
        j = b & (len(stamps) - 1)
        reach = options[MAX_DISTANCE] + options[MAX_LEVER] * votes[j, VOTE_DISTANCE]
        reach += options[MAX_SPEED] * abs(stamps[seed] - stamps[j]) * 1e-9
        agrees = _agree(votes, j, C, d, v, origin, gravity, (stamps[j] - now) * 1e-9, cosine, reach, scratch)
        inlier[j] = agrees
        count += agrees
    return count


@njit(cache=True)
def _refine(
    votes: Array,
    stamps: Ints,
    first: int,
    head: int,
    now: int,
    origin: Array,
    gravity: Array,
    options: Array,
    cosine: float,
    C: Array,
    d: Array,
    v: Array,
    inlier: Ints,
    scratch: Array,
) -> None:
    """Average the agreeing votes' corrections, fit offset and velocity to them, and choose them anew."""
    mask = len(stamps) - 1
    vector, mean, turn, shift, other = scratch[48:51], scratch[51:54], scratch[54:63], scratch[63:66], scratch[66:75]
    count = 0
    mean[0] = mean[1] = mean[2] = 0.0
    for a in range(first, head):
        i = a & mask
        if inlier[i]:
            multiply_transposed_right(votes[i, 0:9], votes[i, 12:21], other)
            multiply_transposed_left(C, other, turn)
            log_so3(turn, vector)
            count += 1
            for j in range(3):
                mean[j] += vector[j]
    if count == 0:
        return
    exp_so3(mean[0] / count, mean[1] / count, mean[2] / count, turn)
    multiply(C, turn, other)
    for j in range(9):
        C[j] = other[j]
    # Offset and missing velocity: ridge regression, a velocity counts as MAX_SPEED, a vote as a third of MAX_DISTANCE.
    ridge = (options[MAX_DISTANCE] / 3.0 / options[MAX_SPEED]) ** 2
    for j in range(3):
        sw, st, stt, sy, sty = 0.0, 0.0, ridge, 0.0, 0.0
        for a in range(first, head):
            i = a & mask
            if inlier[i]:
                t = (stamps[i] - now) * 1e-9
                _shift(votes, i, C, origin, gravity, t, shift)
                y = votes[i, 9 + j] - shift[j]
                sw, st, stt, sy, sty = sw + 1.0, st + t, stt + t * t, sy + y, sty + t * y
        determinant = sw * stt - st * st
        d[j] = (stt * sy - st * sty) / determinant
        v[j] = (sw * sty - st * sy) / determinant
    for a in range(first, head):
        i = a & mask
        reach = options[MAX_DISTANCE] + options[MAX_LEVER] * votes[i, VOTE_DISTANCE]
        inlier[i] = _agree(votes, i, C, d, v, origin, gravity, (stamps[i] - now) * 1e-9, cosine, reach, scratch)
