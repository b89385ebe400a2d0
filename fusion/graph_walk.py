"""Where the graph's keyframes stand: the filter walks the log and stops where one is due."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion import memory
from fusion.ballot import LOST_SIGMA
from fusion.columns import Columns, Fitted, Rows, read_fitted
from fusion.compiled import njit
from fusion.eskf import ACCEPTED, POSITION_ONLY, ROTATION_ONLY, cholesky, whiten
from fusion.filter_loop import emit, end_of_stamp, measure
from fusion.filter_motion import advance, begin, find_rate
from fusion.fuse import loop_columns
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP, residual_and_jacobian
from fusion.memory import IMU_AT, MODE, NOW, REPLACED, RESTARTS, TRACKING, Memory, Work, views, work_views
from fusion.nav_state import AT_BIASES, N_BIAS_KINDS, N_OBJECTS, SPREAD_SIZE, SPREADS, Array, Ints
from fusion.odometry import IS_ODOMETRY, ROTATION_DOUBT, TRANSLATION_DOUBT
from fusion.options import FuseOptions
from fusion.prepare import Problem, fill_memory
from fusion.so3_kernels import copy

# Places in the cursor: next IMU row, next measurement, rows written, stamp of the newest keyframe, first measurement at
# the last stamp with any; 1 where the newest row is to be written again, 1 where an object's bias has just jumped.
IMU_ROW, NEXT, ROWS, KEYFRAME_NS, HERE, CORRECTED, JUMPED, CURSOR_SIZE = range(8)

ON_THE_WAY, KEYFRAME, STARTED, FOUND_AGAIN, END = range(5)  # where the filter is

NO_KERNEL, HUBER, CAUCHY = range(3)
KERNELS = {"none": NO_KERNEL, "huber": HUBER, "cauchy": CAUCHY}

_ROUNDED_UP = 1.0 + 1e-6


@njit(cache=True)
def begin_log(floats: Array, integers: Ints, cursor: Ints, imu_stamps: Ints, imu_values: Array, stamps: Ints) -> None:
    """Put the filter at the first IMU sample and the cursor behind the measurements before it."""
    m = views(floats, integers)
    while cursor[NEXT] < len(stamps) and stamps[cursor[NEXT]] < imu_stamps[0]:
        cursor[NEXT] += 1
    begin(m, imu_stamps[0], imu_values[0, 3:6], 0)


class Spacing(NamedTuple):
    """When a keyframe is due, and what weighs its measurements."""

    every_ns: int  # at the first stamp with measurements so long after the last one
    idle_ns: int  # at an IMU sample so long after it
    kernel: int
    width: float


@njit(cache=True)
def filter_until_keyframe(
    floats: Array,
    integers: Ints,
    cursor: Ints,
    spacing: Spacing,
    log: Columns,
    fitted: Fitted,
    fresh: Array,
    rows: Rows,
) -> int:
    """Filter up to the next keyframe and return KEYFRAME, STARTED where the filter (re)started or put an object
    elsewhere there, FOUND_AGAIN where it hardly knew its place before, or END.

    A keyframe is due where `spacing` says so, where an object's bias jumped, wherever odometry is measured, and where
    it carries the state over what is not known (from a detection's keyframe to itself there is no noise). Its own
    measurements are taken in. fresh (2, kinds * objects * 2 halves) tells of each bias its variance where nothing ties
    it to the motion, else 0, and whether it has just been forgotten.
    """
    m = views(floats, integers)
    w = work_views(m.work, len(m.P))
    if cursor[CORRECTED] == 1 and cursor[ROWS] > 0:
        emit(m, rows, cursor[ROWS] - 1)
    cursor[CORRECTED] = cursor[JUMPED] = 0
    while cursor[IMU_ROW] < len(log.imu_stamps):
        k, j = cursor[IMU_ROW], cursor[NEXT]
        if j < len(log.stamps) and log.stamps[j] <= log.imu_stamps[k]:
            where = _go_to_measurements(m, w, cursor, spacing, log, fitted, fresh, rows)
        else:
            where = _go_to_sample(m, w, cursor, spacing, log, rows)
        if where != ON_THE_WAY:
            cursor[KEYFRAME_NS] = m.counters[NOW]
            return where
    return END


@njit(cache=True)
def _go_to_measurements(
    m: Memory, w: Work, cursor: Ints, spacing: Spacing, log: Columns, fitted: Fitted, fresh: Array, rows: Rows
) -> int:
    """Filter up to the next stamp with measurements and take these in; return what the filter has come to."""
    first, c = cursor[NEXT], m.counters
    last = end_of_stamp(log.stamps, first, len(log.stamps))
    restarts, tracked = c[RESTARTS] + c[REPLACED], c[MODE] == TRACKING
    advance(m, w, log.imu_stamps, log.imu_values, log.stamps[first])
    unsure = max(m.P[3, 3], m.P[4, 4], m.P[5, 5]) > m.start[LOST_SIGMA] ** 2
    find_rate(m, w, log.imu_stamps, log.imu_values)
    measure(m, w, log, first, last)
    cursor[HERE], cursor[NEXT] = first, last
    if c[MODE] != TRACKING:
        return ON_THE_WAY
    _write_row(m, cursor, rows)
    for i in range(first, last):
        read_fitted(m, w, log, i)
        copy(w.measured, fitted.rotations[i])
        copy(w.R.reshape(36), fitted.covariances[i].reshape(36))
        if log.kinds[i] == OBJECT_POSE and m.layout[N_BIAS_KINDS] > 0:
            at = m.layout[SPREADS] + SPREAD_SIZE * log.objects[i]
            copy(m.x[at : at + 3], fitted.spreads[i])
        fitted.weights[i] = _weight(m, w, log, i, spacing.kernel, spacing.width)
    cursor[JUMPED] = 1 if _find_fresh(m, fresh) else 0
    if not tracked or c[RESTARTS] + c[REPLACED] != restarts:
        return STARTED
    if unsure:
        return FOUND_AGAIN
    due = cursor[JUMPED] == 1 or log.kinds[first] == ODOMETRY_STEP or _is_doubted(m, log)
    return KEYFRAME if due or c[NOW] - cursor[KEYFRAME_NS] >= spacing.every_ns else ON_THE_WAY


@njit(cache=True)
def _go_to_sample(m: Memory, w: Work, cursor: Ints, spacing: Spacing, log: Columns, rows: Rows) -> int:
    """Filter up to the next IMU sample; return what the filter has come to."""
    c = m.counters
    advance(m, w, log.imu_stamps, log.imu_values, log.imu_stamps[cursor[IMU_ROW]])
    cursor[IMU_ROW] += 1
    if c[MODE] != TRACKING:
        return ON_THE_WAY
    if cursor[ROWS] == 0 or rows.stamps[cursor[ROWS] - 1] != c[NOW]:
        _write_row(m, cursor, rows)
    return KEYFRAME if _is_doubted(m, log) or c[NOW] - cursor[KEYFRAME_NS] >= spacing.idle_ns else ON_THE_WAY


@njit(cache=True)
def _is_doubted(m: Memory, log: Columns) -> bool:
    """Tell whether something of odometry's motion up to now is not known."""
    k = m.counters[IMU_AT]
    k -= 1 if k > 0 and m.counters[NOW] == log.imu_stamps[k] else 0
    row = log.imu_values[k]
    return m.noise[IS_ODOMETRY] > 0.0 and row[ROTATION_DOUBT] + row[TRANSLATION_DOUBT] > 0.0


@njit(cache=True)
def _write_row(m: Memory, cursor: Ints, rows: Rows) -> None:
    emit(m, rows, cursor[ROWS])
    cursor[ROWS] += 1


@njit(cache=True)
def _weight(m: Memory, w: Work, log: Columns, i: int, kernel: int, width: float) -> float:
    """Return a kernel's weight of measurement i, which w holds as it was used, at the state of now.

    That state knows the measurement: by its error before, one that knows little would refuse what it lacks most.
    """
    kind, passed = log.kinds[i], log.decisions[i] & ACCEPTED
    if kernel == NO_KERNEL or passed == 0 or kind == ODOMETRY_STEP:
        return 1.0
    seen = (log.objects[i], w.measured[0:9], log.translations[i], m.x, w.rate, w.offset[0])
    residual_and_jacobian(kind, *seen, m.layout, w.residual, w.H, m.columns, w.step)
    first, end = 0 if passed & ROTATION_ONLY else 3, 6 if passed & POSITION_ONLY else 3
    if not cholesky(w.R, first, end - first, w.L):
        return 1.0
    squared = whiten(w.L, w.residual, first, end - first, w.white)
    if kernel == HUBER:
        return 1.0 if squared <= width * width else width / math.sqrt(squared)
    return width * width / (width * width + squared)


@njit(cache=True)
def _find_fresh(m: Memory, fresh: Array) -> bool:
    """Find the bias halves (rotation, translation) that nothing ties to the motion, and those just forgotten.

    These were tied, or are less sure than they were: what was refused ever since it was first seen jumps as well.
    """
    found = False
    for half in range(2 * m.layout[N_BIAS_KINDS] * m.layout[N_OBJECTS]):
        at = m.layout[AT_BIASES] + 3 * half
        tied, variance = False, 0.0
        for r in range(3):
            variance += m.P[at + r, at + r]
            for c in range(6):
                tied = tied or m.P[at + r, c] != 0.0
        forgotten = not tied and (fresh[0, half] == 0.0 or variance > _ROUNDED_UP * fresh[0, half])
        fresh[0, half], fresh[1, half] = 0.0 if tied else variance, 1.0 if forgotten else 0.0
        found = found or forgotten
    return found


@dataclass(frozen=True)
class Forgotten:
    """An object's bias that is another from a stamp on."""

    object: int
    kind: int
    half: int
    """0 rotation, 1 translation."""
    sigma: Array
    """(3,) of what it is now."""


@dataclass(frozen=True)
class Keyframe:
    """A keyframe as the filter hands it over: its state is in `Walk.memory`."""

    stamp_ns: int
    started: bool
    """The filter has just started, or started again: what was before does not count."""
    found_again: bool
    """The filter was so unsure of its place before this stamp that what is linear there does not hold."""
    forgotten: list[Forgotten]
    """Which biases were at this stamp."""
    between: range
    """Measurements after the keyframe before, up to this one."""
    at: range
    """Measurements at its stamp."""


class Walk:
    """The filter on its way through a log, stopping at keyframes; a graph may correct its memory there.

    Between keyframes it is the filter that predicts, gates, and writes rows at the IMU's rate, from the last keyframe's
    state and covariance on: causal, and every row knows all measurements up to its stamp.
    """

    def __init__(self, problem: Problem, options: FuseOptions) -> None:
        self.problem = problem
        self.floats, self.integers = fill_memory(problem, options)
        self.memory = memory.views.py_func(self.floats, self.integers)
        self.columns, self.out = loop_columns(problem)
        count = len(problem.measurements)
        self.fitted = Fitted(np.zeros((count, 9)), np.zeros((count, 6, 6)), np.ones((count, 3)), np.ones(count))
        self.cursor = np.zeros(CURSOR_SIZE, dtype=np.int64)
        self.begun, self.first = False, 0
        self.fresh = np.zeros((2, 2 * max(1, problem.layout.n_objects * problem.layout.bias_kinds)))
        graph = options.graph
        spans = round(0.999e9 / graph.keyframe_rate_hz), round(graph.idle_s * 1e9)
        self._spacing = Spacing(*spans, KERNELS[graph.kernel], graph.kernel_width)

    @property
    def rows(self) -> tuple[Ints, Array, Array, Array]:
        """What was written so far: stamps, core, sigmas, covariances."""
        n, out = self.cursor[ROWS], self.out
        return out.stamps[:n], out.core[:n], out.sigma[:n], out.covariance[:n].reshape(-1, 6, 6)

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield the keyframes of the whole log, the last one at its end."""
        while (keyframe := self.next_keyframe()) is not None:
            yield keyframe

    def begin(self) -> None:
        """Put the filter at the first sample."""
        c, self.begun = self.columns, True
        begin_log(self.floats, self.integers, self.cursor, c.imu_stamps, c.imu_values, c.stamps)

    def next_keyframe(self, to_the_end: bool = True) -> Keyframe | None:
        """Walk on to the next keyframe; None where there are no more samples.

        to_the_end: the last samples are the log's, so a keyframe is due there too.
        """
        cursor, newest = self.cursor, int(self.cursor[KEYFRAME_NS])
        if not self.begun:
            self.begin()
        walked = self._spacing, self.columns, self.fitted, self.fresh, self.out
        event = filter_until_keyframe(self.floats, self.integers, cursor, *walked)
        stamp, last = int(self.memory.counters[NOW]), int(cursor[NEXT])
        if event == END:
            if not to_the_end or cursor[ROWS] == 0 or stamp == newest:
                return None
            cursor[KEYFRAME_NS] = stamp
        first, self.first = self.first, last
        here = int(cursor[HERE]) if last > first and self.columns.stamps[cursor[HERE]] == stamp else last
        forgotten = [self._forgotten(int(half)) for half in np.flatnonzero(self.fresh[1])] if cursor[JUMPED] else []
        return Keyframe(stamp, event == STARTED, event == FOUND_AGAIN, forgotten, range(first, here), range(here, last))

    def _forgotten(self, half: int) -> Forgotten:
        layout = self.problem.layout
        kind, k = divmod(half // 2, layout.n_objects)
        variances = np.diag(self.memory.P)[layout.error_slice("biases", k, kind)]
        return Forgotten(k, kind, half % 2, np.sqrt(variances[3 * (half % 2) : 3 * (half % 2) + 3]))

    def rewrite(self) -> None:
        """Have the newest row written again, after a correction of the memory, when the filter goes on."""
        self.cursor[CORRECTED] = 1
