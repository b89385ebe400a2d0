"""The whole log at once: every keyframe from a start of the filter to the next is a variable, none is let go."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion import eskf, memory
from fusion.eskf import ACCEPTED
from fusion.filter_update import PARTIAL
from fusion.fuse import gate_log, result_from_rows, with_findings
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import Detection, error_at
from fusion.graph_gnc import Truncation, anneal
from fusion.graph_model import BIAS_COLUMNS
from fusion.graph_motion import MotionChain
from fusion.graph_odometry import odometry_at, odometry_error_at
from fusion.graph_rows import Between
from fusion.graph_smoother import detection_of, detections, forget_biases, joint_covariance
from fusion.graph_variables import block_diagonal, keyframe_variables
from fusion.graph_walk import Keyframe, Walk
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP
from fusion.nav_state import CORE
from fusion.never_started import never_started
from fusion.options import FuseOptions, Graph
from fusion.place_watch import RELEASED
from fusion.prepare import Problem
from fusion.result import FuseResult

Array = NDArray[np.float64]

_SETTLED = 1e-3  # half a squared step in units of 1-sigma, all variables together
_HALVINGS = 6
_APPROACH = 2  # steps from the filter's states to about where object biases will be taken to act


@dataclass
class Stretch:
    """What is solved at once: the keyframes from a start of the filter to the next, or to the log's end."""

    x: Array
    """The filter's nominal array where it starts,"""
    P: Array
    """its covariance,"""
    known: Array
    """(K,) and which object poses it knows."""
    keyframes: list[Keyframe] = field(default_factory=list)
    states: list[Array] = field(default_factory=list)
    """Nominal arrays at the keyframes: the filter's, then the solution's."""
    first: int = 0
    """The graph's number of the first keyframe."""
    biases: list[list[tuple[int, int]]] = field(default_factory=list)
    """Per keyframe: key (-1: none) and stamp of each object bias's newest variable, in the order of the state."""
    spread: list[Array] = field(default_factory=list)
    """Per keyframe (kinds * K, 6): 1-sigma of what may have become of each object bias since."""
    values: gtsam.Values = field(default_factory=gtsam.Values)
    tree: gtsam.GaussianBayesTree | None = None
    """The solution's linear system, eliminated,"""
    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    """and the graph that it is of."""


def run_batch(problem: Problem, options: FuseOptions) -> FuseResult:
    """Solve a whole log by least squares, named fuse/batch/...; every row knows the whole log.

    The filter walks the log first: its states are where the solver starts, its gate decides what is used. Then the
    solution decides, and is found anew, until it agrees with itself. Raises InputError where the filter never starts.
    """
    began = time.perf_counter()
    walk = Walk(problem, options)
    stretches = list(_stretches(walk))
    if not stretches:
        raise never_started(problem, options)
    chain = MotionChain.of(problem, options)
    builder = GraphBuilder(problem.layout, stretches[0].states[0], walk.memory.bias_model, chain, options.graph)
    builder.follow_spreads(walk.memory.x)
    for stretch in stretches:
        _approach(stretch, builder, walk, options.graph)
        for again in range(max(1, options.graph.rounds)):
            if again and not _decide(stretch, builder, walk):
                break
            _solve(stretch, builder, walk, options.graph.max_iterations)
        _write_rows(stretch, walk, chain.with_imu)
    _write_statics(stretches[-1], builder, walk.memory)
    result = result_from_rows(
        f"fuse/batch/{options.measurements}",
        walk.rows,
        gate_log(problem, walk.columns.decisions, walk.columns.nis),
        time.perf_counter() - began,
    )
    return with_findings(result, problem, walk.memory)


def _stretches(walk: Walk) -> Iterator[Stretch]:
    stretch, m = None, walk.memory
    for keyframe in walk.keyframes():
        if keyframe.started or stretch is None:
            if stretch is not None:
                yield stretch
            stretch = Stretch(m.x.copy(), m.P.copy(), m.known.copy())
        stretch.keyframes.append(keyframe)
        stretch.states.append(m.x.copy())
    if stretch is not None:
        yield stretch


def _approach(stretch: Stretch, builder: GraphBuilder, walk: Walk, options: Graph) -> None:
    """Bring a stretch to about where its solution is, and with gnc decide from there what passes the gate."""
    if not options.gnc:
        _solve(stretch, builder, walk, _APPROACH)
        return
    plain, truncation, c = builder.model, Truncation(options.kernel_width), walk.columns
    for keyframe in stretch.keyframes:
        for j in (*keyframe.between, *keyframe.at):
            if not c.decisions[j] & RELEASED and c.kinds[j] != ODOMETRY_STEP:
                c.decisions[j] = ACCEPTED
    builder.model = replace(plain, truncation=truncation)
    graph, values = _build(stretch, builder, walk)
    stretch.values, builder.model = anneal(graph, values, truncation, optimise), plain
    stretch.spread = [_read_state(stretch, i, builder) for i in range(len(stretch.states))]
    _decide(stretch, builder, walk)


def _solve(stretch: Stretch, builder: GraphBuilder, walk: Walk, steps: int) -> None:
    """Build the graph of a stretch from its states, and put the optimum in their place."""
    stretch.graph, values = _build(stretch, builder, walk)
    stretch.values, stretch.tree = optimise(stretch.graph, values, steps)
    stretch.spread = [_read_state(stretch, i, builder) for i in range(len(stretch.states))]


def _read_state(stretch: Stretch, i: int, builder: GraphBuilder) -> Array:
    """Write the solution into the nominal array of a keyframe; return what may have become of each object bias."""
    x, layout, stamp = stretch.states[i], builder.layout, stretch.keyframes[i].stamp_ns
    for variable in keyframe_variables(stretch.first + i, builder.chain.with_imu) + builder.statics:
        variable.read(stretch.values, x)
    spread = np.zeros((len(stretch.biases[i]), 6))
    for n, (key, seen_ns) in enumerate(stretch.biases[i]):
        kind, k = divmod(n, layout.n_objects)
        mean = stretch.values.atVector(key) if key >= 0 else np.zeros(6)
        phi, spread[n] = builder.bias_model.step(kind, mean, (stamp - seen_ns) * 1e-9)
        x[layout.nominal_bias(k, kind)] = phi * mean
        if key < 0:
            spread[n] = builder.bias_model.stationary(kind)
    return spread


def _build(stretch: Stretch, builder: GraphBuilder, walk: Walk) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    first, *rest = zip(stretch.keyframes, stretch.states, strict=True)
    builder.start(first[0].stamp_ns, stretch.x, stretch.P, stretch.known, first[1])
    builder.add_odometry(odometry_at(walk, first[0]))
    stretch.first, stretch.biases = builder.keyframe, []
    for keyframe, x in rest:
        builder.place_new_objects(x)
        builder.add_detections(detections(builder, walk, keyframe.between))
        stretch.biases.append(builder.newest_biases)
        builder.add_keyframe(keyframe.stamp_ns, x)
        forget_biases(builder, keyframe)
        builder.add_odometry(odometry_at(walk, keyframe))
        builder.add_detections(detections(builder, walk, keyframe.at))
    stretch.biases.append(builder.newest_biases)
    graph, values, _ = builder.take()
    return graph, values


def optimise(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, steps: int
) -> tuple[gtsam.Values, gtsam.GaussianBayesTree]:
    """Return the optimum and the linear system there, eliminated by QR: Gauss-Newton, halving steps that lead uphill.

    gtsam's own optimisers leave no eliminated system behind, and their damping makes QR tens of times slower here.
    """
    error = graph.error(values)
    for _ in range(steps):
        linear = graph.linearize(values)
        tree = linear.eliminateMultifrontal(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR)
        step = tree.optimize()
        if linear.error(gtsam.VectorValues.Zero(step)) - linear.error(step) < _SETTLED:
            break
        for half in range(_HALVINGS):
            moved = values.retract(step.scale(0.5**half))
            error_there = graph.error(moved)
            if error_there <= error:
                break
        values, error = moved, error_there
    return values, tree


def _decide(stretch: Stretch, builder: GraphBuilder, walk: Walk) -> bool:
    """Gate a stretch's measurements by its solution; tell whether any decision changed.

    What may have become of an object's bias since it was last seen widens the gate; what the solution is unsure of
    does not.
    """
    decisions, changed = walk.columns.decisions, _decide_odometry(stretch, walk)
    for i, keyframe in enumerate(stretch.keyframes):
        later = stretch.keyframes[i + 1].between if i + 1 < len(stretch.keyframes) else range(0)
        for j in (*(keyframe.at if i else ()), *later):
            if decisions[j] & RELEASED or walk.columns.kinds[j] == ODOMETRY_STEP:
                continue
            d = detection_of(builder, walk, j, keyframe.stamp_ns, stretch.states[i], ACCEPTED)
            decision = _gate(d, stretch.states[i], stretch.spread[i], builder, walk, j)
            changed |= decision != decisions[j]
            decisions[j] = decision
    return changed


def _decide_odometry(stretch: Stretch, walk: Walk) -> bool:
    c, limits, changed, then = walk.columns, walk.memory.limits, False, -1
    for i, keyframe in enumerate(stretch.keyframes):
        step = odometry_at(walk, keyframe, ACCEPTED)
        if step is None:
            continue
        if then >= 0:
            j, e = step.measurement, odometry_error_at(step, stretch.states[then], stretch.states[i])
            decision = int(eskf.gate(step.covariance, e, limits, limits[PARTIAL], *_scratch(), c.nis[j]))
            changed |= decision != c.decisions[j]
            c.decisions[j] = decision
        then = i
    return changed


def _gate(d: Detection, x: Array, spread: Array, builder: GraphBuilder, walk: Walk, j: int) -> int:
    limits, nis, S, size = walk.memory.limits, walk.columns.nis[j], d.covariance.copy(), builder.layout.n_objects
    e, J = error_at(d, x, builder.layout)
    for kind in range(builder.layout.bias_kinds if d.kind == OBJECT_POSE else 0):
        root = J[:, BIAS_COLUMNS + 6 * kind : BIAS_COLUMNS + 6 * kind + 6] * spread[d.object + kind * size]
        S += root @ root.T
    return int(eskf.gate(S, e, limits, limits[PARTIAL], *_scratch(), nis))


def _scratch() -> tuple[Array, Array]:
    return np.zeros((6, 6)), np.zeros(6)


def _write_rows(stretch: Stretch, walk: Walk, with_imu: bool) -> None:
    """Put the solution in the place of the filter's rows."""
    c, size = walk.columns, CORE if with_imu else 6
    between = Between(c.imu_stamps, c.imu_values, walk.memory.noise, size)
    stamps = walk.rows[0]
    P = np.zeros((2 * size, 2 * size))
    row = int(np.searchsorted(stamps, stretch.keyframes[0].stamp_ns))
    for i in range(len(stretch.keyframes) - 1):
        ends = stretch.keyframes[i].stamp_ns, stretch.keyframes[i + 1].stamp_ns
        P = _joint(stretch, i, with_imu)
        end = int(np.searchsorted(stamps, ends[1], side="right"))
        core, covariance = between.between(ends, (stretch.states[i], stretch.states[i + 1]), P, stamps[row:end])
        _put_rows(walk, slice(row, end), core, covariance)
        row = end


def _joint(stretch: Stretch, i: int, with_imu: bool) -> Array:
    """Return the covariance of the filter's errors at a keyframe and the next."""
    variables = [*keyframe_variables(stretch.first + i, with_imu), *keyframe_variables(stretch.first + i + 1, with_imu)]
    half = len(variables) // 2
    blocks = [v.to_filter(stretch.states[i + (n >= half)]) for n, v in enumerate(variables)]
    J = block_diagonal(blocks)
    return np.asarray(J @ _covariance(stretch, [v.key for v in variables]) @ J.T)


def _covariance(stretch: Stretch, keys: Sequence[int]) -> Array:
    """Return the joint covariance of a solution's variables in this order.

    Where hardly anything ties keyframes together (a hole of the odometry), gtsam's shortcuts through the tree may call
    a sound system indeterminate; they do not through a tree that was eliminated by nested dissection.
    """
    assert stretch.tree is not None
    try:
        return joint_covariance(stretch.tree, keys)
    except RuntimeError:
        linear = stretch.graph.linearize(stretch.values)
        stretch.tree = linear.eliminateMultifrontal(gtsam.Ordering.OrderingType.METIS, gtsam.EliminateQR)
        return joint_covariance(stretch.tree, keys)


def _put_rows(walk: Walk, rows: slice, core: Array, covariance: Array) -> None:
    out, size = walk.out, covariance.shape[1]
    out.core[rows] = core
    out.sigma[rows, :size] = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(min=0.0))
    out.covariance[rows] = covariance[:, :6, :6].reshape(-1, 36)


def _write_statics(stretch: Stretch, builder: GraphBuilder, m: memory.Memory) -> None:
    """Give the filter's memory what the solution says of extrinsics, time offset, gravity and objects."""
    variables = builder.statics
    if not variables or stretch.tree is None:
        return
    for variable in variables:
        variable.read(stretch.values, m.x)
    at = [i for variable in variables for i in variable.errors]
    J = block_diagonal([variable.to_filter(m.x) for variable in variables])
    m.P[np.ix_(at, at)] = J @ _covariance(stretch, [variable.key for variable in variables]) @ J.T
