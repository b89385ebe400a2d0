"""Start and restart: the pose that the votes of the last second agree on.

Every detection of a known landmark votes for a pose of the imu. While the filter integrates the IMU (at the start from
a level attitude of unknown heading, position and velocity), each vote says how the integrated motion must be turned
and shifted to become the true one. Votes of one truth agree on that correction although the camera moves; gross
errors scatter. A correction that would tilt the measured gravity is refused before it may vote.

Positions are far better than rotations, and a flipped object still shows where it is: a correction is supported by
votes that agree with it whole, and by those whose object is where the map says under it. Symmetric objects vote for
every pose that their symmetry allows, and the heading that one of them leaves open follows from another object.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.compiled import njit
from fusion.nav_state import Array, Ints
from fusion.so3_kernels import apply, multiply
from fusion.start_fit import AT_ITS_PLACE, WHOLE, fit_correction, shift_of
from fusion.votes import (
    VOTE_ARM,
    VOTE_DISTANCE,
    VOTE_OBJECT,
    VOTE_ORDER,
    VOTE_PLACE,
    fit_vote,
    turn_of_pair,
    turn_of_vote,
)

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
    MIN_OBJECTS,
    MIN_PLACES,
    LEAD,
    IS_GIVEN,
    GIVEN_POSE,
) = range(18)
GIVEN_POSE_SIZE = 12  # rotation, position


@njit(cache=True)
def _offset(
    votes: Array, i: int, C: Array, origin: Array, gravity: Array, since: float, d: Array, scratch: Array
) -> None:
    """Write the d of a correction p_true = C (p_integrated - o) + d that puts the object of vote i at its place."""
    turned, arm = scratch[0:9], scratch[9:12]
    multiply(C, votes[i, 12:21], turned)
    apply(turned, votes[i, VOTE_ARM], votes[i, VOTE_ARM + 1], votes[i, VOTE_ARM + 2], arm)
    shift_of(votes, i, C, origin, gravity, since, d)
    for j in range(3):
        d[j] = votes[i, VOTE_PLACE + j] - arm[j] - d[j]


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
) -> tuple[int, float]:
    """Tell what of vote i lies within an angle and a distance of the correction (C, d + v * since), and how well.

    Bits: AT_ITS_PLACE, the object is where the map says; WHOLE, the pose of the imu is the one voted for. Each supports
    the correction by one less its squared share of what is allowed. Source: P. Torr and A. Zisserman, "MLESAC", CVIU 78
    (2000), the score of MSAC.
    """
    turned, shift, fitted = scratch[0:9], scratch[9:12], scratch[12:24]
    multiply(C, votes[i, 12:21], turned)
    shift_of(votes, i, C, origin, gravity, since, shift)
    arm, agrees, support, total = scratch[24:27], 0, 0.0, 0.0
    apply(turned, votes[i, VOTE_ARM], votes[i, VOTE_ARM + 1], votes[i, VOTE_ARM + 2], arm)
    for j in range(3):
        shift[j] += d[j] + v[j] * since
        total += (votes[i, VOTE_PLACE + j] - arm[j] - shift[j]) ** 2
    if total <= distance * distance and votes[i, VOTE_OBJECT] >= 0.0:
        agrees, support = AT_ITS_PLACE, 1.0 - total / distance**2
    fit_vote(votes[i], turned, fitted, scratch[27:48])
    trace, total = 0.0, 0.0
    for j in range(9):
        trace += turned[j] * fitted[j]
    for j in range(3):
        total += (fitted[9 + j] - shift[j]) ** 2
    off = max((1.5 - 0.5 * trace) / (1.0 - cosine), total / distance**2)
    return (agrees + WHOLE, support + 1.0 - off) if off <= 1.0 else (agrees, support)


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
    by_places: bool,
    inlier: Ints,
    scratch: Array,
) -> tuple[int, float, int, int]:
    """Find the correction most votes agree on; write it to C (9,), d (3,), v (3,).

    by_places: votes agree if their object is at its place, however it seems turned; then gravity must be felt.

    Returns how many votes agree and their span (s), how many objects are at their places, and how many agree whole:
    in half of their votes, and in half as many as a start needs.

    votes is a ring whose entries first..head-1 (modulo its length, a power of two) count; inlier (ring length) marks
    what of each agrees. origin (6,) is the position and velocity that the correction replaces; v is fitted to the
    agreeing votes, so that at stamp `now` position and velocity become d and v. scratch holds 256 floats.
    """
    mask, cosine = len(stamps) - 1, math.cos(options[MAX_ANGLE])
    seed = _search(
        votes, stamps, first, head, now, up, origin, gravity, options, C, d, v, 0.0, False, by_places, inlier, scratch
    )
    if seed < 0:
        return 0, 0.0, 0, 0
    for j in range(3):
        v[j] = 0.0
    what = AT_ITS_PLACE if by_places else WHOLE
    _mark(votes, stamps, first, head, now, origin, gravity, options, seed, C, d, v, -1.0, what, inlier, scratch)
    for _ in range(3):
        _refine(votes, stamps, first, head, now, up, origin, gravity, options, C, d, v, what, inlier, scratch)
    count, objects, alike, oldest, newest = 0, 0, 0, now, stamps[seed]
    at_place, whole, seen = scratch[160:192], scratch[192:224], scratch[224:256]
    for k in range(32):
        at_place[k] = whole[k] = seen[k] = 0.0
    for a in range(first, head):
        j = a & mask
        reach = options[MAX_DISTANCE] + options[MAX_LEVER] * votes[j, VOTE_DISTANCE]
        agrees, _ = _agree(votes, j, C, d, v, origin, gravity, (stamps[j] - now) * 1e-9, cosine, reach, scratch)
        k = int(votes[j, VOTE_OBJECT])
        if k >= 0:
            seen[k & 31] += 1.0
            at_place[k & 31] += agrees & AT_ITS_PLACE != 0
            whole[k & 31] += agrees & WHOLE != 0
        if inlier[j] & what:
            count, oldest, newest = count + 1, min(oldest, stamps[j]), max(newest, stamps[j])
    for k in range(32):
        enough = 0.5 * max(options[MIN_VOTES], seen[k])
        objects += at_place[k] >= enough
        alike += whole[k] >= enough
    return count, max(0.0, (newest - oldest) * 1e-9), objects, alike


@njit(cache=True)
def objects_seen(votes: Array, first: int, head: int) -> int:
    """Return how many objects cast the votes first..head-1."""
    seen, count = 0, 0
    for a in range(first, head):
        k = int(votes[a & (len(votes) - 1), VOTE_OBJECT])
        seen |= 1 << (k & 31) if k >= 0 else 0
    while seen > 0:
        count += seen & 1
        seen >>= 1
    return count


@njit(cache=True)
def has_rival(
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
) -> bool:
    """Tell whether quite another correction than the one that `largest_agreement` found is nearly as well supported."""
    other = scratch[117:132]
    for j in range(9):
        other[j] = C[j]
    for j in range(3):
        other[9 + j], other[12 + j] = d[j], v[j]
    least, C2, d2, v2 = scratch[147] / options[LEAD], scratch[132:141], scratch[141:144], scratch[144:147]
    found = _search(
        votes, stamps, first, head, now, up, origin, gravity, options, C2, d2, v2, least, True, False, inlier, scratch
    )
    if found >= 0:
        return True
    # What a velocity that is not known yet hides shows once it is fitted, as it was for the correction itself.
    found = _search(
        votes, stamps, first, head, now, up, origin, gravity, options, C2, d2, v2, 0.0, True, False, inlier, scratch
    )
    if found < 0:
        return False
    marks = np.zeros(len(stamps), dtype=np.int64)
    _mark(votes, stamps, first, head, now, origin, gravity, options, found, C2, d2, v2, -1.0, WHOLE, marks, scratch)
    for _ in range(3):
        _refine(votes, stamps, first, head, now, up, origin, gravity, options, C2, d2, v2, WHOLE, marks, scratch)
    if not _is_another(votes[found, VOTE_DISTANCE], C2, d2, 0.0, options, scratch):
        return False
    of_rival = _mark(votes, stamps, first, head, now, origin, gravity, options, -1, C2, d2, v2, 0.0, 0, marks, scratch)
    own = _mark(votes, stamps, first, head, now, origin, gravity, options, -1, C, d, v, 0.0, 0, marks, scratch)
    return of_rival * options[LEAD] > own


@njit(cache=True)
def _search(
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
    still: Array,
    least: float,
    elsewhere: bool,
    pairs: bool,
    inlier: Ints,
    scratch: Array,
) -> int:
    """Write the best supported correction of all that votes ask for to C and d; return the vote that asked, -1: none.

    Its support must exceed `least`; elsewhere: it must be quite another than that in scratch[117:132], else its support
    is left in scratch[147]. pairs: any two objects may ask for one, not only where one is a can that stands.
    """
    mask, best, seed, newest = len(stamps) - 1, least, -1, stamps[(head - 1) & (len(stamps) - 1)]
    C1, d1 = scratch[48:57], scratch[57:60]
    for j in range(3):
        still[j] = 0.0
    for a in range(first, head):
        i = a & mask
        order, since = int(votes[i, VOTE_ORDER]), (stamps[i] - now) * 1e-9
        turns = max(order, 1)
        others = head - first if (order == 0 or pairs) and stamps[i] == newest else 0
        for b in range(turns + others):
            if b < turns:
                asked = turn_of_vote(votes[i], b, up, C1, scratch)
            else:
                k = (first + b - turns) & mask
                asked = stamps[k] == newest and votes[k, VOTE_OBJECT] != votes[i, VOTE_OBJECT]
                asked = asked and votes[k, VOTE_OBJECT] >= 0.0 and turn_of_pair(votes[i], votes[k], up, C1, scratch)
            if not asked or _tilt(C1, up) > options[MAX_TILT]:
                continue
            _offset(votes, i, C1, origin, gravity, since, d1, scratch)
            if elsewhere and not _is_another(votes[i, VOTE_DISTANCE], C1, d1, since, options, scratch):
                continue
            support = _mark(
                votes,
                stamps,
                first,
                head,
                now,
                origin,
                gravity,
                options,
                i,
                C1,
                d1,
                still,
                best,
                0,
                inlier,
                scratch,
            )
            if support > best:
                best, seed = support, i
                for j in range(9):
                    C[j] = C1[j]
                for j in range(3):
                    d[j] = d1[j]
    if not elsewhere:
        scratch[147] = best
    return seed


@njit(cache=True)
def _is_another(distance: float, C: Array, d: Array, since: float, options: Array, scratch: Array) -> bool:
    """Tell whether a correction is further from that in scratch[117:132] than poor votes for the same one may be."""
    trace, gap = 0.0, 0.0
    for j in range(9):
        trace += C[j] * scratch[117 + j]
    for j in range(3):
        gap += (d[j] - scratch[126 + j] - since * scratch[129 + j]) ** 2
    reach = 4.0 * (options[MAX_DISTANCE] + options[MAX_LEVER] * distance)
    return 0.5 * (trace - 1.0) < math.cos(min(3.0 * options[MAX_ANGLE], math.pi)) or gap > reach * reach


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
    seed: int,
    C: Array,
    d: Array,
    v: Array,
    least: float,
    what: int,
    inlier: Ints,
    scratch: Array,
) -> float:
    """Return how much votes support the correction of one of them, which knows no velocity yet (seed -1: it does).

    Stops where the sum cannot exceed `least` any more; what: 0, or else mark what of each vote agrees.
    """
    support, cosine = 0.0, math.cos(options[MAX_ANGLE])
    for b in range(first, head):
        if what == 0 and support + 2.0 * (head - b) <= least:
            return support
        j = b & (len(stamps) - 1)
        reach = options[MAX_DISTANCE] + options[MAX_LEVER] * votes[j, VOTE_DISTANCE]
        if seed >= 0:
            reach += options[MAX_SPEED] * abs(stamps[seed] - stamps[j]) * 1e-9
        agrees, well = _agree(votes, j, C, d, v, origin, gravity, (stamps[j] - now) * 1e-9, cosine, reach, scratch)
        support += well
        if what > 0:
            inlier[j] = agrees
    return support


@njit(cache=True)
def _refine(
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
    what: int,
    inlier: Ints,
    scratch: Array,
) -> None:
    """Fit the correction to the votes that agree, and choose these anew."""
    fit_correction(
        votes, stamps, first, head, now, up, origin, gravity, options[MAX_SPEED], options[MAX_TILT], C, d, v, inlier
    )
    cosine = math.cos(options[MAX_ANGLE])
    for a in range(first, head):
        i = a & (len(stamps) - 1)
        reach = options[MAX_DISTANCE] + options[MAX_LEVER] * votes[i, VOTE_DISTANCE]
        agrees, _ = _agree(votes, i, C, d, v, origin, gravity, (stamps[i] - now) * 1e-9, cosine, reach, scratch)
        inlier[i] = agrees
