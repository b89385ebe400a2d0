"""The factor graph: fixed-lag smoother and batch on the measurements and switches of the filter."""

from __future__ import annotations

import time

import numpy as np

from fusion.coarse_offset import retimed
from fusion.fuse import gate_log, result_from_rows, run_filter, with_findings
from fusion.graph_batch import run_batch
from fusion.graph_fixed import new_builder
from fusion.graph_motion import MotionChain
from fusion.graph_smoother import FixedLagSmoother
from fusion.graph_walk import Walk
from fusion.never_started import never_started
from fusion.options import FuseOptions
from fusion.prepare import WITH_IMU, Problem
from fusion.result import FuseResult
from poet_loc.core.input_error import InputError

_FAR_OFF_S = 0.02


def run_graph(problem: Problem, options: FuseOptions) -> FuseResult:
    """Fuse a log with the factor graph: `graph` is causal (fixed lag), `batch` smooths the whole log.

    Raises InputError where the start's conditions are never met, and where the graph has no solution.
    """
    problem = _timed(problem, options)
    try:
        return run_batch(problem, options) if options.estimator == "batch" else run_fixed_lag(problem, options)
    except (RuntimeError, np.linalg.LinAlgError) as error:  # gtsam's "Indeterminate linear system", over several lines
        raise InputError(
            f"the graph cannot be solved ({' '.join(str(error).split())[:80]})",
            path=problem.path,
            fix="see what fuse/eskf does; gross errors must not pass the gate (--gate.probability below 1)",
        ) from error


def _timed(problem: Problem, options: FuseOptions) -> Problem:
    """Put the measurements to when they were made, as a pass of the filter finds it, where their stamps are far off.

    The filter follows its estimate. A factor stays at its keyframe, and what it takes for uniform motion from there is
    wrong by the square of the offset: 15 ms at 100, 100 ms at 200.
    """
    if not problem.layout.time_offset or problem.motion not in WITH_IMU:
        return problem
    found = run_filter(problem, options).calibrated
    timeshift = None if found is None else found.timeshift_cam_imu_s
    if timeshift is None or abs(timeshift - problem.calibration.timeshift_cam_imu_s) < _FAR_OFF_S:
        return problem
    return retimed(problem, timeshift)


def run_fixed_lag(problem: Problem, options: FuseOptions) -> FuseResult:
    """Run the fixed-lag smoother over a log.

    The filter walks between keyframes from the graph's newest state and covariance, so rows at the IMU's rate are
    causal, know every measurement up to their stamp, and carry the graph's covariance propagated to that stamp.
    """
    began = time.perf_counter()
    walk = Walk(problem, options)
    m, chain = walk.memory, MotionChain.of(problem, options)
    builder = new_builder(problem.layout, m, chain, options.graph)
    smoother: FixedLagSmoother | None = None
    for keyframe in walk.keyframes():
        if keyframe.started or keyframe.found_again or smoother is None:
            smoother = FixedLagSmoother(builder, options.graph)
            smoother.start(keyframe, walk)
        else:
            smoother.extend(keyframe, walk)
            walk.rewrite()
    if smoother is None:
        raise never_started(problem, options)
    result = result_from_rows(
        f"fuse/graph/{options.measurements}",
        walk.rows,
        gate_log(problem, walk.columns.decisions, walk.columns.nis),
        time.perf_counter() - began,
    )
    return with_findings(result, problem, m)
