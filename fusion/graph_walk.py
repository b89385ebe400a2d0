"""Where the graph's keyframes stand: the filter walks the log and stops where one is due."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion import memory
from fusion.columns import Columns, Rows, read_fitted
from fusion.compiled import njit
from fusion.filter_loop import emit, end_of_stamp, measure
from fusion.filter_motion import advance, begin, find_rate
from fusion.fuse import loop_columns
from fusion.measurements import ODOMETRY_STEP
from fusion.memory import MODE, NOW, REPLACED, RESTARTS, TRACKING, Memory, views, work_views
from fusion.nav_state import AT_BIASES, N_BIAS_KINDS, N_OBJECTS, Array, Ints
from fusion.options import FuseOptions
from fusion.prepare import Problem, fill_memory
from fusion.so3_kernels import copy

# Places in the cursor: next IMU row, next measurement, rows written, stamp of the newest keyframe.
IMU_ROW, NEXT, ROWS, KEYFRAME_NS, CURSOR_SIZE = range(5)

END, KEYFRAME, STARTED = range(3)  # why filter_until_keyframe returned


@njit(cache=True)
def begin_log(floats: Array, integers: Ints, cursor: Ints, imu_stamps: Ints, imu_values: Array, stamps: Ints) -> None:
    """Put the filter at the first IMU sample and the cursor behind the measurements before it."""
    m = views(floats, integers)
    while cursor[NEXT] < len(stamps) and stamps[cursor[NEXT]] < imu_stamps[0]:
        cursor[NEXT] += 1
    begin(m, imu_stamps[0], imu_values[0, 3:6], 0)


@njit(cache=True)
def filter_until_keyframe(
    floats: Array,
    integers: Ints,
    cursor: Ints,
    spacing_ns: int,
    idle_ns: int,
    log: Columns,
    fitted_rotations: Array,
    fitted_covariances: Array,
    fresh: Ints,
    rows: Rows,
) -> int:
    """Filter up to the next keyframe and return KEYFRAME, STARTED where the filter (re)started or put an object
    elsewhere there, or END.

    A keyframe is due at the first stamp with measurements spacing_ns after the last one, where an object's bias jumped,
    wherever odometry is measured, and at an IMU sample idle_ns after the last one. Its own measurements are taken in.
    fitted_rotations and fitted_covariances get each measurement as it was used (symmetry chosen, noise scaled); fresh
    (kinds * objects * 2 halves) tells which biases nothing ties to the motion: those that are 1 and were 0 have just
    been forgotten.
    """
    m = views(floats, integers)
    w = work_views(m.work, len(m.P))
    imu_stamps, stamps = log.imu_stamps, log.stamps
    while cursor[IMU_ROW] < len(imu_stamps):
        k, j = cursor[IMU_ROW], cursor[NEXT]
        if j < len(stamps) and stamps[j] <= imu_stamps[k]:
            restarts, tracked = m.counters[RESTARTS] + m.counters[REPLACED], m.counters[MODE] == TRACKING
            last = end_of_stamp(stamps, j, len(stamps))
            advance(m, w, imu_stamps, log.imu_values, stamps[j])
            find_rate(m, w, imu_stamps, log.imu_values)
            measure(m, w, log, j, last)
            cursor[NEXT] = last
            if m.counters[MODE] != TRACKING:
                continue
            _write_row(m, cursor, rows)
            for i in range(j, last):
                read_fitted(m, w, log, i)
                copy(w.measured, fitted_rotations[i])
                copy(w.R.reshape(36), fitted_covariances[i].reshape(36))
            jumped = _find_fresh(m, fresh)
            if not tracked or m.counters[RESTARTS] + m.counters[REPLACED] != restarts:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return STARTED
            if jumped or log.kinds[j] == ODOMETRY_STEP or m.counters[NOW] - cursor[KEYFRAME_NS] >= spacing_ns:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return KEYFRAME
            continue
        advance(m, w, imu_stamps, log.imu_values, imu_stamps[k])
        cursor[IMU_ROW] += 1
        if m.counters[MODE] == TRACKING:
            if cursor[ROWS] == 0 or rows.stamps[cursor[ROWS] - 1] != m.counters[NOW]:
                _write_row(m, cursor, rows)
            if m.counters[NOW] - cursor[KEYFRAME_NS] >= idle_ns:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return KEYFRAME
    return END


@njit(cache=True)
def _write_row(m: Memory, cursor: Ints, rows: Rows) -> None:
    emit(m, rows, cursor[ROWS])
    cursor[ROWS] += 1


@njit(cache=True)
def rewrite_row(floats: Array, integers: Ints, cursor: Ints, rows: Rows) -> None:
    """Write the newest row again, after the graph has corrected the filter's state."""
    emit(views(floats, integers), rows, cursor[ROWS] - 1)


@njit(cache=True)
def _find_fresh(m: Memory, fresh: Ints) -> bool:
    """Mark the bias halves (rotation, translation) that nothing ties to the motion: new, or just forgotten."""
    found = False
    for half in range(2 * m.layout[N_BIAS_KINDS] * m.layout[N_OBJECTS]):
        at = m.layout[AT_BIASES] + 3 * half
        tied = False
        for r in range(3):
            for c in range(6):
                tied = tied or m.P[at + r, c] != 0.0
        if not tied and fresh[half] == 0:
            found = True
        fresh[half] = 0 if tied else 1
    return found


@dataclass(frozen=True)
class Keyframe:
    """A keyframe as the filter hands it over: its state is in `Walk.memory`."""

    stamp_ns: int
    started: bool
    """The filter has just started, or started again: what was before does not count."""
    forgotten: NDArray[np.bool_]
    """(kinds * objects, 2) whose bias of rotation, translation was forgotten at this stamp."""
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
        self.rotations, self.covariances = np.zeros((count, 9)), np.zeros((count, 6, 6))
        self.cursor = np.zeros(CURSOR_SIZE, dtype=np.int64)
        self.begun, self.first = False, 0
        self.fresh = np.zeros(2 * max(1, problem.layout.n_objects * problem.layout.bias_kinds), dtype=np.int64)
        self._spacing_ns = round(0.999e9 / options.graph.keyframe_rate_hz)
        self._idle_ns = round(options.graph.idle_s * 1e9)

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
        c, cursor, fresh, newest = self.columns, self.cursor, self.fresh.copy(), int(self.cursor[KEYFRAME_NS])
        if not self.begun:
            self.begin()
        event = filter_until_keyframe(
            self.floats,
            self.integers,
            cursor,
            self._spacing_ns,
            self._idle_ns,
            c,
            self.rotations,
            self.covariances,
            self.fresh,
            self.out,
        )
        stamp, last = int(self.memory.counters[NOW]), int(cursor[NEXT])
        if event == END:
            if not to_the_end or cursor[ROWS] == 0 or stamp == newest:
                return None
            cursor[KEYFRAME_NS] = stamp
        first, self.first = self.first, last
        here = first + int(np.searchsorted(c.stamps[first:last], stamp))
        forgotten = ((self.fresh > 0) & (fresh == 0)).reshape(-1, 2)
        return Keyframe(stamp, event == STARTED, forgotten, range(first, here), range(here, last))

    def rewrite(self) -> None:
        """Write the newest row again after a correction of the memory."""
        rewrite_row(self.floats, self.integers, self.cursor, self.out)
