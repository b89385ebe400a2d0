"""Graduated non-convexity: its loss by its limits and gtsam's own, and a start from which plain kernels fail."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filter_runs import simulated
from test_graph import distances, on_shared_stamps

from fusion import graph_batch
from fusion.eskf import ACCEPTED
from fusion.graph import run_graph
from fusion.graph_batch import optimise
from fusion.graph_gnc import Truncation, anneal
from fusion.options import FuseOptions, Graph, Moved


@pytest.mark.parametrize("mu", [1e-4, 0.1, 2.0, 50.0])
def test_the_weight_is_the_slope_of_the_loss_and_the_loss_is_smooth(mu):
    """gtsam's convention: the loss's derivative by the residual is weight times residual."""
    truncation = Truncation(3.0, mu)
    for r in np.r_[np.linspace(0.01, 9.0, 60), 3.0 * np.sqrt(mu / (mu + 1.0)), 3.0 * np.sqrt((mu + 1.0) / mu)]:
        slope = (truncation.loss(r + 1e-6) - truncation.loss(r - 1e-6)) / 2e-6
        assert slope == pytest.approx(truncation.weight(r) * r, abs=2e-4 * max(1.0, mu, r))
        assert 0.0 <= truncation.weight(r) <= 1.0


def test_its_ends_are_least_squares_and_truncated_least_squares():
    squares, truncated = Truncation(3.0), Truncation(3.0, 1e9)
    own = gtsam.noiseModel.mEstimator.TruncatedLeastSquares.Create(3.0)
    for r in (0.5, 2.9, 3.1, 40.0):
        assert (squares.weight(r), squares.loss(r)) == (1.0, 0.5 * r * r)
        assert truncated.weight(r) == pytest.approx(own.weight(r), abs=1e-6)
        assert truncated.loss(r) == pytest.approx(own.loss(r), rel=1e-6)


def test_a_point_among_outliers_is_found_from_afar():
    """Brute force over the truncated cost of a one-dimensional problem says where its minimum is."""
    rng = np.random.default_rng(0)
    seen = np.r_[rng.normal(2.0, 1.0, 30), rng.normal(40.0, 1.0, 18)]
    truncation, key = Truncation(3.0), 0
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for value in seen:
        graph.add(gtsam.PriorFactorVector(key, np.array([value]), truncation.noise(np.eye(1))))
    start.insert(key, np.array([40.0]))
    found = anneal(graph, start, truncation, optimise).atVector(key)[0]
    places = np.linspace(-10.0, 60.0, 7001)
    cost = np.minimum((places[:, None] - seen) ** 2, 9.0).sum(axis=1)
    assert found == pytest.approx(places[np.argmin(cost)], abs=0.15)


def test_gnc_leaves_a_minimum_that_plain_kernels_stay_in(monkeypatch):
    """The filter is made to follow one object that stands elsewhere, and to refuse the two that are right."""
    problem = simulated(noise="white", symmetric_objects=0, duration_s=5.0)
    options = FuseOptions(estimator="batch", moved=Moved(release=False))
    away, m = np.array([0.4, 0.0, 0.0]), problem.measurements
    right = run_graph(problem, options)
    T = right.T_world_imu
    rows = np.searchsorted(right.stamps_ns, m.stamps_ns).clip(max=len(right.stamps_ns) - 1)
    R_world_cam = (T.rotation[rows] * problem.calibration.T_cam_imu.inv().rotation).as_matrix()
    moved = m.objects == 0
    shift = np.einsum("nji,j->ni", R_world_cam, away)
    t = np.where(moved[:, None], m.translations + shift, m.translations)
    problem = replace(problem, measurements=replace(m, translations=t))
    stretches = graph_batch._stretches

    def misled(walk):
        for stretch in stretches(walk):
            for x in (stretch.x, *stretch.states):
                x[9:12] -= away
            walk.columns.decisions[:] = np.where(moved, ACCEPTED, 0)
            yield stretch

    monkeypatch.setattr(graph_batch, "_stretches", misled)
    apart = {}
    for name, graph in {
        "none": Graph(kernel="none"),
        "huber": Graph(kernel="huber"),
        "cauchy": Graph(kernel="cauchy"),
        "gnc": Graph(gnc=True),
    }.items():
        found = run_graph(problem, replace(options, graph=graph))
        apart[name] = np.median(distances(*on_shared_stamps(found, right))[0])
    assert min(apart["none"], apart["huber"], apart["cauchy"]) > 0.2
    assert apart["gnc"] < 0.06  # the prior of the wrong start is a measurement too
