"""The factor graph: fixed-lag smoother and batch on the measurements and switches of the filter."""

from __future__ import annotations

import time
from dataclasses import replace

from fusion import memory
from fusion.calibrated import calibrated
from fusion.fuse import gate_log, never_started, result_from_rows
from fusion.graph_batch import run_batch
from fusion.graph_fixed import new_builder
from fusion.graph_motion import MotionChain
from fusion.graph_smoother import FixedLagSmoother
from fusion.graph_walk import Walk
from fusion.options import FuseOptions
from fusion.prepare import Problem
from fusion.result import FuseResult


def run_graph(problem: Problem, options: FuseOptions) -> FuseResult:
    """Fuse a log with the factor graph: `graph` is causal (fixed lag), `batch` smooths the whole log.

    Raises InputError where the start's conditions are never met.
    """
    return run_batch(problem, options) if options.estimator == "batch" else run_fixed_lag(problem, options)


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
        if keyframe.started or smoother is None:
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
        int(m.counters[memory.RESTARTS]),
    )
    return replace(result, motion=problem.motion, body=problem.body, calibrated=calibrated(m, problem))
