"""Measurements linearised together against the factors they stand for, and the reflections against numpy."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filter_runs import LAYOUTS, simulated

from fusion.graph_builder import GraphBuilder
from fusion.graph_linear import triangularise
from fusion.graph_motion import MotionChain
from fusion.graph_smoother import add_measurements
from fusion.graph_walk import Walk
from fusion.options import FuseOptions, Graph


def information(graph, values, keys):
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    A, b = graph.linearize(values).jacobian(ordering)
    return A.T @ A, A.T @ b


@pytest.mark.parametrize("measurements", ["camera", "objects"])
@pytest.mark.parametrize(
    ("name", "kernel"), [*((name, "cauchy") for name in LAYOUTS), ("everything", "none"), ("everything", "huber")]
)
def test_measurements_linearised_together_say_what_each_of_their_factors_says(name, measurements, kernel):
    """Keyframes with measurements after and at them, some let through in part: the same information, row for row."""
    options = FuseOptions(measurements=measurements, graph=Graph(kernel=kernel, kernel_width=1.0))
    problem = replace(simulated(measurements, duration_s=3.0), layout=LAYOUTS[name])
    walk, chain = Walk(problem, options), MotionChain.of(problem, options)
    m, rng, compared = walk.memory, np.random.default_rng(2), 0
    builders = [
        GraphBuilder(problem.layout, m.x, m.bias_model, chain, options.graph, fixed=fixed) for fixed in (False, True)
    ]
    for keyframe in walk.keyframes():
        for builder in builders:
            if keyframe.started:
                builder.start(keyframe.stamp_ns, m.x, m.P + 1e-6 * np.eye(len(m.P)), m.known)
        if keyframe.started or compared > 6:
            continue
        for which in (keyframe.between, keyframe.at):
            partly = rng.random(len(which)) < 0.3
            walk.columns.decisions[which.start : which.stop][partly] &= rng.integers(0, 4, partly.sum())
        for builder in builders:
            builder.place_new_objects(m.x)
            for which in (keyframe.between, keyframe.at):
                add_measurements(builder, walk, which)
                if which is keyframe.between:
                    builder.add_keyframe(keyframe.stamp_ns)
        one, other = builders
        keys = list(one.values.keys())
        assert keys == list(other.values.keys())
        assert one.graph.size() >= other.graph.size()
        expected, found = (information(builder.graph, one.values, keys) for builder in builders)
        scale = np.sqrt(np.diag(expected[0])) + 1e-9
        np.testing.assert_allclose(found[0] / np.outer(scale, scale), expected[0] / np.outer(scale, scale), atol=1e-7)
        step = np.abs(expected[1] / scale).max()
        np.testing.assert_allclose(found[1] / scale, expected[1] / scale, atol=1e-6 * max(1.0, step))
        compared += 1
    assert compared > 3


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
