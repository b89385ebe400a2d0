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

from fusion.ballot import (
    AT_ITS_PLACE,
    CORRECTION_SIZE,
    LEAD,
    MAX_ANGLE,
    MAX_DISTANCE,
    MAX_LEVER,
    MAX_SPEED,
    MAX_TILT,
    MIN_VOTES,
    WHOLE,
    Ballot,
    Correction,
    correction_in,
    seconds_since,
)
from fusion.compiled import njit
from fusion.nav_state import Array
from fusion.so3_kernels import apply, multiply
from fusion.start_fit import fit_correction, shift_of
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


@njit(cache=True)
def largest_agreement(ballot: Ballot, found: Correction, by_places: bool) -> tuple[int, float, int, int]:
    """Find the correction that most votes agree on, for the origin that it has.

    by_places: votes agree if their object is at its place, however it seems turned; then gravity must be felt.

    Returns how many votes agree and their span (s), how many objects are at their places, and how many agree whole:
    in half of their votes, and in half as many as a start needs.
    """
    seed = _search(ballot, found, 0.0, found, False, by_places)
    if seed < 0:
        return 0, 0.0, 0, 0
    _fit(ballot, found, seed)
    what = AT_ITS_PLACE if by_places else WHOLE
    count, oldest, newest = 0, ballot.now, ballot.stamps[seed]
    for a in range(ballot.first, ballot.head):
        i = a & (len(ballot.stamps) - 1)
        if found.agreed[i] & what:
            count, oldest, newest = count + 1, min(oldest, ballot.stamps[i]), max(newest, ballot.stamps[i])
    return (
        count,
        max(0.0, (newest - oldest) * 1e-9),
        _objects(ballot, found, AT_ITS_PLACE),
        _objects(ballot, found, WHOLE),
    )


@njit(cache=True)
def _objects(ballot: Ballot, correction: Correction, what: int) -> int:
    """Return how many objects agree in half of their votes, and in half as many as a start needs."""
    seen, agreeing = ballot.scratch[160:192], ballot.scratch[192:224]
    for k in range(32):
        seen[k] = agreeing[k] = 0.0
    for a in range(ballot.first, ballot.head):
        i = a & (len(ballot.stamps) - 1)
        k = int(ballot.votes[i, VOTE_OBJECT])
        if k >= 0:
            seen[k & 31] += 1.0
            agreeing[k & 31] += correction.agreed[i] & what != 0
    count = 0
    for k in range(32):
        count += agreeing[k] >= 0.5 * max(ballot.options[MIN_VOTES], seen[k])
    return count


@njit(cache=True)
def feels_gravity(ballot: Ballot) -> bool:
    """Tell whether the votes are told where up is; places alone say nothing without it."""
    return ballot.up[0] != 0.0 or ballot.up[1] != 0.0 or ballot.up[2] != 0.0


@njit(cache=True)
def objects_seen(ballot: Ballot) -> int:
    """Return how many objects cast the votes."""
    seen, count = 0, 0
    for a in range(ballot.first, ballot.head):
        k = int(ballot.votes[a & (len(ballot.stamps) - 1), VOTE_OBJECT])
        seen |= 1 << (k & 31) if k >= 0 else 0
    while seen > 0:
        count += seen & 1
        seen >>= 1
    return count


@njit(cache=True)
def has_rival(ballot: Ballot, found: Correction) -> bool:
    """Tell whether quite another correction than the one that `largest_agreement` found is nearly as well supported."""
    room, lead = ballot.scratch[118 : 118 + CORRECTION_SIZE], ballot.options[LEAD]
    rival = correction_in(room, np.zeros(len(ballot.stamps), dtype=np.int64))
    for j in range(6):
        rival.origin[j] = found.origin[j]
    if _search(ballot, rival, found.support[0] / lead, found, True, False) >= 0:
        return True
    # What a velocity that is not known yet hides shows once it is fitted, as it was for the correction itself.
    seed = _search(ballot, rival, 0.0, found, True, False)
    if seed < 0:
        return False
    _fit(ballot, rival, seed)
    if not _is_another(ballot, seed, rival, 0.0, found):
        return False
    return _support(ballot, rival, -1, 0.0) * lead > _support(ballot, found, -1, 0.0)


@njit(cache=True)
def _search(ballot: Ballot, best: Correction, least: float, found: Correction, elsewhere: bool, pairs: bool) -> int:
    """Write the best supported correction of all that votes ask for to `best`; return the vote that asked, -1: none.

    Its support must exceed `least`; elsewhere: it must be quite another than `found`. pairs: any two objects may ask
    for one, not only where one is a can that stands.
    """
    asked, seed = correction_in(ballot.scratch[48 : 48 + CORRECTION_SIZE], best.agreed), -1
    best.support[0] = least
    for j in range(3):
        best.v[j] = asked.v[j] = 0.0
    for j in range(6):
        asked.origin[j] = best.origin[j]
    for a in range(ballot.first, ballot.head):
        i = a & (len(ballot.stamps) - 1)
        for way in range(_ways(ballot, i, pairs)):
            if not _asks(ballot, i, way, asked):
                continue
            if elsewhere and not _is_another(ballot, i, asked, seconds_since(ballot, i), found):
                continue
            support = _support(ballot, asked, i, best.support[0])
            if support > best.support[0]:
                best.support[0], seed = support, i
                for j in range(9):
                    best.C[j] = asked.C[j]
                for j in range(3):
                    best.d[j] = asked.d[j]
    return seed


@njit(cache=True)
def _ways(ballot: Ballot, i: int, pairs: bool) -> int:
    """Return how many corrections vote i may ask for: one per look-alike; then beside each other vote of its stamp."""
    newest = ballot.stamps[(ballot.head - 1) & (len(ballot.stamps) - 1)]
    order = int(ballot.votes[i, VOTE_ORDER])
    beside = (order == 0 or pairs) and ballot.stamps[i] == newest
    return max(order, 1) + (ballot.head - ballot.first if beside else 0)


@njit(cache=True)
def _asks(ballot: Ballot, i: int, way: int, asked: Correction) -> bool:
    """Write the correction that vote i asks for in one of its ways; False: it asks for none, or gravity forbids it."""
    votes, stamps = ballot.votes, ballot.stamps
    turns = max(int(votes[i, VOTE_ORDER]), 1)
    if way < turns:
        turned = turn_of_vote(votes[i], way, ballot.up, asked.C, ballot.scratch)
    else:
        k = (ballot.first + way - turns) & (len(stamps) - 1)
        turned = stamps[k] == stamps[i] and votes[k, VOTE_OBJECT] != votes[i, VOTE_OBJECT]
        turned = turned and votes[k, VOTE_OBJECT] >= 0.0
        turned = turned and turn_of_pair(votes[i], votes[k], ballot.up, asked.C, ballot.scratch)
    if not turned or _tilt(asked.C, ballot.up) > ballot.options[MAX_TILT]:
        return False
    _put_at_its_place(ballot, i, asked)
    return True


@njit(cache=True)
def _tilt(C: Array, up: Array) -> float:
    """Return the angle (rad) between the corrected up direction and world z."""
    norm = math.sqrt(up[0] ** 2 + up[1] ** 2 + up[2] ** 2)
    if norm == 0.0:  # nothing feels gravity
        return 0.0
    z = (C[6] * up[0] + C[7] * up[1] + C[8] * up[2]) / norm
    return math.acos(min(1.0, max(-1.0, z)))


@njit(cache=True)
def _put_at_its_place(ballot: Ballot, i: int, correction: Correction) -> None:
    """Write the d of a correction that puts the object of vote i at its place."""
    turned, arm, vote, d = ballot.scratch[0:9], ballot.scratch[9:12], ballot.votes[i], correction.d
    multiply(correction.C, vote[12:21], turned)
    apply(turned, vote[VOTE_ARM], vote[VOTE_ARM + 1], vote[VOTE_ARM + 2], arm)
    shift_of(ballot, i, correction, d)
    for j in range(3):
        d[j] = vote[VOTE_PLACE + j] - arm[j] - d[j]


@njit(cache=True)
def _is_another(ballot: Ballot, i: int, one: Correction, since: float, found: Correction) -> bool:
    """Tell whether a correction that vote i asked for is further from `found` than poor votes for the same one may be.

    Both are compared where they put the imu at a time (s).
    """
    options, trace, gap = ballot.options, 0.0, 0.0
    for j in range(9):
        trace += one.C[j] * found.C[j]
    for j in range(3):
        gap += (one.d[j] - found.d[j] - since * found.v[j]) ** 2
    reach = 4.0 * (options[MAX_DISTANCE] + options[MAX_LEVER] * ballot.votes[i, VOTE_DISTANCE])
    return 0.5 * (trace - 1.0) < math.cos(min(3.0 * options[MAX_ANGLE], math.pi)) or gap > reach * reach


@njit(cache=True)
def _fit(ballot: Ballot, correction: Correction, seed: int) -> None:
    """Fit a correction that vote `seed` asked for to the votes that agree, and choose these anew."""
    _mark(ballot, correction, seed)
    for _ in range(3):
        fit_correction(ballot, correction)
        _mark(ballot, correction, -1)


@njit(cache=True)
def _support(ballot: Ballot, correction: Correction, seed: int, least: float) -> float:
    """Return how much votes support a correction; the sum stops where it cannot exceed `least` any more.

    seed: the vote that asked for it, which knows no velocity yet; -1: its velocity is fitted.
    """
    total, cosine = 0.0, math.cos(ballot.options[MAX_ANGLE])
    for a in range(ballot.first, ballot.head):
        if total + 2.0 * (ballot.head - a) <= least:
            break
        total += _agree(ballot, a & (len(ballot.stamps) - 1), correction, seed, cosine)[1]
    return total


@njit(cache=True)
def _mark(ballot: Ballot, correction: Correction, seed: int) -> None:
    """Write down what of each vote agrees with a correction; seed as in `_support`."""
    cosine = math.cos(ballot.options[MAX_ANGLE])
    for a in range(ballot.first, ballot.head):
        i = a & (len(ballot.stamps) - 1)
        correction.agreed[i] = _agree(ballot, i, correction, seed, cosine)[0]


@njit(cache=True)
def _agree(ballot: Ballot, i: int, correction: Correction, seed: int, cosine: float) -> tuple[int, float]:
    """Tell what of vote i agrees with a correction, within an angle and a distance, and how well.

    Bits: AT_ITS_PLACE, the object is where the map says; WHOLE, the pose of the imu is the one voted for. Each supports
    the correction by one less its squared share of what is allowed. Source: P. Torr and A. Zisserman, "MLESAC", CVIU 78
    (2000), the score of MSAC.
    """
    vote, scratch, since = ballot.votes[i], ballot.scratch, seconds_since(ballot, i)
    turned, shift, fitted, arm = scratch[0:9], scratch[9:12], scratch[12:24], scratch[24:27]
    agrees, support, total, distance = 0, 0.0, 0.0, _reach(ballot, i, seed)
    multiply(correction.C, vote[12:21], turned)
    shift_of(ballot, i, correction, shift)
    apply(turned, vote[VOTE_ARM], vote[VOTE_ARM + 1], vote[VOTE_ARM + 2], arm)
    for j in range(3):
        shift[j] += correction.d[j] + correction.v[j] * since
        total += (vote[VOTE_PLACE + j] - arm[j] - shift[j]) ** 2
    if total <= distance * distance and vote[VOTE_OBJECT] >= 0.0:
        agrees, support = AT_ITS_PLACE, 1.0 - total / distance**2
    fit_vote(vote, turned, fitted, scratch[27:48])
    trace, total = 0.0, 0.0
    for j in range(9):
        trace += turned[j] * fitted[j]
    for j in range(3):
        total += (fitted[9 + j] - shift[j]) ** 2
    off = max((1.5 - 0.5 * trace) / (1.0 - cosine), total / distance**2)
    return (agrees + WHOLE, support + 1.0 - off) if off <= 1.0 else (agrees, support)


@njit(cache=True)
def _reach(ballot: Ballot, i: int, seed: int) -> float:
    """Return how far off (m) vote i may be; more where the velocity since the vote that asked is not known."""
    options = ballot.options
    reach = options[MAX_DISTANCE] + options[MAX_LEVER] * ballot.votes[i, VOTE_DISTANCE]
    if seed >= 0:
        reach += options[MAX_SPEED] * abs(ballot.stamps[seed] - ballot.stamps[i]) * 1e-9
    return reach
