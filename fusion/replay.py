"""Late data: sorted buffers of what was fed, snapshots of the filter, and going back to one to run on from there.

Whatever arrives in the past is put in its place, the newest snapshot before it is restored, and everything since is
taken in again, in the order of the whole-log call: the result does not depend on the order of arrival.
One compiled call per arrival on four flat arrays: the filter's own two (`fusion/memory.py`) and two of
`fusion/replay_memory.py`.
"""

from __future__ import annotations

import math

from fusion.columns import Columns
from fusion.compiled import njit
from fusion.filter_loop import due, end_of_stamp, measure_at
from fusion.filter_motion import advance, begin
from fusion.imu_noise import REACH, follow_noise
from fusion.memory import (
    IMU_AT,
    LAST_STAMP,
    LEAST_DELAY,
    NOW,
    VOTE_HEAD,
    VOTES,
    Memory,
    Work,
    views,
    work_views,
)
from fusion.nav_state import N_ERROR, Array, Ints
from fusion.replay_memory import (
    AHEAD,
    BEGUN,
    CAPACITY,
    COUNT,
    DROPPED,
    DUPLICATES,
    END_SNAPSHOT,
    FIRST_SNAPSHOT,
    HORIZON,
    IMU_CAPACITY,
    IMU_COUNT,
    INTERVAL,
    MALFORMED,
    NEXT,
    OVERFLOWED,
    REPLAYS,
    SNAPSHOTS,
    STATE_SIZE,
    TOO_EARLY,
    TOO_LATE,
    Ring,
    ring_views,
)
from fusion.so3_kernels import copy, from_quaternion

IMU_SAMPLE, POSES = 0, 1


@njit(cache=True)
def feed(floats: Array, integers: Ints, ring_floats: Array, ring_integers: Ints, what: int, stamp: int, n: int) -> None:
    """Take in what lies in the ring's incoming part: one IMU sample, or n poses of one stamp on the IMU's clock."""
    m, r = views(floats, integers), ring_views(ring_floats, ring_integers)
    w = work_views(m.work, m.layout[N_ERROR])
    h = r.header
    newest = r.imu_stamps[h[IMU_COUNT] - 1] if h[IMU_COUNT] > 0 else stamp
    if stamp < newest - h[HORIZON]:
        h[TOO_LATE] += 1 if what == IMU_SAMPLE else n
        return
    if what == IMU_SAMPLE:
        in_the_past = h[IMU_COUNT] > 0 and stamp <= newest
        changed = _put_sample(r, m, stamp, in_the_past)
    else:
        if stamp > newest + h[AHEAD]:
            h[TOO_EARLY] += n
            return
        in_the_past = h[BEGUN] == 1 and not _before(m.counters, stamp)
        changed = _put_poses(r, stamp, n, in_the_past)
    if changed and in_the_past:
        _rewind(m, r, floats, stamp, what)
    if changed:
        _run(m, w, r, floats)


@njit(cache=True)
def _put_sample(r: Ring, m: Memory, stamp: int, in_the_past: bool) -> bool:
    h = r.header
    for i in range(6):
        if not math.isfinite(r.sample[i]):
            h[MALFORMED] += 1
            return False
    if h[IMU_COUNT] == h[IMU_CAPACITY]:
        _forget_samples(r, m)
    at = h[IMU_COUNT]
    while at > 0 and r.imu_stamps[at - 1] >= stamp:
        at -= 1
    if at < h[IMU_COUNT] and r.imu_stamps[at] == stamp:
        h[DUPLICATES] += 1
        return False
    if in_the_past and not _reachable(r, stamp, IMU_SAMPLE):
        h[TOO_LATE] += 1
        return False
    for i in range(h[IMU_COUNT], at, -1):
        r.imu_stamps[i] = r.imu_stamps[i - 1]
        copy(r.imu_values[i - 1], r.imu_values[i])
    r.imu_stamps[at] = stamp
    copy(r.sample, r.imu_values[at, :6])
    h[IMU_COUNT] += 1
    follow_noise(r.imu_stamps, r.imu_values, at, h[IMU_COUNT])
    return True


@njit(cache=True)
def _put_poses(r: Ring, stamp: int, n: int, in_the_past: bool) -> bool:
    h = r.header
    if in_the_past and not _reachable(r, stamp, POSES):
        h[TOO_LATE] += n
        return False
    changed = False
    for i in range(n):
        changed = _put_pose(r, stamp, i) or changed
    return changed


@njit(cache=True)
def _put_pose(r: Ring, stamp: int, i: int) -> bool:
    h = r.header
    from_quaternion(r.new_rotations[i], r.new_rotations[i])
    if not _finite(r, i):
        h[MALFORMED] += 1
        return False
    if h[COUNT] == h[CAPACITY]:
        _forget_poses(r)
    if h[COUNT] == h[CAPACITY]:
        h[OVERFLOWED] += 1
        return False
    at = h[COUNT]
    while at > 0 and (r.stamps[at - 1] > stamp or (r.stamps[at - 1] == stamp and r.objects[at - 1] > r.new_objects[i])):
        at -= 1
    before = at - 1
    while before >= 0 and r.stamps[before] == stamp and r.objects[before] == r.new_objects[i]:
        if _same(r, before, i):
            h[DUPLICATES] += 1
            return False
        before -= 1
    for j in range(h[COUNT], at, -1):
        _copy_pose(r, j - 1, j)
    r.stamps[at], r.kinds[at], r.objects[at] = stamp, r.new_kinds[i], r.new_objects[i]
    copy(r.new_rotations[i], r.rotations[at])
    copy(r.new_translations[i], r.translations[at])
    _copy_covariance(r.new_covariances[i], r.covariances[at])
    r.decisions[at] = 0
    h[COUNT] += 1
    return True


@njit(cache=True)
def _copy_pose(r: Ring, source: int, target: int) -> None:
    r.stamps[target], r.kinds[target], r.objects[target] = r.stamps[source], r.kinds[source], r.objects[source]
    r.decisions[target] = r.decisions[source]
    copy(r.rotations[source], r.rotations[target])
    copy(r.translations[source], r.translations[target])
    _copy_covariance(r.covariances[source], r.covariances[target])
    copy(r.nis[source], r.nis[target])


@njit(cache=True)
def _copy_covariance(source: Array, target: Array) -> None:
    for row in range(6):
        copy(source[row], target[row])


@njit(cache=True)
def _finite(r: Ring, i: int) -> bool:
    total = 0.0
    for j in range(9):
        total += abs(r.new_rotations[i, j])
    for j in range(3):
        total += abs(r.new_translations[i, j])
    for j in range(6):
        for k in range(6):
            total += abs(r.new_covariances[i, j, k])
    return math.isfinite(total)


@njit(cache=True)
def _same(r: Ring, at: int, i: int) -> bool:
    same = r.kinds[at] == r.new_kinds[i]
    for j in range(9):
        same = same and r.rotations[at, j] == r.new_rotations[i, j]
    for j in range(3):
        same = same and r.translations[at, j] == r.new_translations[i, j]
    return same


@njit(cache=True)
def _before(counters: Ints, stamp: int) -> bool:
    """Tell whether a filter with these counters has yet to take in poses of a stamp, whenever they were due."""
    return counters[LAST_STAMP] < stamp and counters[NOW] < stamp + counters[LEAST_DELAY]


@njit(cache=True)
def _is_before(counters: Ints, stamp: int, what: int) -> bool:
    return counters[NOW] < stamp if what == IMU_SAMPLE else _before(counters, stamp)


@njit(cache=True)
def _reachable(r: Ring, stamp: int, what: int) -> bool:
    """Tell whether there is a state from before this stamp to go back to."""
    h = r.header
    if h[DROPPED] == 0:
        return True
    oldest = r.snapshot_counters[h[FIRST_SNAPSHOT] % h[SNAPSHOTS]]
    return h[FIRST_SNAPSHOT] < h[END_SNAPSHOT] and _is_before(oldest, stamp, what)


@njit(cache=True)
def _forget_samples(r: Ring, m: Memory) -> None:
    """Drop the IMU samples before the oldest snapshot, and old snapshots until that is half of the buffer."""
    h = r.header
    while True:
        oldest = r.snapshot_counters[h[FIRST_SNAPSHOT] % h[SNAPSHOTS], IMU_AT]
        if 2 * oldest >= h[IMU_CAPACITY] or h[END_SNAPSHOT] - h[FIRST_SNAPSHOT] <= 1:
            break
        h[FIRST_SNAPSHOT] += 1
    oldest = max(0, oldest - REACH)
    for i in range(oldest, h[IMU_COUNT]):
        r.imu_stamps[i - oldest] = r.imu_stamps[i]
        copy(r.imu_values[i], r.imu_values[i - oldest])
    h[IMU_COUNT] -= oldest
    h[DROPPED] = 1
    m.counters[IMU_AT] -= oldest
    for s in range(h[FIRST_SNAPSHOT], h[END_SNAPSHOT]):
        r.snapshot_counters[s % h[SNAPSHOTS], IMU_AT] -= oldest


@njit(cache=True)
def _forget_poses(r: Ring) -> None:
    """Drop the measurements that the oldest snapshot has taken in."""
    h = r.header
    if h[FIRST_SNAPSHOT] == h[END_SNAPSHOT]:
        return
    oldest, gone = r.snapshot_counters[h[FIRST_SNAPSHOT] % h[SNAPSHOTS], LAST_STAMP], 0
    while gone < h[NEXT] and r.stamps[gone] <= oldest:
        gone += 1
    for i in range(gone, h[COUNT]):
        _copy_pose(r, i, i - gone)
    h[COUNT] -= gone
    h[NEXT] -= gone
    h[DROPPED] = 1


@njit(cache=True)
def _take_snapshot(m: Memory, r: Ring, floats: Array) -> None:
    h = r.header
    if h[END_SNAPSHOT] - h[FIRST_SNAPSHOT] == h[SNAPSHOTS]:
        h[FIRST_SNAPSHOT] += 1
    s = h[END_SNAPSHOT] % h[SNAPSHOTS]
    h[END_SNAPSHOT] += 1
    copy(floats, r.snapshot_states[s])
    copy(m.used, r.snapshot_used[s])
    copy(m.counters, r.snapshot_counters[s])


@njit(cache=True)
def _rewind(m: Memory, r: Ring, floats: Array, stamp: int, what: int) -> None:
    """Restore the newest snapshot before a stamp, or what was before the beginning."""
    h, head = r.header, m.counters[VOTE_HEAD]
    h[REPLAYS] += 1
    while h[END_SNAPSHOT] > h[FIRST_SNAPSHOT]:
        if _is_before(r.snapshot_counters[(h[END_SNAPSHOT] - 1) % h[SNAPSHOTS]], stamp, what):
            break
        h[END_SNAPSHOT] -= 1
    if h[END_SNAPSHOT] == h[FIRST_SNAPSHOT]:
        copy(r.first_state, floats[: h[STATE_SIZE]])
        m.counters[:] = 0
        h[BEGUN] = h[NEXT] = 0
        return
    s = (h[END_SNAPSHOT] - 1) % h[SNAPSHOTS]
    copy(r.snapshot_states[s], floats[: h[STATE_SIZE]])
    copy(r.snapshot_counters[s], m.counters)
    for vote in range(head - 1, m.counters[VOTE_HEAD] - 1, -1):
        copy(r.overwritten[vote % h[CAPACITY]], m.votes[vote % VOTES])
        m.vote_stamps[vote % VOTES] = r.overwritten_stamps[vote % h[CAPACITY]]
    copy(r.snapshot_used[s], m.used)  # a restart marks old votes as used, so marks are kept beside the votes
    h[NEXT] = h[COUNT]
    while h[NEXT] > 0 and r.stamps[h[NEXT] - 1] > m.counters[LAST_STAMP]:
        h[NEXT] -= 1


@njit(cache=True)
def _run(m: Memory, w: Work, r: Ring, floats: Array) -> None:
    """Run on to the newest IMU sample through the measurements on the way, as `filter_loop.run_log` does."""
    h, c = r.header, m.counters
    if h[IMU_COUNT] == 0:
        return
    if h[BEGUN] == 0:
        begin(m, r.imu_stamps[0], r.imu_values[0, 3:6], 0)
        h[BEGUN], h[NEXT] = 1, 0
        while h[NEXT] < h[COUNT] and r.stamps[h[NEXT]] < r.imu_stamps[0]:
            h[NEXT] += 1
        _measure_until(m, w, r, r.imu_stamps[0])
        _take_snapshot(m, r, floats)
    while c[IMU_AT] < h[IMU_COUNT] - 1:
        target = r.imu_stamps[c[IMU_AT] + 1]
        _measure_until(m, w, r, target)
        advance(m, w, r.imu_stamps, r.imu_values, target)
        last = r.snapshot_counters[(h[END_SNAPSHOT] - 1) % h[SNAPSHOTS]]
        if c[NOW] - last[NOW] >= h[INTERVAL] or c[IMU_AT] - last[IMU_AT] >= h[IMU_CAPACITY] // 8:
            _take_snapshot(m, r, floats)


@njit(cache=True)
def _measure_until(m: Memory, w: Work, r: Ring, until: int) -> None:
    """Take in the waiting measurements up to a stamp that the IMU has reached."""
    h = r.header
    while h[NEXT] < h[COUNT] and due(m, r.stamps[h[NEXT]]) <= until:
        last = end_of_stamp(r.stamps, h[NEXT], h[COUNT])
        for vote in range(m.counters[VOTE_HEAD], m.counters[VOTE_HEAD] + last - h[NEXT]):
            place, slot = vote % h[CAPACITY], vote % VOTES
            copy(m.votes[slot], r.overwritten[place])
            r.overwritten_stamps[place] = m.vote_stamps[slot]
        measured = (r.stamps, r.kinds, r.objects, r.rotations, r.translations, r.covariances, r.decisions, r.nis)
        h[NEXT] = measure_at(m, w, Columns(r.imu_stamps, r.imu_values, *measured), h[NEXT], last)
