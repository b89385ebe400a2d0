"""Measurements linearised together against the factors they stand for, and the reflections against numpy."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filter_runs import LAYOUTS, simulated

from fusion.eskf import ACCEPTED
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import error_at
from fusion.graph_fixed import FixedBuilder
from fusion.graph_linear import triangularise
from fusion.graph_motion import MotionChain
from fusion.graph_smoother import add_measurements, detection_of
from fusion.graph_walk import Walk
from fusion.measurements import OBJECT_POSE
from fusion.nav_state import SPREAD_SIZE
from fusion.options import FuseOptions, Graph


def information(graph, values, keys):
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    A, b = graph.linearize(values).jacobian(ordering)
    return A.T @ A, A.T @ b


@pytest.mark.parametrize("measurements", ["camera", "objects"])
@pytest.mark.parametrize("name", LAYOUTS)
def test_measurements_linearised_together_say_what_each_of_their_factors_says(name, measurements):
    """Keyframes with measurements after and at them, some let through in part: the same information, row for row.

    A measurement of weight w says what one of covariance R / w says. Object biases are 0 where the graph begins: away
    from it they act in one graph where the object was seen, in the other where it is by now.
    """
    options = FuseOptions(measurements=measurements, graph=Graph(kernel="none"))
    problem = replace(simulated(measurements, duration_s=3.0), layout=LAYOUTS[name])
    walk, chain = Walk(problem, options), MotionChain.of(problem, options)
    m, rng, compared = walk.memory, np.random.default_rng(2), 0
    builders = [kind(problem.layout, m.x, m.bias_model, chain, options.graph) for kind in (GraphBuilder, FixedBuilder)]
    for keyframe in walk.keyframes():
        for builder in builders:
            if keyframe.started:
                x = m.x.copy()
                x[problem.layout.bias_start : problem.layout.spread_start] = 0.0
                builder.start(keyframe.stamp_ns, x, m.P + 1e-6 * np.eye(len(m.P)), m.known)
                builder.graph.resize(0)
        if keyframe.started or compared > 6:
            continue
        for which in (keyframe.between, keyframe.at):
            partly = rng.random(len(which)) < 0.3
            walk.columns.decisions[which.start : which.stop][partly] &= rng.integers(0, 4, partly.sum())
        fitted = walk.fitted
        weights, covariances = rng.uniform(0.1, 1.0, len(fitted.weights)), fitted.covariances
        weights[walk.columns.kinds != OBJECT_POSE] = 1.0  # gtsam's own factor of a camera pose has a kernel of its own
        for builder in builders:
            builder.place_new_objects(m.x)
            weighed = fitted._replace(weights=weights)
            spread = fitted._replace(covariances=covariances / weights[:, None, None])
            walk.fitted = weighed if isinstance(builder, FixedBuilder) else spread
            for which in (keyframe.between, keyframe.at):
                add_measurements(builder, walk, which)
                if which is keyframe.between:
                    count = builder.graph.size()
                    builder.add_keyframe(keyframe.stamp_ns)
                    builder.graph.resize(count)  # the link is for tests/fusion/test_graph_link.py
        walk.fitted = fitted
        one, other = builders
        assert list(one.values.keys()) == list(other.values.keys())
        keys = sorted(one.graph.keyVector())
        assert keys == sorted(other.graph.keyVector())
        assert one.graph.size() >= other.graph.size()
        expected, found = (information(builder.graph, builder.values, keys) for builder in builders)
        scale = np.sqrt(np.diag(expected[0])) + 1e-9
        np.testing.assert_allclose(found[0] / np.outer(scale, scale), expected[0] / np.outer(scale, scale), atol=1e-7)
        step = np.abs(expected[1] / scale).max()
        np.testing.assert_allclose(found[1] / scale, expected[1] / scale, atol=1e-6 * max(1.0, step))
        compared += 1
    assert compared > 3


def test_what_an_object_bias_says_is_exact_at_its_latest_value():
    """A bias that has come far since its variable began: at what it is now, the rows are the error there.

    It spreads as it did when the filter used the measurement, whatever it does by now.
    """
    options = FuseOptions(graph=Graph(kernel="none"))
    problem = replace(simulated(duration_s=3.0), layout=replace(LAYOUTS["everything"], time_offset=False))
    walk, chain = Walk(problem, options), MotionChain.of(problem, options)
    m, layout, rng = walk.memory, problem.layout, np.random.default_rng(4)
    builder = FixedBuilder(layout, m.x, m.bias_model, chain, options.graph)
    keyframe = next(one for one in walk.keyframes() if not one.started and len(one.at))
    builder.start(keyframe.stamp_ns, m.x, m.P + 1e-6 * np.eye(len(m.P)), m.known)
    builder.take()
    biases = [bias.variable for bias in builder.chains.values() if bias.begun]
    for variable in biases:
        builder.x[variable.place] += 0.2 * rng.normal(size=6)
    steps, here, expected = gtsam.VectorValues(), gtsam.Values(), 0.0
    spreads, x = walk.fitted.spreads, builder.x.copy()
    spreads[:] = rng.uniform(0.5, 2.0, spreads.shape)
    for i in keyframe.at:
        passed = int(walk.columns.decisions[i]) & ACCEPTED
        if passed:
            x[layout.spread_start + SPREAD_SIZE * walk.columns.objects[i] :][:3] = spreads[i]
            d = detection_of(builder, walk, i, keyframe.stamp_ns, x, passed)
            rows, (e, _) = slice(d.first, d.first + d.size), error_at(d, x, layout)
            expected += 0.5 * e @ np.linalg.solve(d.covariance[rows, rows], e)
    add_measurements(builder, walk, keyframe.at)
    for variable in builder.newest:
        gap = builder.x[variable.place] - builder.origin[variable.place]
        steps.insert(variable.key, gap if variable in biases else np.zeros(variable.size))
        variable.insert(here, builder.origin)
    graph, _, _ = builder.take()
    assert len(biases) > 3
    assert expected > 10.0
    assert graph.linearize(here).error(steps) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("shape", [(3, 7), (9, 7), (30, 7)])
def test_reflections_keep_the_normal_equations_and_leave_an_echelon(shape):
    rng = np.random.default_rng(shape[0])
    A = rng.normal(size=shape)
    A[:, 2] = A[:, 0] - 2.0 * A[:, 1]  # nothing of its own
    A[:, 4] = 0.0
    turned = A.copy()
    taken = triangularise(turned, 5)
    assert taken == np.linalg.matrix_rank(A[:, :5])
    np.testing.assert_array_equal(turned[taken:, :5], 0.0)
    np.testing.assert_allclose(turned.T @ turned, A.T @ A, atol=1e-12 * len(A))
