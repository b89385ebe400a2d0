"""Where an object is whose pose in the world is unknown: hypotheses in parallel, each with how often it was seen.

A network's first sight of an object may be flipped or grossly wrong, and an object put there would have its good
detections refused for ever. So each detection, while the filter tracks, supports one of a few world poses; the object
is put at the pose that leads, and put elsewhere when another comes to lead.
"""

from __future__ import annotations

import math

from fusion.ballot import MAX_TILT, agreed_correction
from fusion.columns import Columns
from fusion.compiled import njit
from fusion.measurements import OBJECT_POSE, object_in_world
from fusion.memory import ANCHOR, NOW, SUPPOSED, Memory, Work
from fusion.nav_state import OBJECT_SIZE, OBJECTS, POSITION, TIME_OFFSET, Array, Ints
from fusion.so3_kernels import (
    apply,
    exp_so3,
    log_so3,
    multiply,
    multiply_transposed_left,
    multiply_transposed_right,
    orthonormalise,
)
from fusion.symmetry import fit_symmetry

# Places in the options.
UNKNOWN_MAP, MIN_POSES, MIN_SPAN_S, LEAD, MAX_ANGLE, MAX_DISTANCE, MAX_LEVER, REPLACE = range(8)

# Places in a hypothesis: R_world_obj 0-8, p_world_obj 9-11, detections that showed it, stamps (ns) of the first and the
# last of them, 1 where it is the state's.
SUPPORT, SINCE, UNTIL, HELD = range(12, 16)

_FADE_NS = 10e9  # a hypothesis not seen for long makes room for another
_MEAN_OVER = 30.0  # detections

WAIT, PUT, START_AGAIN = range(3)


@njit(cache=True)
def choose_anchor(m: Memory, kinds: Ints, objects: Ints, first: int, last: int) -> None:
    """Let the first object seen without a symmetry anchor a world whose map is unknown."""
    for j in range(first, last):
        if m.counters[ANCHOR] == 0 and kinds[j] == OBJECT_POSE and m.orders[objects[j]] == 1:
            m.counters[ANCHOR] = objects[j] + 1
            m.known[objects[j]] = 1.0


@njit(cache=True)
def suppose(m: Memory, w: Work, log: Columns, j: int) -> int:
    """Take detection j into the hypotheses of its object's pose.

    Returns PUT where the object is to be put where this detection sees it; START_AGAIN where it is the object that
    anchors the world, and the world is to be moved as the agreed correction then says; else WAIT.
    """
    k, translation = log.objects[j], log.translations[j]
    if len(m.supposed) == 0 or (m.known[k] > 0.0 and m.meeting[REPLACE] == 0.0):
        return WAIT
    T = w.step[60:72]
    object_in_world(m.x, m.x[TIME_OFFSET] - w.offset[0], w.rate, log.rotations[j], translation, T, w.step)
    if m.known[k] > 0.0:
        _hold(m, k)
    away = math.sqrt(translation[0] ** 2 + translation[1] ** 2 + translation[2] ** 2)
    nearest = _nearest(m, w, k, T, m.meeting[MAX_DISTANCE] + m.meeting[MAX_LEVER] * away)
    row = m.supposed[k, nearest]
    _take_in(m, w, row, T)
    second = 0.0
    for i in range(SUPPOSED):
        if i != nearest:
            second = max(second, m.supposed[k, i, SUPPORT])
    leads = row[SUPPORT] >= m.meeting[MIN_POSES] and row[SUPPORT] >= m.meeting[LEAD] * second
    if row[HELD] > 0.0 or not leads or row[UNTIL] - row[SINCE] < 1e9 * m.meeting[MIN_SPAN_S]:
        return WAIT
    if k + 1 == m.counters[ANCHOR]:
        return START_AGAIN if _world_turn(m, w, T) else WAIT
    for i in range(SUPPOSED):
        m.supposed[k, i, HELD] = 0.0
    row[HELD] = 1.0
    return PUT


@njit(cache=True)
def forget_rivals(m: Memory, all_of_them: bool) -> None:
    """Forget where objects may be beside where the state has them (or that as well): the filter has started again."""
    for k in range(len(m.supposed)):
        for i in range(SUPPOSED):
            if all_of_them or m.supposed[k, i, HELD] == 0.0:
                m.supposed[k, i, :] = 0.0


@njit(cache=True)
def _world_turn(m: Memory, w: Work, T: Array) -> bool:
    """Agree on the correction that takes a world in which the anchor stands at T (12,) to the one of the map.

    It turns about the vertical only, where there is one; a pose of the anchor that would take more is none.
    """
    agreed = agreed_correction(m, w)
    at, turn, C = OBJECTS + OBJECT_SIZE * (m.counters[ANCHOR] - 1), w.step[72:81], agreed.C
    multiply_transposed_right(m.x[at : at + 9], T, turn)
    exp_so3(0.0, 0.0, math.atan2(turn[3] - turn[1], turn[0] + turn[4]), C)
    trace = C[0] * turn[0] + C[1] * turn[1] + C[3] * turn[3] + C[4] * turn[4] + turn[8]
    if m.start[MAX_TILT] >= math.pi:  # nothing feels gravity
        for i in range(9):
            C[i] = turn[i]
    elif trace < 1.0 + 2.0 * math.cos(m.start[MAX_TILT]):
        return False
    apply(C, m.x[POSITION] - T[9], m.x[POSITION + 1] - T[10], m.x[POSITION + 2] - T[11], agreed.d)
    for i in range(3):  # no velocity to add, nothing taken off
        agreed.d[i] += m.x[at + 9 + i]
        agreed.v[i] = agreed.origin[i] = agreed.origin[3 + i] = 0.0
    return True


@njit(cache=True)
def _hold(m: Memory, k: int) -> None:
    """Let the hypothesis that is the state's be where the state is now; an object of old has none yet."""
    held, at = -1, OBJECTS + OBJECT_SIZE * k
    for i in range(SUPPOSED):
        if m.supposed[k, i, HELD] > 0.0:
            held = i
    if held < 0:
        held = _weakest(m, k)
        m.supposed[k, held, :] = 0.0
        m.supposed[k, held, HELD] = 1.0
    for i in range(OBJECT_SIZE):
        m.supposed[k, held, i] = m.x[at + i]


@njit(cache=True)
def _nearest(m: Memory, w: Work, k: int, T: Array, reach: float) -> int:
    """Return the hypothesis that a detection supports, a new one where none is near; T turns to the look-alike."""
    best, least, fitted, difference = -1, 1.0, w.step[81:90], w.step[90:99]
    for i in range(SUPPOSED):
        row = m.supposed[k, i]
        if row[SUPPORT] == 0.0 and row[HELD] == 0.0:
            continue
        for j in range(9):
            fitted[j] = T[j]
        fit_symmetry(fitted, row[0:9], m.axes[k], m.orders[k], w.R, w.scratch)
        multiply_transposed_left(row[0:9], fitted, difference)
        log_so3(difference, w.step[99:102])
        angle, gap = 0.0, 0.0
        for j in range(3):
            angle += w.step[99 + j] ** 2
            gap += (T[9 + j] - row[9 + j]) ** 2
        off = max(math.sqrt(angle) / m.meeting[MAX_ANGLE], math.sqrt(gap) / reach)
        if off < least:
            best, least = i, off
    if best < 0:
        best = _weakest(m, k)
        row = m.supposed[k, best]
        row[:] = 0.0
        for j in range(OBJECT_SIZE):
            row[j] = T[j]
    fit_symmetry(T[0:9], m.supposed[k, best, 0:9], m.axes[k], m.orders[k], w.R, w.scratch)
    return best


@njit(cache=True)
def _weakest(m: Memory, k: int) -> int:
    """Return the hypothesis that may go: the least seen, and not of late; never the state's."""
    weakest, least = -1, math.inf
    for i in range(SUPPOSED):
        row = m.supposed[k, i]
        seen = row[SUPPORT] * math.exp((row[UNTIL] - m.counters[NOW]) / _FADE_NS) if row[SUPPORT] > 0.0 else 0.0
        if row[HELD] == 0.0 and seen < least:
            weakest, least = i, seen
    return weakest


@njit(cache=True)
def _take_in(m: Memory, w: Work, row: Array, T: Array) -> None:
    """Count a detection for a hypothesis and let it move the hypothesis's pose."""
    row[SUPPORT] += 1.0
    row[UNTIL] = m.counters[NOW]
    if row[SUPPORT] == 1.0:
        row[SINCE] = m.counters[NOW]
    gain = 1.0 / min(row[SUPPORT], _MEAN_OVER)
    difference, vector, turn, turned = w.step[81:90], w.step[99:102], w.step[102:111], w.step[111:120]
    multiply_transposed_left(row[0:9], T, difference)
    log_so3(difference, vector)
    exp_so3(gain * vector[0], gain * vector[1], gain * vector[2], turn)
    multiply(row[0:9], turn, turned)
    orthonormalise(turned, turn)
    for i in range(9):
        row[i] = turned[i]
    for i in range(3):
        row[9 + i] += gain * (T[9 + i] - row[9 + i])
