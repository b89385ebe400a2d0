"""Where each object stands against the map, how its measurements fare, and when it is released from the map.

The deviation of a detection from the map, in world axes, is e = Log(R_wc R_m R_wo^T) and d = p_wc + R_wc t_m - p_wo.
Of an object that was moved it is the same from everywhere; a network's bias turns with the camera and has a known size,
gross errors scatter. Mean and scatter fade with time and start anew where a detection is far off the mean.
"""

from __future__ import annotations

import math

from fusion.columns import Columns, read_fitted
from fusion.compiled import njit
from fusion.eskf import ACCEPTED, POSITION_ONLY, ROTATION_ONLY, cholesky, whiten
from fusion.measurements import OBJECT_POSE, object_in_world, write_bias_axes
from fusion.memory import NOW, Memory, Work
from fusion.nav_state import AT_OBJECTS, N_BIAS_KINDS, OBJECT_SIZE, OBJECTS, SPREAD_SIZE, SPREADS, TIME_OFFSET, Array
from fusion.object_biases import bias_sigma
from fusion.so3_kernels import apply_transposed, log_so3, multiply_transposed_right

RELEASED = 4  # beside the bits of the gate: the object is off the map, or turned and its rotation is not used

# Places in a tally: how the measurements of an object (the last row: of camera poses) fared since the start.
POSES, POSITION_USED, ROTATION_USED, IN_A_ROW, LONGEST, RATIO, TESTED, USED_AT = range(8)
RATIO_MEMORY, RATIO_CAP = 20.0, 10.0

# Places in what is known of an object's place: mean turn 0-2 and shift 3-5 against the map in world axes, and how long
# (s) it has been off the map in a row, and how long at home (on the map) or fit to return to it (off the map).
(
    SCATTER_TURN,
    SCATTER_SHIFT,
    WEIGHT,
    COUNT,
    WATCHED_AT,
    AGAINST_S,
    SETTLED_S,
    STATUS,
    TIMES,
) = range(6, 15)
ON_MAP, TURNED, OFF_MAP = 0, 1, 2  # an object that was turned where it stands keeps its position

# Places in the options.
RELEASE, RE_ESTIMATE, DISTANCE, ANGLE, SIGMAS, SCATTER, AFTER_S, SEEN_AT_HOME, MIN_OTHERS, MEMORY_S, MIN_POSES = range(
    11
)


@njit(cache=True)
def tally(m: Memory, kind: int, k: int, decision: int, nis: float, limit: float) -> None:
    """Count what became of a measurement; its NIS over the limit enters a mean over about the last twenty."""
    row = m.tallies[k if kind == OBJECT_POSE else len(m.tallies) - 1]
    row[POSES] += 1.0
    if decision & POSITION_ONLY:
        row[POSITION_USED] += 1.0
        row[USED_AT] = m.counters[NOW]
    if decision & ROTATION_ONLY:
        row[ROTATION_USED] += 1.0
    row[IN_A_ROW] = 0.0 if decision & ACCEPTED else row[IN_A_ROW] + 1.0
    row[LONGEST] = max(row[LONGEST], row[IN_A_ROW])
    if math.isfinite(nis):
        row[TESTED] += 1.0
        row[RATIO] += (min(nis / limit, RATIO_CAP) - row[RATIO]) / min(row[TESTED], RATIO_MEMORY)


@njit(cache=True)
def status_of(m: Memory, kind: int, k: int) -> int:
    """Tell whether a measurement is of an object that is ON_MAP, TURNED or OFF_MAP."""
    return int(m.places[k, STATUS]) if kind == OBJECT_POSE else ON_MAP


@njit(cache=True)
def forget_places(m: Memory) -> None:
    """Begin to watch all objects anew, each at its place in the map: the filter has started again."""
    for k in range(len(m.places)):
        for i in range(TIMES):
            m.places[k, i] = 0.0


@njit(cache=True)
def return_to_map(m: Memory, k: int) -> None:
    """Watch an object anew at the place where it has just been put."""
    _look_anew(m.places[k], ON_MAP)


@njit(cache=True)
def watch(m: Memory, w: Work, log: Columns, j: int) -> int:
    """Take detection j into its object's mean deviation from the map.

    Returns 1 where the object, or its rotation, is released by it, -1 where it returns to the map, else 0.
    """
    k, o = log.objects[j], m.moved
    place = m.places[k]
    elapsed = min((m.counters[NOW] - place[WATCHED_AT]) * 1e-9, o[MEMORY_S]) if place[COUNT] > 0.0 else 0.0
    place[WATCHED_AT] = m.counters[NOW]
    deviation = w.step[60:66]
    _deviate(m, w, log, j, deviation)
    if _far(place, deviation, 0) > 2.0 * o[ANGLE] or _far(place, deviation, 3) > 2.0 * o[DISTANCE]:
        for i in range(COUNT + 1):  # it shows elsewhere now
            place[i] = 0.0
    _average(place, deviation, math.exp(-elapsed / o[MEMORY_S]))
    if place[COUNT] < o[MIN_POSES]:
        return 0
    turn, shift = _norm(place, 0), _norm(place, 3)
    turned = turn > o[ANGLE] and place[SCATTER_TURN] < (o[SCATTER] * turn) ** 2
    shifted = shift > o[DISTANCE] and place[SCATTER_SHIFT] < (o[SCATTER] * shift) ** 2
    if place[STATUS] != OFF_MAP:
        shifted = shifted and _implausible(m, w, k, 3)
        turned = place[STATUS] == ON_MAP and turned and _implausible(m, w, k, 0)
        place[AGAINST_S] = place[AGAINST_S] + elapsed if shifted or turned else 0.0
        if place[STATUS] == ON_MAP and turn < o[ANGLE] and shift < o[DISTANCE]:
            place[SETTLED_S] += elapsed
        stranger = o[SEEN_AT_HOME] > 0.0 and place[STATUS] == ON_MAP and place[SETTLED_S] < o[AFTER_S]
        if place[AGAINST_S] >= o[AFTER_S] and not stranger and _others_agree(m, k):
            _look_anew(place, OFF_MAP if shifted else TURNED)
            place[TIMES] += 1.0
            return 1
        if place[STATUS] == ON_MAP:
            return 0
    still = place[SCATTER_TURN] < (0.5 * o[ANGLE]) ** 2 and place[SCATTER_SHIFT] < (0.5 * o[DISTANCE]) ** 2
    home = still and turn < 0.5 * o[ANGLE] and shift < 0.5 * o[DISTANCE]
    settled = home or (still and o[RE_ESTIMATE] > 0.0 and m.layout[AT_OBJECTS] >= 0)
    place[SETTLED_S] = place[SETTLED_S] + elapsed if settled else 0.0
    if place[SETTLED_S] < o[AFTER_S]:
        return 0
    _look_anew(place, ON_MAP)
    if not home:
        m.known[k] = 0.0
    return -1


@njit(cache=True)
def _look_anew(place: Array, status: int) -> None:
    for i in range(STATUS):
        place[i] = 0.0
    place[STATUS] = status


@njit(cache=True)
def _deviate(m: Memory, w: Work, log: Columns, j: int, out: Array) -> None:
    """Write detection j's deviation from the map (6,); leave it in w.measured, w.R, and R_wc in w.step."""
    read_fitted(m, w, log, j)
    T_wo, at = w.step[66:78], OBJECTS + OBJECT_SIZE * log.objects[j]
    seconds = m.x[TIME_OFFSET] - w.offset[0]
    object_in_world(m.x, seconds, w.rate, w.measured[0:9], w.measured[9:12], T_wo, w.step)
    multiply_transposed_right(T_wo, m.x[at : at + 9], w.step[45:54])
    log_so3(w.step[45:54], out)
    for i in range(3):
        out[3 + i] = T_wo[9 + i] - m.x[at + 9 + i]


@njit(cache=True)
def _average(place: Array, deviation: Array, kept: float) -> None:
    place[WEIGHT] = place[WEIGHT] * kept + 1.0
    place[COUNT] += 1.0
    gain = 1.0 / place[WEIGHT]
    for half in range(2):
        squared = 0.0
        for i in range(3 * half, 3 * half + 3):
            off = deviation[i] - place[i]
            place[i] += gain * off
            squared += off * off
        place[SCATTER_TURN + half] = (1.0 - gain) * (place[SCATTER_TURN + half] + gain * squared)


@njit(cache=True)
def _far(place: Array, deviation: Array, first: int) -> float:
    total = 0.0
    for i in range(first, first + 3):
        total += (deviation[i] - place[i]) ** 2
    return math.sqrt(total) if place[COUNT] > 0.0 else 0.0


@njit(cache=True)
def _norm(place: Array, first: int) -> float:
    return math.sqrt(place[first] ** 2 + place[first + 1] ** 2 + place[first + 2] ** 2)


@njit(cache=True)
def _implausible(m: Memory, w: Work, k: int, first: int) -> bool:
    """Tell whether the mean deviation in rotation (first 0) or position (3) is more than noise and biases explain."""
    R_wc, p_co, axes = w.step[9:18], w.measured[9:12], w.step[33:42]
    apply_transposed(
        R_wc, m.places[k, first], m.places[k, first + 1], m.places[k, first + 2], w.residual[first : first + 3]
    )
    write_bias_axes(p_co, axes)
    for i in range(3):
        for j in range(3):
            w.S[first + i, first + j] = w.R[first + i, first + j]
    for kind in range(m.layout[N_BIAS_KINDS]):
        for c in range(3):
            spread = m.x[m.layout[SPREADS] + SPREAD_SIZE * k + (0 if first == 0 else 1 + c // 2)]
            variance = (spread * bias_sigma(m.bias_model, kind, first + c)) ** 2
            if first == 0:
                w.S[c, c] += variance
                continue
            for i in range(3):
                for j in range(3):
                    w.S[3 + i, 3 + j] += variance * axes[3 * i + c] * axes[3 * j + c]
    if m.layout[AT_OBJECTS] >= 0:
        at, unsure = m.layout[AT_OBJECTS] + 6 * k + first, 0.0
        for i in range(3):
            unsure = max(unsure, m.P[at + i, at + i])
        for i in range(3):
            w.S[first + i, first + i] += unsure
    if not cholesky(w.S, first, 3, w.L):
        return False
    return whiten(w.L, w.residual, first, 3, w.white) > m.moved[SIGMAS] ** 2


@njit(cache=True)
def _others_agree(m: Memory, k: int) -> bool:
    """Tell whether enough other objects were used of late and stand where the map says, and are in the majority."""
    agree, against = 0, 0
    for i in range(len(m.places)):
        if i == k or m.known[i] == 0.0 or m.tallies[i, POSES] == 0.0:
            continue
        if m.places[i, STATUS] != ON_MAP or m.places[i, AGAINST_S] > 0.0:
            against += 1
        elif (m.counters[NOW] - m.tallies[i, USED_AT]) * 1e-9 <= m.moved[MEMORY_S]:
            agree += 1
    return agree >= m.moved[MIN_OTHERS] and agree >= against
