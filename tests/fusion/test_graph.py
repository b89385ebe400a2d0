"""The fixed-lag graph against the filter, dense algebra and its own promises."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filter_runs import simulated

from fusion import graph
from fusion.eskf import ACCEPTED
from fusion.fuse import fuse, run_filter
from fusion.graph import run_graph
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import error_at
from fusion.graph_motion import MotionChain
from fusion.graph_smoother import FixedLagSmoother, detection_of, joint_covariance
from fusion.graph_walk import Walk
from fusion.options import DetectionBias, Estimate, FuseOptions, Graph
from fusion.simulate import Displacement, SimulationOptions, simulate, simulate_with_truth
from poet_loc.core.consistency import pose_nees
from poet_loc.core.input_error import InputError

GRAPH = FuseOptions(estimator="graph")
EVERY_STAMP = Graph(keyframe_rate_hz=1000.0, lag_s=0.001, kernel="none")


def distances(one, other):
    """Return how far two results lie apart, row by row: m, rad."""
    np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
    a, b = one.T_world_imu, other.T_world_imu
    return np.linalg.norm(a.translation - b.translation, axis=1), (a.rotation.inv() * b.rotation).magnitude()


def on_shared_stamps(*results):
    """Return the rows that all results have: a filter that follows a time offset has its own stamps at the poses."""
    shared = results[0].stamps_ns
    for result in results[1:]:
        shared = np.intersect1d(shared, result.stamps_ns)
    rows = [np.searchsorted(result.stamps_ns, shared) for result in results]
    return [
        replace(result, stamps_ns=shared, T_world_imu=result.T_world_imu[at], sigmas=result.sigmas[at])
        for result, at in zip(results, rows)
    ]


def with_measurements(problem, kept):
    """Return the problem with some of its measurements only."""
    measured = problem.measurements
    return replace(
        problem, measurements=type(measured)(**{name: getattr(measured, name)[kept] for name in vars(measured)})
    )


def rms_errors(result, truth):
    reference, valid = truth.interpolate(result.stamps_ns)
    assert valid.all()
    est = result.T_world_imu
    position = np.linalg.norm(est.translation - reference.translation, axis=1)
    attitude = (est.rotation.inv() * reference.rotation).magnitude()
    nees = pose_nees(est, reference, result.pose_covariances)
    return np.sqrt(np.mean(position**2)), np.sqrt(np.mean(attitude**2)), np.mean(nees)


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("measurements", ["camera", "objects"])
def test_a_lag_of_one_keyframe_is_the_filter(measurements, bias):
    """With a keyframe at every stamp and nothing kept behind it the graph is a filter that linearises like ours."""
    options = FuseOptions(measurements=measurements, bias=DetectionBias(use=bias))
    problem = simulated(measurements, options=options, symmetric_objects=0)
    causal = run_filter(problem, options)
    graph = run_graph(problem, replace(options, estimator="graph", graph=EVERY_STAMP))
    assert graph.name == f"fuse/graph/{measurements}"
    later = causal.stamps_ns > causal.stamps_ns[0] + 1_000_000_000
    position, attitude = distances(graph, causal)
    assert np.all(position[later] < 0.25 * np.linalg.norm(causal.sigmas[later, 3:6], axis=1))
    assert np.all(attitude[later] < 0.25 * np.linalg.norm(causal.sigmas[later, :3], axis=1))
    np.testing.assert_allclose(graph.sigmas[later, :6], causal.sigmas[later, :6], rtol=0.1)
    assert np.mean(graph.gate.position_accepted == causal.gate.position_accepted) > 0.98


def test_a_bias_that_jumps_before_its_object_was_ever_used_jumps_in_the_graph_too():
    """An object that is grossly wrong from its first sight on is refused until the filter takes it for biased."""
    options = FuseOptions()
    problem = simulated(options=options, symmetric_objects=0)
    measured = problem.measurements
    late = measured.stamps_ns > problem.imu.stamps_ns[0] + 2_000_000_000
    problem = with_measurements(problem, (measured.objects != 2) | late)
    measured = problem.measurements
    measured.translations[measured.objects == 2] *= 1.18  # further along the ray than its biases reach
    causal = run_filter(problem, options)
    graph = run_graph(problem, replace(options, estimator="graph", graph=EVERY_STAMP))
    used = np.isin(np.arange(len(causal.gate)), np.flatnonzero(causal.gate.object_ids == problem.keys[2][0]))
    used &= causal.gate.position_accepted
    assert used.sum() > 10
    assert np.flatnonzero(used)[0] > np.flatnonzero(measured.objects == 2)[15]
    later = causal.stamps_ns > causal.gate.stamps_ns[used][0]
    position, attitude = distances(graph, causal)
    assert np.all(position[later] < 0.25 * np.linalg.norm(causal.sigmas[later, 3:6], axis=1))
    assert np.all(attitude[later] < 0.25 * np.linalg.norm(causal.sigmas[later, :3], axis=1))
    np.testing.assert_allclose(graph.sigmas[later, :6], causal.sigmas[later, :6], rtol=0.1)


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy"])
def test_a_kernel_weighs_a_measurement_by_its_error_at_the_state_that_knows_it(kernel):
    options = FuseOptions(estimator="graph", graph=Graph(kernel=kernel, kernel_width=0.8))
    problem = simulated(options=options, symmetric_objects=0)
    walk, chain = Walk(problem, options), MotionChain.of(problem, options)
    builder = GraphBuilder(problem.layout, walk.memory.x, walk.memory.bias_model, chain, options.graph)
    kernels = {"huber": gtsam.noiseModel.mEstimator.Huber, "cauchy": gtsam.noiseModel.mEstimator.Cauchy}
    bent = 0
    for keyframe in walk.keyframes():
        x = walk.memory.x
        for i in keyframe.at:
            passed = int(walk.columns.decisions[i]) & ACCEPTED
            if keyframe.started or not passed:
                continue
            d = detection_of(builder, walk, i, keyframe.stamp_ns, x, passed)
            rows, (e, _) = slice(d.first, d.first + d.size), error_at(d, x, problem.layout)
            far = np.sqrt(e @ np.linalg.solve(d.covariance[rows, rows], e))
            weight = 1.0 if kernel == "none" else kernels[kernel].Create(0.8).weight(far)
            assert walk.fitted.weights[i] == pytest.approx(weight, rel=1e-6)
            bent += far > 0.8
    assert bent > 10


def test_the_window_stays_bounded_however_long_the_log(monkeypatch):
    sizes = []
    extend = FixedLagSmoother.extend

    def watched(self, keyframe, walk):
        extend(self, keyframe, walk)
        factors = self._isam.getFactorsUnsafe()
        alive = sum(factors.at(i) is not None for i in range(factors.size()))
        variables = len(self._lasting) + sum(len(keys) for keys in self._came.values())
        sizes.append((variables, alive, factors.size(), self._isam.calculateEstimate().size()))

    monkeypatch.setattr(FixedLagSmoother, "extend", watched)
    options = replace(GRAPH, graph=Graph(lag_s=0.5, idle_s=0.3))
    run_graph(simulated(duration_s=24.0, options=options), options)
    sizes = np.array(sizes)
    filled, rest = sizes[20 : len(sizes) // 3], sizes[len(sizes) // 3 :]
    assert len(rest) > 100
    assert np.all(rest.max(axis=0) <= 1.2 * filled.max(axis=0))
    np.testing.assert_array_equal(sizes[:, 0], sizes[:, 3])


@pytest.mark.parametrize("relinearize_every", [0, 3])
def test_newest_state_and_covariance_are_those_of_the_whole_window(monkeypatch, relinearize_every):
    """The covariance is the inverse of the information, the state what ISAM2 finds when it solves for everything."""
    checked = []
    extend = FixedLagSmoother.extend

    def watched(self, keyframe, walk):
        extend(self, keyframe, walk)
        if len(checked) > 8:
            return
        keys = [variable.key for variable in self.builder.newest]
        linear = self._isam.getFactorsUnsafe().linearize(self._isam.getLinearizationPoint())
        ordering = gtsam.Ordering()
        older = [key for came in self._came.values() for key in came if key not in keys]
        for key in [*keys, *older]:
            ordering.push_back(key)
        A, _ = linear.jacobian(ordering)
        size = sum(variable.size for variable in self.builder.newest)
        scale = 1.0 / np.linalg.norm(A, axis=0)
        dense = np.linalg.inv((A * scale).T @ (A * scale)) * np.outer(scale, scale)
        dense, own = dense[:size, :size], joint_covariance(self._isam, keys)
        sigma = np.sqrt(np.diag(dense))
        np.testing.assert_allclose(own / np.outer(sigma, sigma), dense / np.outer(sigma, sigma), atol=1e-5)
        for variable in self.builder.newest:
            from_root = self.builder.x[variable.place].copy()
            variable.read(self._isam.calculateEstimate(), self.builder.x)
            np.testing.assert_allclose(from_root, self.builder.x[variable.place], atol=1e-9)
        checked.append(size)

    monkeypatch.setattr(FixedLagSmoother, "extend", watched)
    graph = Graph(lag_s=0.5, kernel="none", relinearize_every=relinearize_every, relinearize=1e-5)
    options = replace(GRAPH, graph=graph)
    run_graph(simulated(duration_s=4.0, options=options), options)
    assert max(checked) > 15


def test_rows_come_at_the_imus_rate_and_know_what_was_measured_by_then():
    """What comes after a stamp changes nothing before it: the fixed-lag graph is causal."""
    problem = simulated()
    whole = run_graph(problem, GRAPH)
    imu, rows = problem.imu.stamps_ns, whole.stamps_ns
    every = np.unique(np.r_[imu, problem.measurements.stamps_ns])
    np.testing.assert_array_equal(rows, every[(every >= rows[0]) & (every <= imu[-1])])
    cut = int(rows[-200])
    part = run_graph(with_measurements(problem, problem.measurements.stamps_ns <= cut), GRAPH)
    same = rows <= cut
    np.testing.assert_allclose(
        part.T_world_imu.translation[: same.sum()], whole.T_world_imu.translation[same], atol=1e-9
    )
    np.testing.assert_allclose(part.sigmas[: same.sum()], whole.sigmas[same], rtol=1e-6)


def test_the_keyframe_rate_is_what_was_asked_for(monkeypatch):
    stamps = []
    extend = FixedLagSmoother.extend

    def watched(self, keyframe, walk):
        stamps.append(keyframe.stamp_ns)
        extend(self, keyframe, walk)

    monkeypatch.setattr(FixedLagSmoother, "extend", watched)
    for rate in (3.0, 5.0, 15.0):
        stamps.clear()
        options = replace(GRAPH, graph=Graph(keyframe_rate_hz=rate), bias=DetectionBias(use=False))
        run_graph(simulated(options=options), options)
        assert 1e9 / np.median(np.diff(stamps)) == pytest.approx(rate, rel=0.01)


def test_after_seconds_without_measurements_the_graph_takes_up_again():
    problem = simulated(duration_s=9.0)
    measured = problem.measurements
    t = measured.stamps_ns - measured.stamps_ns[0]
    kept = (t < 4e9) | (t > 6.5e9)
    gappy = with_measurements(problem, kept)
    causal, graph = run_filter(gappy, FuseOptions()), run_graph(gappy, GRAPH)
    assert graph.restarts == causal.restarts == 0
    position, _ = distances(graph, causal)
    assert np.all(position < 3.0 * np.linalg.norm(causal.sigmas[:, 3:6], axis=1))


def test_after_long_without_measurements_the_graph_is_no_surer_of_itself_than_the_filter():
    """The prediction there is metres off, and linear in nothing."""
    options = SimulationOptions(duration_s=22.0, seed=1, objects=4, symmetric_objects=0)
    log = simulate_with_truth(options)[0]
    poses = log.object_poses[""]
    seconds = (poses.stamps_ns - poses.stamps_ns[0]) * 1e-9
    log = replace(log, object_poses={"": poses[(seconds < 8.0) | (seconds > 18.0)]})
    worst = []
    for estimator in ("eskf", "graph"):
        result = fuse(log, FuseOptions(estimator=estimator))
        later = (result.stamps_ns - poses.stamps_ns[0] > 18_010_000_000) & (
            result.stamps_ns <= log.T_world_imu.stamps_ns[-1]
        )
        truth, _ = log.T_world_imu.interpolate(result.stamps_ns[later])
        worst.append(pose_nees(result.T_world_imu[later], truth, result.pose_covariances[later]).max())
    assert worst[1] < 1.2 * worst[0]  # without: 6 times


SWITCHES = {
    "extrinsics": Estimate(extrinsics=True),
    "time offset": Estimate(time_offset=True),
    "gravity": Estimate(gravity=True),
    "approximate map": Estimate(map="approximate"),
    "unknown map": Estimate(map="unknown"),
    "everything": Estimate(extrinsics=True, time_offset=True, gravity=True, map="unknown"),
}


@pytest.mark.parametrize("estimator", ["graph", "batch"])
@pytest.mark.parametrize("name", SWITCHES)
def test_every_switch_of_the_filter_is_the_graphs_too(name, estimator):
    options = FuseOptions(estimate=SWITCHES[name])
    problem = simulated(options=options, symmetric_objects=0, duration_s=8.0)
    causal = run_filter(problem, options)
    graph = run_graph(problem, replace(options, estimator=estimator))
    graph, causal = on_shared_stamps(graph, causal)
    assert len(causal.stamps_ns) > 700
    later = causal.stamps_ns > causal.stamps_ns[0] + 1_000_000_000
    position, attitude = distances(graph, causal)
    assert np.all(position[later] < 3.0 * np.linalg.norm(causal.sigmas[later, 3:6], axis=1))
    assert np.all(attitude[later] < 3.0 * np.linalg.norm(causal.sigmas[later, :3], axis=1))
    ratio = graph.sigmas[later, :6] / causal.sigmas[later, :6]
    assert np.median(ratio) < 1.1 if estimator == "graph" else np.median(ratio) < 0.95


@pytest.mark.parametrize("estimator", ["graph", "batch"])
@pytest.mark.parametrize("motion", ["odometry", "constant-velocity"])
def test_odometry_and_constant_velocity_carry_the_graph_as_they_carry_the_filter(motion, estimator):
    options = FuseOptions(motion=motion)
    problem = simulated(options=options, odometry=True)
    causal, graph = run_filter(problem, options), run_graph(problem, replace(options, estimator=estimator))
    assert graph.motion == motion
    later = causal.stamps_ns > causal.stamps_ns[0] + 1_000_000_000
    position, attitude = distances(graph, causal)
    assert np.all(position[later] < 3.0 * np.linalg.norm(causal.sigmas[later, 3:6], axis=1))
    assert np.all(attitude[later] < 3.0 * np.linalg.norm(causal.sigmas[later, :3], axis=1))


def test_the_graph_is_as_accurate_and_as_honest_as_the_filter():
    errors = {"eskf": [], "graph": []}
    for seed in range(3):
        rates = {"imu_rate_hz": 100.0, "camera_rate_hz": 15.0}
        log, _ = simulate_with_truth(SimulationOptions(duration_s=12.0, seed=seed, objects=3, **rates))
        for estimator, rows in errors.items():
            options = FuseOptions(estimator=estimator)
            rows.append(rms_errors(fuse(log, options), log.T_world_imu))
    causal, graph = (np.mean(np.square(rows), axis=0) ** 0.5 for rows in errors.values())
    assert np.all(graph[:2] < 1.1 * causal[:2])
    assert graph[2] < 1.2 * causal[2]


@pytest.mark.parametrize("estimator", ["graph", "batch"])
def test_an_object_that_was_moved_leaves_the_graph_too(estimator):
    rates = {"imu_rate_hz": 100.0, "camera_rate_hz": 10.0}
    moved = Displacement(1, 14.0, np.inf, 0.2, 0.0)
    log, _ = simulate_with_truth(
        SimulationOptions(duration_s=30.0, seed=2, objects=4, symmetric_objects=0, moved=moved, **rates)
    )
    result = fuse(log, FuseOptions(estimator=estimator))
    assert [key for key, _, _ in result.health.released] == [(2, 0)]
    released = result.gate.released
    assert np.count_nonzero(released) > 20
    assert not np.any(result.gate.position_accepted[released])
    assert not np.any(result.gate.rotation_accepted[released])
    assert np.all(np.isfinite(result.sigmas))
    assert rms_errors(result, log.T_world_imu)[0] < 0.05


def test_a_log_on_which_the_filter_never_starts_says_so():
    problem = simulated("camera")
    late = replace(problem.measurements, stamps_ns=problem.measurements.stamps_ns + 10**12)
    for estimator in ("graph", "batch"):
        with pytest.raises(InputError, match="never started"):
            run_graph(replace(problem, measurements=late), FuseOptions(measurements="camera", estimator=estimator))


@pytest.mark.parametrize("estimator", ["graph", "batch"])
def test_a_graph_without_a_solution_ends_in_one_line(estimator, monkeypatch):
    def indeterminate(*_):
        raise RuntimeError("\nIndeterminate linear system detected\nwhile working near variable x3")

    monkeypatch.setattr(graph, "run_batch" if estimator == "batch" else "run_fixed_lag", indeterminate)
    with pytest.raises(InputError, match=r"Indeterminate linear system detected while .*; see what fuse/eskf does"):
        graph.run_graph(simulated(), FuseOptions(estimator=estimator))


@pytest.mark.parametrize("seed", [0, 2])
def test_a_graph_without_a_lag_is_linearised_anew_as_well(seed):
    """With neither biases nor an IMU nothing lasts beyond a keyframe, of which alone gtsam lost its variables."""
    rates = {"imu_rate_hz": 100.0, "camera_rate_hz": 10.0}
    log = simulate(SimulationOptions(duration_s=6.0, seed=seed, objects=1, symmetric_objects=0, odometry=True, **rates))
    without = FuseOptions("graph", motion="odometry", bias=DetectionBias(use=False), graph=Graph(lag_s=0.0))
    anew = replace(without, graph=replace(without.graph, relinearize_every=1))
    T, same = fuse(log, anew).T_world_imu, fuse(log, without).T_world_imu
    assert np.linalg.norm(T.translation - same.translation, axis=1).max() < 0.01
