"""The filter in time: integrate up to a stamp, take in what was measured there.

The whole-log call and the online estimator (`fusion/online.py`) go through the same functions.
"""

from __future__ import annotations

import math

from fusion.ballot import WHOLE
from fusion.bias_spread import follow_spreads
from fusion.columns import OUT_CORE, OUT_SIGMA, Columns, Rows
from fusion.compiled import njit
from fusion.eskf import ACCEPTED, POSITION_ONLY, REJECTED
from fusion.filter_motion import advance, begin, find_rate
from fusion.filter_update import (
    ADAPTATION,
    LIMIT_BOTH,
    MAX_SCALE,
    follow_jumps,
    forget_biases,
    is_lost,
    is_unsettled,
    put_object,
    settle,
    take,
)
from fusion.lasting_share import follow_pairs
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP
from fusion.meeting import PUT, START_AGAIN, UNKNOWN_MAP, choose_anchor, forget_rivals, suppose
from fusion.memory import (
    CLONED,
    CLONED_AT,
    DELAY,
    LAST_STAMP,
    LAST_UPDATE,
    LEAST_DELAY,
    MODE,
    NOW,
    REFUSED_ROW,
    REPLACED,
    TRACKING,
    UNHELD_ROW,
    UNHELD_SINCE,
    UNSURE_AT,
    VOTE_HEAD,
    Memory,
    Work,
    views,
    work_views,
)
from fusion.nav_state import AT_TIME_OFFSET, GYRO_BIAS_ERROR, N_ERROR, N_OBJECTS, TIME_OFFSET, Array, Ints
from fusion.new_states import clone_pose
from fusion.noise_scale import follow_scale
from fusion.object_biases import decay_biases, is_fair
from fusion.place_watch import RELEASE, RELEASED, return_to_map, tally, watch
from fusion.refused_odometry import follow_refusals
from fusion.starting import cast_vote, start_again, starts
from fusion.tape import note_clone, note_decay, note_row
from fusion.votes import VOTE_OBJECT

PENDING = -1  # beside the decisions of the gate
RETIMED_BEYOND_NS = 1_000_000


def run_log(floats: Array, integers: Ints, log: Columns, rows: Rows) -> int:
    """Filter a whole log in one call; return how many rows were written.

    A row for every IMU sample and every stamp with measurements, from the start on, each with what was known then.
    """
    return int(run_part(floats, integers, log, rows, 0, len(log.imu_stamps), 0, 0)[1])


@njit(cache=True)
def run_part(
    floats: Array, integers: Ints, log: Columns, rows: Rows, first: int, end: int, j: int, row: int
) -> tuple[int, int]:
    """Filter IMU samples first..end-1 from measurement j and row `row` on; return where both then stand."""
    m = views(floats, integers)
    w = work_views(m.work, m.layout[N_ERROR])
    stamps, imu_stamps = log.stamps, log.imu_stamps
    if first == 0:
        while j < len(stamps) and stamps[j] < imu_stamps[0]:
            j += 1
        begin(m, imu_stamps[0], log.imu_values[0, 3:6], 0)
    for k in range(first, end):
        emitted = False
        while j < len(stamps) and due(m, stamps[j]) <= imu_stamps[k]:
            j = measure_at(m, w, log, j, end_of_stamp(stamps, j, len(stamps)))
            if m.counters[MODE] == TRACKING:
                emit(m, rows, row)
                row += 1
                emitted = m.counters[NOW] == imu_stamps[k]
        advance(m, w, imu_stamps, log.imu_values, imu_stamps[k])
        if m.counters[MODE] == TRACKING and not emitted:
            emit(m, rows, row)
            row += 1
    return j, row


@njit(cache=True)
def due(m: Memory, stamp: int) -> int:
    """Return when measurements of a stamp are taken in: as much later as the camera's clock is found to be early."""
    if m.layout[AT_TIME_OFFSET] < 0 or m.counters[MODE] != TRACKING:
        return stamp
    return max(stamp + m.counters[DELAY], m.counters[NOW] + 1)


@njit(cache=True)
def end_of_stamp(stamps: Ints, first: int, end: int) -> int:
    """Return where the measurements of the stamp of the first one end."""
    last = first
    while last < end and stamps[last] == stamps[first]:
        last += 1
    return last


@njit(cache=True)
def measure_at(m: Memory, w: Work, log: Columns, first: int, last: int) -> int:
    """Go to where the measurements first..last-1, all of one stamp, are due, and take them in; return last."""
    stamp = log.stamps[first]
    advance(m, w, log.imu_stamps, log.imu_values, due(m, stamp))
    find_rate(m, w, log.imu_stamps, log.imu_values)
    w.offset[0] = (m.counters[NOW] - stamp) * 1e-9
    measure(m, w, log, first, last)
    m.counters[LAST_STAMP] = stamp
    retime(m)
    return last


@njit(cache=True)
def retime(m: Memory) -> None:
    """Follow the estimated time offset, so that what is linear in it stays small.

    What was learnt of it while it was far off came through a motion taken for uniform: its variance takes that back.
    """
    at = m.layout[AT_TIME_OFFSET]
    if at < 0 or m.counters[MODE] != TRACKING:
        return
    error = round(m.x[TIME_OFFSET] * 1e9) - m.counters[DELAY]
    if abs(error) <= RETIMED_BEYOND_NS:
        return
    m.counters[DELAY] += error
    m.counters[LEAST_DELAY] = min(m.counters[LEAST_DELAY], m.counters[DELAY])
    m.counters[CLONED] = 0  # odometry from before is of another clock
    m.P[at, at] += (0.3e-9 * error) ** 2


@njit(cache=True)
def measure(m: Memory, w: Work, log: Columns, first: int, last: int) -> None:
    """Take in the measurements first..last-1, all at the filter's stamp; write their decisions and nis."""
    c = m.counters
    poses = first
    while poses < last and log.kinds[poses] == ODOMETRY_STEP:
        poses += 1
    for j in range(first, last):
        log.decisions[j] = REJECTED
    if c[MODE] == TRACKING:
        if len(m.tape) > 0:
            note_decay(m)
        decay_biases(m)
        for j in range(first, poses if c[CLONED] == 1 else first):
            log.decisions[j] = take(m, w, log, j, True)
            follow_refusals(m, w, log, j)
    if poses < last:
        if m.meeting[UNKNOWN_MAP] > 0.0:
            choose_anchor(m, log.kinds, log.objects, poses, last)
        follow_spreads(m, log, poses, last)
        if c[MODE] == TRACKING:
            if is_lost(m) and c[UNSURE_AT] <= c[LAST_UPDATE]:
                c[UNSURE_AT] = c[NOW]
            _take_poses(m, w, log, poses, last)
            _meet_objects(m, w, log, poses, last)
        account(m, w, log, poses, last)
        if starts(m, w):
            _settle_at_agreed(m, w, log, poses, last)
    if first < poses and c[MODE] == TRACKING:
        _clone(m)


@njit(cache=True)
def _take_poses(m: Memory, w: Work, log: Columns, first: int, last: int) -> None:
    """Take in poses of one stamp; those refused before the others had moved the state are asked again."""
    for j in range(first, last):
        log.decisions[j] = PENDING
    _order(m, w, log, first, last)
    accepted = False
    for _ in range(first, last):
        j = _next(log, first, last)
        log.decisions[j] = take(m, w, log, j, True)
        accepted = accepted or log.decisions[j] & ACCEPTED != 0
    for j in range(first, last if accepted else first):
        if log.decisions[j] == REJECTED:
            log.decisions[j] = take(m, w, log, j, True)


@njit(cache=True)
def _settle_at_agreed(m: Memory, w: Work, log: Columns, first: int, last: int) -> None:
    """Tie the state to those poses of its start's stamp that agreed: a gross error that came first would win it.

    Not while the time offset is unknown: with it, they agreed to a velocity that is not the camera's.
    """
    if m.layout[AT_TIME_OFFSET] >= 0:
        return
    slot, ring = m.counters[VOTE_HEAD] - 1, len(m.vote_stamps)
    for j in range(last - 1, first - 1, -1):
        at = slot & (ring - 1)
        if m.vote_stamps[at] == m.counters[NOW] and m.votes[at, VOTE_OBJECT] == log.objects[j]:
            slot -= 1
            if m.inliers[at] & WHOLE and log.decisions[j] == REJECTED:
                log.decisions[j] = settle(m, w, log, j, m.votes[at])


@njit(cache=True)
def _order(m: Memory, w: Work, log: Columns, first: int, last: int) -> None:
    """Write into nis[:, 0] what measurements of one stamp are taken in by, the least first.

    A state that is sure of itself takes them as they come. One that is not lets those that fit it best speak first:
    its gate is wide, and a gross error that came first would shut the others out.
    """
    unsettled = is_unsettled(m)
    for j in range(first, last):
        if unsettled:
            take(m, w, log, j, False)
        else:
            log.nis[j, 0] = j


@njit(cache=True)
def _next(log: Columns, first: int, last: int) -> int:
    """Return the pending measurement with the least nis."""
    best = -1
    for j in range(first, last):
        if log.decisions[j] == PENDING and (best < 0 or log.nis[j, 0] < log.nis[best, 0]):
            best = j
    return best


@njit(cache=True)
def _meet_objects(m: Memory, w: Work, log: Columns, first: int, last: int) -> None:
    for j in range(first, last if len(m.supposed) > 0 else first):
        if log.kinds[j] == OBJECT_POSE and meet(m, w, log, j) == PUT:
            put_object(m, w, log, j)
            log.decisions[j] = ACCEPTED


@njit(cache=True)
def meet(m: Memory, w: Work, log: Columns, j: int) -> int:
    """Take a detection into where its object may be; return PUT where it is to be put where this detection sees it.

    Where another pose of the object that anchors the world has come to lead, the world is moved so that this one is
    where the map says, and all other objects are unknown again.
    """
    k, found = log.objects[j], suppose(m, w, log, j)
    if found == PUT and m.known[k] > 0.0:
        m.counters[REPLACED] += 1
        return_to_map(m, k)
    if found == START_AGAIN:
        m.inliers[:] = 0
        start_again(m, w, GYRO_BIAS_ERROR)
        for i in range(m.layout[N_OBJECTS]):
            m.known[i] = 1.0 if i == k else 0.0
        forget_rivals(m, True)
    return found


@njit(cache=True)
def account(m: Memory, w: Work, log: Columns, first: int, last: int) -> None:
    """Draw the conclusions of what became of the measurements of a stamp: jumps, votes, tallies, moved objects."""
    c, accepted, held, refused = m.counters, False, False, 0
    for j in range(first, last):
        kind, k, decision = log.kinds[j], log.objects[j], log.decisions[j]
        follow_jumps(m, log, j)
        cast_vote(m, w, kind, k, log.rotations[j], log.translations[j], log.covariances[j], decision)
        accepted = accepted or decision & ACCEPTED != 0
        held = held or (decision & POSITION_ONLY != 0 and (kind != OBJECT_POSE or is_fair(m, k)))
        refused += decision == REJECTED
        if c[MODE] == TRACKING:
            tally(m, kind, k, decision, log.nis[j, 0], m.limits[LIMIT_BOTH])
            if m.limits[ADAPTATION] > 0.0 and decision & RELEASED == 0:
                follow_scale(m, kind, k, log.nis[j], m.limits[ADAPTATION], m.limits[MAX_SCALE])
    if c[MODE] != TRACKING:
        return
    follow_pairs(m, w, log, first, last)
    if c[UNHELD_ROW] == 0:
        c[UNHELD_SINCE] = c[NOW]
    c[UNHELD_ROW] = 0 if held else c[UNHELD_ROW] + last - first
    c[REFUSED_ROW] = 0 if accepted else c[REFUSED_ROW] + refused
    if accepted:
        c[LAST_UPDATE] = c[NOW]
    for j in range(first, last if m.moved[RELEASE] > 0.0 else first):
        k = log.objects[j]
        if log.kinds[j] == OBJECT_POSE and m.known[k] > 0.0 and watch(m, w, log, j) != 0:
            forget_biases(m, k, True)


@njit(cache=True)
def _clone(m: Memory) -> None:
    """Keep the pose of now as what the next odometry is measured against."""
    clone_pose(m.x, m.P, m.layout)
    m.counters[CLONED], m.counters[CLONED_AT] = 1, m.counters[NOW]
    if len(m.tape) > 0:
        note_clone(m)


@njit(cache=True)
def emit(m: Memory, rows: Rows, row: int) -> None:
    """Write the state of now into a row."""
    rows.stamps[row] = m.counters[NOW]
    core, sigma, covariance, P = rows.core[row], rows.sigma[row], rows.covariance[row], m.P
    for i in range(OUT_CORE):
        core[i] = m.x[i]
    for i in range(OUT_SIGMA):
        sigma[i] = math.sqrt(max(P[i, i], 0.0))
    for i in range(6):
        for j in range(6):
            covariance[6 * i + j] = P[i, j]
    if len(m.tape) > 0:
        note_row(m, row)
