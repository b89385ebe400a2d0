"""How much of what detections get wrong lasts: of a network nearly all, of fiducial markers or a simulation nothing.

The two objects of a pair err against each other and the map, whatever the filter believes of the camera. Of errors e
whose variance lasts by the share s, E|e|^2 is 1 / (1 - s) times what half of E|e' - e|^2 is from one frame to the next.
The filter compares the geometric means of the two over pairs that it used whole. On real networks the ratio is above 2
from the first seconds on; where it is less, the objects' biases are made as much smaller as the errors last less. A
bias that is looked for where there is none costs most of what a map is good for.
"""

from __future__ import annotations

import math

from fusion.columns import Columns
from fusion.compiled import njit
from fusion.eskf import ACCEPTED
from fusion.measurements import OBJECT_POSE
from fusion.memory import NOW, Memory, Work
from fusion.nav_state import (
    AT_OBJECTS,
    N_BIAS_KINDS,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    SPREAD_COUNT,
    SPREAD_SIZE,
    SPREADS,
    Array,
)
from fusion.place_watch import RELEASED
from fusion.so3_kernels import apply, log_so3, multiply, multiply_transposed_right

LONGEST_STEP_NS = 300_000_000
"""What is further apart differs by what lasts for seconds, too."""
SETTLED_NS = 5_000_000_000
"""What an object errs by where it has just been put is taken for the map."""
LEAST_STEPS, MOST_STEPS = 150.0, 1000.0
"""So many steps of pairs tell the ratio first, and so many make the running means."""
LARGEST_LOG = 3.0
"""A gross error counts as no more."""
LASTING = 2.0
"""From this ratio on the biases are as large as the options say."""
LEAST_BIAS_SCALE = 0.05

# Places in row K of `Memory.pairs`; behind them, in the row of each object: when it was last the first of a pair (ns),
# with whom, when it was put where it is (ns), and how the other one disagreed, [rotation (rad), position (m)].
STEPS, LOG_TURN, LOG_PLACE, BIAS_SCALE, WHITE_BELOW = range(5)
STAMP, PARTNER, MET, ERROR = range(4)


def begin_pairs(m: Memory, white_below: float) -> None:
    """Know nothing of pairs yet."""
    m.pairs[:, [STAMP, MET]] = -math.inf
    m.pairs[-1] = 0.0
    m.pairs[-1, BIAS_SCALE], m.pairs[-1, WHITE_BELOW] = 1.0, white_below


@njit(cache=True)
def follow_pairs(m: Memory, w: Work, log: Columns, first: int, last: int) -> None:
    """Take neighbours among detections first..last-1, all of one stamp, into the means, and scale the biases."""
    means = m.pairs[m.layout[N_OBJECTS]]
    if m.layout[N_BIAS_KINDS] == 0 or means[WHITE_BELOW] == 0.0:
        return
    for j in range(first, last - 1):
        if _is_whole(m, log, j) and _is_whole(m, log, j + 1) and log.objects[j] != log.objects[j + 1]:
            _take_pair(m, w, log, j)
    scale = _scale_for(means)
    if scale != means[BIAS_SCALE]:
        for k in range(m.layout[N_OBJECTS]):
            at = m.layout[SPREADS] + SPREAD_SIZE * k
            for i in range(at, at + SPREAD_COUNT):
                m.x[i] *= scale / means[BIAS_SCALE]
        means[BIAS_SCALE] = scale


@njit(cache=True)
def bias_scale(m: Memory) -> float:
    """Return how large the biases' 1-sigma is taken, as a share of what it would be otherwise."""
    return float(m.pairs[m.layout[N_OBJECTS], BIAS_SCALE])


@njit(cache=True)
def _is_whole(m: Memory, log: Columns, j: int) -> bool:
    """Tell whether rotation and position of detection j were used."""
    decision, k = log.decisions[j], log.objects[j]
    if log.kinds[j] != OBJECT_POSE or decision & ACCEPTED != ACCEPTED or decision & RELEASED != 0 or m.orders[k] != 1:
        return False
    return m.layout[AT_OBJECTS] < 0 or m.counters[NOW] - m.pairs[k, MET] > SETTLED_NS


@njit(cache=True)
def _take_pair(m: Memory, w: Work, log: Columns, j: int) -> None:
    row, means, e = m.pairs[log.objects[j]], m.pairs[m.layout[N_OBJECTS]], w.error[:6]
    write_disagreement(m, w, log, j, e)
    if m.counters[NOW] - row[STAMP] < LONGEST_STEP_NS and row[PARTNER] == log.objects[j + 1]:
        turn, place = _log_ratio(e, row, 0), _log_ratio(e, row, 3)
        if math.isfinite(turn) and math.isfinite(place):
            means[STEPS] = min(means[STEPS] + 1.0, MOST_STEPS)
            means[LOG_TURN] += (turn - means[LOG_TURN]) / means[STEPS]
            means[LOG_PLACE] += (place - means[LOG_PLACE]) / means[STEPS]
    row[STAMP], row[PARTNER] = m.counters[NOW], log.objects[j + 1]
    for i in range(6):
        row[ERROR + i] = e[i]


@njit(cache=True)
def write_disagreement(m: Memory, w: Work, log: Columns, j: int, e: Array) -> None:
    """Write by how much detection j + 1 is off where detection j and the map put it, in camera axes (6,).

    [Log(R_cb R_there^T), t_cb - t_there] with T_there = T_ca T_wa^-1 T_wb of objects a and b.
    """
    a, b = OBJECTS + OBJECT_SIZE * log.objects[j], OBJECTS + OBJECT_SIZE * log.objects[j + 1]
    R_cw, R_there, turn, way = w.step[0:9], w.step[9:18], w.step[18:27], w.step[27:30]
    multiply_transposed_right(log.rotations[j], m.x[a : a + 9], R_cw)
    multiply(R_cw, m.x[b : b + 9], R_there)
    multiply_transposed_right(log.rotations[j + 1], R_there, turn)
    log_so3(turn, e)
    apply(R_cw, m.x[b + 9] - m.x[a + 9], m.x[b + 10] - m.x[a + 10], m.x[b + 11] - m.x[a + 11], way)
    for i in range(3):
        e[3 + i] = log.translations[j + 1, i] - log.translations[j, i] - way[i]


@njit(cache=True)
def _log_ratio(e: Array, row: Array, first: int) -> float:
    """Return the logarithm of |e|^2 over half of |e - the last one|^2, of three components; NaN where one is zero."""
    whole = step = 0.0
    for i in range(first, first + 3):
        whole += e[i] * e[i]
        step += 0.5 * (e[i] - row[ERROR + i]) ** 2
    if whole == 0.0 or step == 0.0:
        return math.nan
    return min(max(math.log(whole / step), -LARGEST_LOG), LARGEST_LOG)


@njit(cache=True)
def _scale_for(means: Array) -> float:
    if means[STEPS] < LEAST_STEPS:
        return 1.0
    ratio = math.exp(max(means[LOG_TURN], means[LOG_PLACE]))
    share = (ratio - means[WHITE_BELOW]) / (LASTING - means[WHITE_BELOW])
    return max(math.sqrt(min(max(share, 0.0), 1.0)), LEAST_BIAS_SCALE)
