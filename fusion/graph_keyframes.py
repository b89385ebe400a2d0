"""Where the graph's keyframes stand: the filter walks the log and stops where one is due."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion import filter_loop, memory
from fusion.graph_steps import (
    CURSOR_SIZE,
    END,
    NEXT,
    ROWS,
    STARTED,
    begin_log,
    filter_until_keyframe,
    rewrite_row,
)
from fusion.options import FuseOptions
from fusion.prepare import Problem, fill_memory

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


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
        self.floats, self.integers = fill_memory(problem, options)
        self.memory = memory.views.py_func(self.floats, self.integers)
        imu, measured = problem.imu, problem.measurements
        count, rows = len(measured), len(imu) + len(measured)
        self.imu_values = np.hstack([imu.angular_velocity, imu.specific_force])
        self.imu_stamps, self._measured = imu.stamps_ns, measured
        self.decisions, self.nis = np.zeros(count, dtype=np.int64), np.full((count, 3), np.nan)
        self.rotations, self.covariances = np.zeros((count, 9)), np.zeros((count, 6, 6))
        self._stamps, self._core = np.zeros(rows, dtype=np.int64), np.zeros((rows, filter_loop.OUT_CORE))
        self._sigma = np.zeros((rows, filter_loop.OUT_SIGMA))
        self._covariance = np.zeros((rows, filter_loop.OUT_COVARIANCE))
        self._cursor = np.zeros(CURSOR_SIZE, dtype=np.int64)
        self._fresh = np.zeros(2 * max(1, problem.layout.n_objects * problem.layout.bias_kinds), dtype=np.int64)
        self._spacing_ns = round(0.999e9 / options.graph.keyframe_rate_hz)
        self._idle_ns = round(options.graph.idle_s * 1e9)

    @property
    def rows(self) -> tuple[Ints, Array, Array, Array]:
        """What was written so far: stamps, core, sigmas, covariances."""
        n = self._cursor[ROWS]
        return self._stamps[:n], self._core[:n], self._sigma[:n], self._covariance[:n].reshape(-1, 6, 6)

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield the keyframes of the whole log."""
        measured, cursor, out = self._measured, self._cursor, (self._stamps, self._core, self._sigma, self._covariance)
        begin_log(self.floats, self.integers, cursor, self.imu_stamps, self.imu_values, measured.stamps_ns)
        first = 0
        while True:
            fresh = self._fresh.copy()
            event = filter_until_keyframe(
                self.floats,
                self.integers,
                cursor,
                self._spacing_ns,
                self._idle_ns,
                self.imu_stamps,
                self.imu_values,
                measured.stamps_ns,
                measured.kinds,
                measured.objects,
                measured.rotations,
                measured.translations,
                measured.covariances,
                self.decisions,
                self.nis,
                self.rotations,
                self.covariances,
                self._fresh,
                *out,
            )
            if event == END:
                return
            stamp = int(self.memory.counters[memory.NOW])
            last = int(cursor[NEXT])
            here = first + int(np.searchsorted(measured.stamps_ns[first:last], stamp))
            forgotten = ((self._fresh > 0) & (fresh == 0)).reshape(-1, 2)
            yield Keyframe(stamp, event == STARTED, forgotten, range(first, here), range(here, last))
            first = last

    def rewrite(self) -> None:
        """Write the newest row again after a correction of the memory."""
        out = (self._stamps, self._core, self._sigma, self._covariance)
        rewrite_row(self.floats, self.integers, self._cursor, *out)
