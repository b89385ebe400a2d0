"""Where the filter starts, and starts again when it is lost: from votes that agree with each other."""

from __future__ import annotations

import math

from fusion.ballot import (
    FEW_SPAN_S,
    FEW_VOTES,
    GIVEN_POSE,
    IS_GIVEN,
    LONGEST_WINDOW_S,
    LOST_MIN_VOTES,
    LOST_SHARE,
    LOST_SIGMA,
    LOST_WINDOW_S,
    MAX_TILT,
    MIN_OBJECTS,
    MIN_PLACES,
    MIN_SHARE,
    MIN_VOTES,
    START_MIN_SPAN_S,
    START_WINDOW_S,
    Ballot,
    agreed_correction,
)
from fusion.compiled import njit
from fusion.consensus import feels_gravity, has_rival, largest_agreement, objects_seen
from fusion.eskf import POSITION_ONLY
from fusion.measurements import OBJECT_POSE
from fusion.meeting import forget_rivals
from fusion.memory import (
    BIAS_TIME,
    CLONED,
    FIRST_VOTE,
    INITIALISING,
    LAST_UPDATE,
    MODE,
    NOW,
    RESTARTS,
    STARTED_AT,
    TRACKING,
    UNHELD_ROW,
    UNSURE_AT,
    VOTE_HEAD,
    Memory,
    Work,
)
from fusion.nav_state import (
    ACCEL_BIAS,
    AT_BIASES,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    BIASES,
    CORE,
    EXTRINSIC_POSITION,
    EXTRINSIC_ROTATION,
    GRAVITY,
    GYRO_BIAS_ERROR,
    N_BIAS_KINDS,
    N_ERROR,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    SPREAD_SIZE,
    SPREADS,
    VELOCITY,
    Array,
)
from fusion.object_biases import bias_sigma, is_fair
from fusion.place_watch import ON_MAP, forget_places, status_of
from fusion.so3_kernels import (
    apply,
    multiply,
    multiply_transposed_right,
)
from fusion.tape import note_restart, survives
from fusion.votes import (
    VOTE_ACROSS,
    VOTE_ALONG,
    VOTE_ARM,
    VOTE_AXIS,
    VOTE_DISTANCE,
    VOTE_OBJECT,
    VOTE_ORDER,
    VOTE_PLACE,
    VOTE_TURN,
)


@njit(cache=True)
def cast_vote(
    m: Memory, w: Work, kind: int, k: int, rotation: Array, translation: Array, covariance: Array, decision: int
) -> None:
    """Remember where a measurement puts the imu."""
    if kind == OBJECT_POSE and (m.known[k] == 0.0 or status_of(m, kind, k) != ON_MAP):
        return
    slot = m.counters[VOTE_HEAD] & (len(m.vote_stamps) - 1)
    vote = m.votes[slot]
    if kind == OBJECT_POSE:
        _vote_of_object(m, w, k, rotation, translation, covariance, vote)
    else:
        _vote_of_camera(m, w, rotation, translation, covariance, vote)
    for i in range(9):
        vote[12 + i] = m.x[i]
    for i in range(3):
        vote[21 + i] = m.x[POSITION + i]
    # Neither rotation alone holds the position nor what was let in as a gross error of its object.
    m.used[slot] = decision & POSITION_ONLY if kind != OBJECT_POSE or is_fair(m, k) else 0
    m.vote_stamps[slot] = m.counters[NOW]
    m.counters[VOTE_HEAD] += 1


@njit(cache=True)
def _vote_of_camera(m: Memory, w: Work, R_wc: Array, p_wc: Array, covariance: Array, vote: Array) -> None:
    """Write what a camera pose says."""
    _write_imu(m, w, R_wc, p_wc, vote)
    for i in range(3):
        vote[VOTE_ARM + i], vote[VOTE_PLACE + i], vote[VOTE_AXIS + i] = 0.0, vote[9 + i], 0.0
    vote[VOTE_ORDER], vote[VOTE_OBJECT], vote[VOTE_DISTANCE] = 1.0, -1.0, 1.0
    vote[VOTE_TURN] = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3.0
    vote[VOTE_ACROSS] = vote[VOTE_ALONG] = (covariance[3, 3] + covariance[4, 4] + covariance[5, 5]) / 3.0


@njit(cache=True)
def _vote_of_object(m: Memory, w: Work, k: int, R_co: Array, p_co: Array, covariance: Array, vote: Array) -> None:
    """Write what an object's pose in the camera says, the object standing where the map says."""
    R_wc, lever, p_wc, at = w.step[0:9], w.step[9:12], w.step[12:15], OBJECTS + OBJECT_SIZE * k
    multiply_transposed_right(m.x[at : at + 9], R_co, R_wc)
    apply(R_wc, p_co[0], p_co[1], p_co[2], lever)
    for i in range(3):
        p_wc[i] = m.x[at + 9 + i] - lever[i]
    _write_imu(m, w, R_wc, p_wc, vote)
    axis, R_ic = m.axes[k], m.x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9]
    vote[VOTE_ORDER], vote[VOTE_OBJECT] = m.orders[k], k
    apply(m.x[at : at + 9], axis[0], axis[1], axis[2], vote[VOTE_AXIS : VOTE_AXIS + 3])
    apply(R_ic, p_co[0], p_co[1], p_co[2], lever)
    for i in range(3):
        vote[VOTE_ARM + i] = m.x[EXTRINSIC_POSITION + i] + lever[i]
        vote[VOTE_PLACE + i] = m.x[at + 9 + i]
    vote[VOTE_DISTANCE] = math.sqrt(p_co[0] ** 2 + p_co[1] ** 2 + p_co[2] ** 2)
    _write_variances(m, k, p_co, covariance, vote)


@njit(cache=True)
def _write_imu(m: Memory, w: Work, R_wc: Array, p_wc: Array, vote: Array) -> None:
    """Write where the imu is when the camera is at a pose."""
    R_wi, lever, p_ic = vote[0:9], w.step[15:18], m.x[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3]
    multiply_transposed_right(R_wc, m.x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9], R_wi)
    apply(R_wi, p_ic[0], p_ic[1], p_ic[2], lever)
    for i in range(3):
        vote[9 + i] = p_wc[i] - lever[i]


@njit(cache=True)
def _write_variances(m: Memory, k: int, p_co: Array, covariance: Array, vote: Array) -> None:
    """Write the variances of an object's whole error, biases and all."""
    whole, along, distance = covariance[3, 3] + covariance[4, 4] + covariance[5, 5], 0.0, vote[VOTE_DISTANCE]
    vote[VOTE_TURN] = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3.0
    for i in range(3):
        for j in range(3):
            along += p_co[i] * covariance[3 + i, 3 + j] * p_co[j] / (distance * distance)
    vote[VOTE_ACROSS], vote[VOTE_ALONG] = 0.5 * (whole - along), along
    spread = m.x[m.layout[SPREADS] + SPREAD_SIZE * k :]
    for bias in range(m.layout[N_BIAS_KINDS]):
        vote[VOTE_TURN] += (spread[0] * bias_sigma(m.bias_model, bias, 0)) ** 2
        vote[VOTE_ACROSS] += (distance * spread[1] * bias_sigma(m.bias_model, bias, 3)) ** 2
        vote[VOTE_ALONG] += (distance * spread[2] * bias_sigma(m.bias_model, bias, 5)) ** 2


@njit(cache=True)
def first_vote(m: Memory, window_s: float, wanted: int) -> int:
    """Return where the votes of the window start; a window with fewer than wanted votes reaches further back.

    None reaches back to before the motion began or the state lost its attitude.
    """
    head, capacity = m.counters[VOTE_HEAD], len(m.vote_stamps)
    first = head
    while first > m.counters[FIRST_VOTE] and head - first < capacity - 1:
        cast_at = m.vote_stamps[(first - 1) & (capacity - 1)]
        age = (m.counters[NOW] - cast_at) * 1e-9
        if cast_at < m.counters[UNSURE_AT]:
            break
        if age > m.start[LONGEST_WINDOW_S] or (age > window_s and head - first >= wanted):
            break
        first -= 1
    return first


@njit(cache=True)
def used_since(m: Memory, first: int) -> float:
    """Return how many of the votes since `first` the filter took the position in of."""
    used = 0.0
    for a in range(first, m.counters[VOTE_HEAD]):
        used += m.used[a & (len(m.vote_stamps) - 1)]
    return used


@njit(cache=True)
def _agreement(m: Memory, w: Work, first: int, by_places: bool) -> tuple[int, float, int, int]:
    """Return what `largest_agreement` says of the votes since `first`, and leave it the agreed correction.

    The integrated velocity may be right (the votes jump) or wrong (there were none for long), so both are tried.
    """
    kept = _agreement_beside(m, w, first, 0.0, by_places)
    replaced = _agreement_beside(m, w, first, 1.0, by_places)
    return _agreement_beside(m, w, first, 0.0, by_places) if kept[0] >= replaced[0] else replaced


@njit(cache=True)
def _agreement_beside(
    m: Memory, w: Work, first: int, share_of_velocity: float, by_places: bool
) -> tuple[int, float, int, int]:
    agreed = agreed_correction(m, w)
    for i in range(3):
        agreed.origin[i] = m.x[POSITION + i]
        agreed.origin[3 + i] = share_of_velocity * m.x[VELOCITY + i]
    return largest_agreement(_ballot(m, w, first), agreed, by_places)


@njit(cache=True, _nrt=True)
def _ballot(m: Memory, w: Work, first: int) -> Ballot:
    """Return the votes since `first`."""
    up, gravity = w.step[150:153], m.x[GRAVITY : GRAVITY + 3]
    for i in range(3):
        up[i] = m.up[i] if m.start[MAX_TILT] < math.pi else 0.0
    return Ballot(m.votes, m.vote_stamps, first, m.counters[VOTE_HEAD], m.counters[NOW], up, gravity, m.start, w.step)


@njit(cache=True)
def _is_contested(m: Memory, w: Work, first: int) -> bool:
    """Tell whether the agreement that was found has a rival."""
    return has_rival(_ballot(m, w, first), agreed_correction(m, w))


@njit(cache=True)
def starts(m: Memory, w: Work) -> bool:
    """Start, or start again, where the votes up to now call for it; tell whether it did."""
    if m.counters[MODE] == INITIALISING:
        return _starts_first(m, w)
    return _starts_adrift(m, w) or _starts_again(m, w)


@njit(cache=True)
def _starts_first(m: Memory, w: Work) -> bool:
    """Start at the pose that is given, or where enough votes agree and no other pose has nearly as many.

    The pose that is given is where the log began, not where a filter that gave up is by now.
    """
    if m.start[IS_GIVEN] > 0.0 and m.counters[RESTARTS] == 0:
        _agree_with_given_pose(m, w)
    elif not _found_by_votes(m, w):
        return False
    adopt(m, w, 0)
    m.counters[MODE], m.counters[STARTED_AT], m.counters[LAST_UPDATE] = TRACKING, m.counters[NOW], m.counters[NOW]
    return True


@njit(cache=True)
def _agree_with_given_pose(m: Memory, w: Work) -> None:
    """Write the correction that takes the state to the given pose, standing still, as `_agreement` does."""
    agreed, at = agreed_correction(m, w), GIVEN_POSE
    multiply_transposed_right(m.start[at : at + 9], m.x[0:9], agreed.C)
    for i in range(3):
        agreed.d[i], agreed.v[i] = m.start[at + 9 + i], 0.0
        agreed.origin[i], agreed.origin[3 + i] = m.x[POSITION + i], m.x[VELOCITY + i]
    agreed.agreed[:] = 0


@njit(cache=True)
def _found_by_votes(m: Memory, w: Work) -> bool:
    """Tell whether enough votes agree and have no rival; leave their correction to `adopt`."""
    first = first_vote(m, m.start[START_WINDOW_S], 2 * int(m.start[MIN_VOTES]))
    count, span, objects, alike = _agreement(m, w, first, False)
    total = m.counters[VOTE_HEAD] - first
    needed = m.start[FEW_VOTES] if span >= m.start[FEW_SPAN_S] else m.start[MIN_VOTES]
    if count < max(needed, m.start[MIN_SHARE] * total):
        ballot = _ballot(m, w, first)
        if objects_seen(ballot) < m.start[MIN_OBJECTS] or not feels_gravity(ballot):
            return False
        count, span, objects, alike = _agreement(m, w, first, True)
        if objects < m.start[MIN_OBJECTS] or count < max(m.start[MIN_VOTES], m.start[MIN_PLACES] * total):
            return False
    # Objects that bear each other out do without a span; but a velocity not known yet looks like a time offset.
    at_once = (objects >= m.start[MIN_OBJECTS] or alike > 1) and m.layout[AT_TIME_OFFSET] < 0
    settled = span >= m.start[START_MIN_SPAN_S] or at_once
    return settled and not _is_contested(m, w, first)


@njit(cache=True)
def _starts_adrift(m: Memory, w: Work) -> bool:
    """Start as at first where the state, unsure of its place, has refused all of late; tell whether it did.

    Its attitude has no say, and what led it astray is in its biases, too.
    """
    unsure = max(m.P[3, 3], m.P[4, 4], m.P[5, 5]) > m.start[LOST_SIGMA] ** 2
    if not unsure or m.layout[AT_OBJECTS] >= 0 or m.counters[UNHELD_ROW] < m.start[FEW_VOTES]:
        return False
    m.up[:] = 0.0
    if not _found_by_votes(m, w):
        return False
    for i in range(3):
        m.x[ACCEL_BIAS + i] = 0.0
    start_again(m, w, 0)
    return True


@njit(cache=True)
def _starts_again(m: Memory, w: Work) -> bool:
    """Start again where hardly anything of late was accepted and what was refused agrees with itself."""
    since_start = (m.counters[NOW] - m.counters[STARTED_AT]) * 1e-9
    window = min(m.start[LOST_WINDOW_S], max(m.start[START_WINDOW_S], since_start))  # a wrong start is mended soon
    first, head = first_vote(m, window, int(m.start[LOST_MIN_VOTES])), m.counters[VOTE_HEAD]
    if head - first < m.start[LOST_MIN_VOTES]:
        return False
    used = used_since(m, first)
    if used > m.start[LOST_SHARE] * (head - first):
        return False
    m.up[0], m.up[1], m.up[2] = 0.0, 0.0, 1.0
    count = _agreement(m, w, first, False)[0]
    if count < m.start[LOST_MIN_VOTES] and used == 0.0 and since_start >= m.start[LOST_WINDOW_S]:
        # Nothing was used for so long: the attitude itself may be wrong, and has no say where most votes agree.
        m.up[2] = 0.0
        count = _agreement(m, w, first, False)[0]
        if 2 * count < head - first:
            return False
    if count < m.start[LOST_MIN_VOTES] or count <= 3.0 * used or _is_contested(m, w, first):
        return False
    start_again(m, w, GYRO_BIAS_ERROR)
    return True


@njit(cache=True)
def start_again(m: Memory, w: Work, keep_from: int) -> None:
    """Adopt the agreed pose, and count it as a new start."""
    adopt(m, w, keep_from)
    m.counters[RESTARTS] += 1
    m.counters[STARTED_AT] = m.counters[NOW]


@njit(cache=True)
def start_again_in_place(m: Memory, w: Work, missed: Array, seconds: float) -> None:
    """Start again at the state's own pose, as unsure as at a start, faster by what it missed (3,), m, in so long."""
    agreed = agreed_correction(m, w)
    for i in range(9):
        agreed.C[i] = 1.0 if i % 4 == 0 else 0.0
    for i in range(3):
        agreed.d[i] = agreed.origin[i] = m.x[POSITION + i]
        agreed.v[i], agreed.origin[3 + i] = missed[i] / seconds, 0.0
    agreed.agreed[:] = 0
    start_again(m, w, CORE)


@njit(cache=True)
def adopt(m: Memory, w: Work, keep_from: int) -> None:
    """Move the state to the agreed pose; error states that do not survive it start anew."""
    if len(m.tape) > 0:
        note_restart(m, keep_from)
    agreed, turned = agreed_correction(m, w), w.step[0:9]
    C, origin = agreed.C, agreed.origin
    multiply(C, m.x[0:9], turned)
    for i in range(9):
        m.x[i] = turned[i]
    kept = w.step[9:12]
    apply(C, m.x[VELOCITY] - origin[3], m.x[VELOCITY + 1] - origin[4], m.x[VELOCITY + 2] - origin[5], kept)
    for i in range(3):
        m.x[POSITION + i] = agreed.d[i]
        m.x[VELOCITY + i] = kept[i] + agreed.v[i]
    n = m.layout[N_ERROR]
    at = m.layout[AT_BIASES]
    biases = 6 * m.layout[N_OBJECTS] * m.layout[N_BIAS_KINDS]
    for i in range(n):
        if survives(m, i, keep_from):
            continue
        for j in range(n):
            m.P[i, j] = m.P[j, i] = 0.0
        m.P[i, i] = m.prior[i] ** 2
    for i in range(biases):
        kind, component = i // (6 * m.layout[N_OBJECTS]), i % 6
        m.x[m.layout[BIASES] + i] = 0.0
        m.P[at + i, at + i] = bias_sigma(m.bias_model, kind, component) ** 2
    m.counters[BIAS_TIME], m.counters[CLONED], m.counters[UNHELD_ROW] = m.counters[NOW], 0, 0
    forget_places(m)
    forget_rivals(m, False)
    # The agreeing votes count as used, so that a restart is not followed by the next at once.
    for a in range(len(m.inliers)):
        if m.inliers[a]:
            m.used[a] = 1.0
