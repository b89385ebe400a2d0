"""The factor graph: fixed-lag smoother and batch on the measurements and switches of the filter."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion import memory
from fusion.calibrated import calibrated
from fusion.fuse import gate_log, result_from_rows
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import ImuChain
from fusion.graph_keyframes import Walk
from fusion.graph_smoother import FixedLagSmoother
from fusion.options import FuseOptions
from fusion.prepare import Problem
from fusion.result import FuseResult
from poet_loc.core.input_error import InputError

Array = NDArray[np.float64]


def run_graph(problem: Problem, options: FuseOptions) -> FuseResult:
    """Fuse a log with the factor graph: `graph` is causal (fixed lag), `batch` smooths the whole log.

    Raises InputError where the start's conditions are never met.
    """
    if options.estimator == "batch":
        raise InputError("the batch graph is not there yet", fix="choose the estimator graph or eskf")
    return run_fixed_lag(problem, options)


def run_fixed_lag(problem: Problem, options: FuseOptions) -> FuseResult:
    """Run the fixed-lag smoother over a log.

    The filter walks between keyframes from the graph's newest state and covariance, so rows at the IMU's rate are
    causal, know every measurement up to their stamp, and carry the graph's covariance propagated to that stamp.
    """
    began = time.perf_counter()
    walk = Walk(problem, options)
    chain = ImuChain.of(problem.imu, problem.imu_noise, options.gap)
    smoother: FixedLagSmoother | None = None
    builder = GraphBuilder(problem.layout, walk.memory.x, walk.memory.bias_model, chain, options.graph)
    for keyframe in walk.keyframes():
        if keyframe.started:
            smoother = FixedLagSmoother(builder, options.graph)
            smoother.start(keyframe, walk)
        else:
            assert smoother is not None
            smoother.extend(keyframe, walk, problem)
        walk.rewrite()
    if smoother is None:
        raise not_started(problem, options)
    result = result_from_rows(
        f"fuse/{options.estimator}/{options.measurements}",
        walk.rows,
        gate_log(problem, walk.decisions, walk.nis),
        time.perf_counter() - began,
        int(walk.memory.counters[memory.RESTARTS]),
    )
    return replace(result, calibrated=calibrated(walk.memory, problem))


def not_started(problem: Problem, options: FuseOptions) -> InputError:
    """Return what to raise where no start was found."""
    return InputError(
        f"the graph never started: no {options.start.min_votes} poses within {options.start.window_s} s agree with "
        "each other and with gravity",
        path=problem.path,
        fix="check the map and the extrinsics, or relax --start",
    )
