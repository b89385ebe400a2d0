"""Fixed-interval smoothing: every state of the filter with what the whole log says of it.

The filter runs twice. The first time it keeps its memory every so often; then each stretch between two kept memories is
run again, last one first, writing down what it does (`fusion/tape.py`), and gone back over (`fusion/unroll.py`). So the
memory needed does not grow with the log, but for the results. Smoothed results are not causal and are named apart.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion import filter_loop, memory, tape
from fusion.columns import OUT_CORE, Columns, Rows
from fusion.fuse import gate_log, loop_columns, result_from_rows, with_findings
from fusion.nav_state import CORE, StateLayout
from fusion.never_started import never_started
from fusion.options import FuseOptions
from fusion.prepare import Problem, fill_memory
from fusion.result import FuseResult
from fusion.unroll import unroll

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

STRETCH = 512  # IMU samples between two kept memories


@dataclass(frozen=True)
class _Kept:
    """The filter where a stretch begins."""

    floats: Array
    integers: Stamps
    first: int
    measurement: int
    row: int


def run_smoother(problem: Problem, options: FuseOptions) -> FuseResult:
    """Smooth a whole log: the filter's rows, each with what comes after it taken in, named fuse/eskf-smoothed/...

    Sigmas and covariances are the smoothed ones; the gate's decisions are the filter's. Raises InputError where the
    filter never starts.
    """
    began = time.perf_counter()
    floats, integers = fill_memory(problem, options)
    columns, rows, core, covariance = smooth(problem, floats, integers)
    if len(core) == 0:
        raise never_started(problem, options)
    m = memory.views.py_func(floats, integers)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(min=0.0))
    result = result_from_rows(
        f"fuse/eskf-smoothed/{options.measurements}",
        (rows.stamps[: len(core)], core, sigma, np.ascontiguousarray(covariance[:, :6, :6])),
        gate_log(problem, columns.decisions, columns.nis),
        time.perf_counter() - began,
    )
    return with_findings(result, problem, m)


def smooth(problem: Problem, floats: Array, integers: Stamps) -> tuple[Columns, Rows, Array, Array]:
    """Run a filled memory over the log and back.

    Returns the filter's columns and rows and, per row, the smoothed core (N, 21) and its covariance (N, 15, 15).
    """
    (columns, rows), samples = loop_columns(problem), len(problem.imu)
    kept, measurement, row = [], 0, 0
    for first in range(0, samples, STRETCH):
        kept.append(_Kept(floats.copy(), integers.copy(), first, measurement, row))
        end = min(first + STRETCH, samples)
        measurement, row = filter_loop.run_part(floats, integers, columns, rows, first, end, measurement, row)
    n = problem.layout.n_error
    core, covariance = np.empty((row, OUT_CORE)), np.empty((row, CORE, CORE))
    gradient, information = np.zeros(n), np.zeros((n, n))
    stop = samples, measurement
    for start in reversed(kept):
        _go_back(start, stop, columns, rows, gradient, information, core, covariance)
        stop = start.first, start.measurement
    return columns, rows, core, covariance


def _go_back(
    start: _Kept,
    end: tuple[int, int],
    columns: Columns,
    rows: Rows,
    gradient: Array,
    information: Array,
    core: Array,
    covariance: Array,
) -> None:
    """Run a stretch again with a tape, and go back over it."""
    samples, measurements = end[0] - start.first, end[1] - start.measurement
    layout = memory.views.py_func(start.floats, start.integers).layout
    stamps = len(np.unique(columns.stamps[start.measurement : end[1]]))
    size = tape.tape_bound(layout, samples, stamps, measurements)
    floats, integers = tape.with_tape(start.floats, start.integers, size)
    filter_loop.run_part(floats, integers, columns, rows, start.first, end[0], start.measurement, start.row)
    m = memory.views.py_func(floats, integers)
    core_layout = StateLayout().as_integers()
    unroll(m.tape, m.counters[memory.TAPE_END], layout, core_layout, gradient, information, core, covariance)
