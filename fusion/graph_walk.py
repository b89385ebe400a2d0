"""Where the graph's keyframes stand: the filter walks the log and stops where one is due."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion import memory
from fusion.compiled import njit
from fusion.eskf import fit_symmetry
from fusion.filter_loop import advance, angular_velocity_at, begin, emit, measure
from fusion.fuse import loop_columns
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP, camera_in_world
from fusion.memory import MODE, NOW, REPLACED, RESTARTS, TRACKING, Memory, Work, views, work_views
from fusion.nav_state import AT_BIASES, N_BIAS_KINDS, N_OBJECTS, OBJECT_SIZE, OBJECTS, TIME_OFFSET, Array, Ints
from fusion.options import FuseOptions
from fusion.prepare import Problem, fill_memory
from fusion.so3_kernels import multiply_transposed_left

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
    imu_stamps: Ints,
    imu_values: Array,
    stamps: Ints,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    translations: Array,
    covariances: Array,
    fitted_rotations: Array,
    fitted_covariances: Array,
    fresh: Ints,
    decisions: Ints,
    nis: Array,
    out_stamps: Ints,
    out_core: Array,
    out_sigma: Array,
    out_covariance: Array,
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
    rate = np.zeros(3)
    while cursor[IMU_ROW] < len(imu_stamps):
        k, j = cursor[IMU_ROW], cursor[NEXT]
        if j < len(stamps) and stamps[j] <= imu_stamps[k]:
            last, restarts, tracked = j, m.counters[RESTARTS] + m.counters[REPLACED], m.counters[MODE] == TRACKING
            while last < len(stamps) and stamps[last] == stamps[j]:
                last += 1
            advance(m, w, imu_stamps, imu_values, stamps[j])
            angular_velocity_at(m, imu_stamps, imu_values, rate)
            measure(m, w, j, last, kinds, objects, rotations, translations, covariances, rate, decisions, nis)
            cursor[NEXT] = last
            if m.counters[MODE] != TRACKING:
                continue
            _write_row(m, cursor, out_stamps, out_core, out_sigma, out_covariance)
            for i in range(j, last):
                fitted = fitted_rotations[i], fitted_covariances[i]
                _keep_fitted(m, w, kinds[i], objects[i], rotations[i], covariances[i], rate, fitted[0], fitted[1])
            jumped = _find_fresh(m, fresh)
            if not tracked or m.counters[RESTARTS] + m.counters[REPLACED] != restarts:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return STARTED
            if jumped or kinds[j] == ODOMETRY_STEP or m.counters[NOW] - cursor[KEYFRAME_NS] >= spacing_ns:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return KEYFRAME
            continue
        advance(m, w, imu_stamps, imu_values, imu_stamps[k])
        cursor[IMU_ROW] += 1
        if m.counters[MODE] == TRACKING:
            if cursor[ROWS] == 0 or out_stamps[cursor[ROWS] - 1] != m.counters[NOW]:
                _write_row(m, cursor, out_stamps, out_core, out_sigma, out_covariance)
            if m.counters[NOW] - cursor[KEYFRAME_NS] >= idle_ns:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return KEYFRAME
    return END


@njit(cache=True)
def _write_row(
    m: Memory, cursor: Ints, out_stamps: Ints, out_core: Array, out_sigma: Array, out_covariance: Array
) -> None:
    emit(m, cursor[ROWS], out_stamps, out_core, out_sigma, out_covariance)
    cursor[ROWS] += 1


@njit(cache=True)
def rewrite_row(
    floats: Array,
    integers: Ints,
    cursor: Ints,
    out_stamps: Ints,
    out_core: Array,
    out_sigma: Array,
    out_covariance: Array,
) -> None:
    """Write the newest row again, after the graph has corrected the filter's state."""
    emit(views(floats, integers), cursor[ROWS] - 1, out_stamps, out_core, out_sigma, out_covariance)


@njit(cache=True)
def _keep_fitted(
    m: Memory,
    w: Work,
    kind: int,
    k: int,
    rotation: Array,
    covariance: Array,
    rate: Array,
    fitted_rotation: Array,
    fitted_covariance: Array,
) -> None:
    """Write a measurement's rotation and covariance as the filter uses them."""
    fitted_rotation[:] = rotation
    w.R[:, :] = (m.scales[k] if kind == OBJECT_POSE else 1.0) * covariance
    if kind == OBJECT_POSE and m.orders[k] != 1:
        _fit_to_state(m, w, k, fitted_rotation, rate)
    fitted_covariance[:, :] = w.R


@njit(cache=True)
def _fit_to_state(m: Memory, w: Work, k: int, R_m: Array, rate: Array) -> None:
    """Turn a symmetric object's measured rotation to where it fits the state, with its noise in w.R."""
    R_wi, R_wc, p_wi, R_co = w.step[0:9], w.step[9:18], w.step[18:21], w.step[30:39]
    camera_in_world(m.x, m.x[TIME_OFFSET], rate, R_wi, p_wi, R_wc, w.step[21:30])
    at = OBJECTS + OBJECT_SIZE * k
    multiply_transposed_left(R_wc, m.x[at : at + 9], R_co)
    fit_symmetry(R_m, R_co, m.axes[k], m.orders[k], w.R, w.scratch)


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
        self.columns = loop_columns(problem)
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
        n, c = self.cursor[ROWS], self.columns
        return c.out_stamps[:n], c.out_core[:n], c.out_sigma[:n], c.out_covariance[:n].reshape(-1, 6, 6)

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
            *c[:8],
            self.rotations,
            self.covariances,
            self.fresh,
            *c[8:],
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
        c = self.columns
        out = (c.out_stamps, c.out_core, c.out_sigma, c.out_covariance)
        rewrite_row(self.floats, self.integers, self.cursor, *out)
