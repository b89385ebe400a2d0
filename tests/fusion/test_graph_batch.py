"""The batch graph against the smoothed filter, gtsam's own optimiser, dense algebra and the truth."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filter_runs import simulated
from test_graph import distances, rms_errors, with_measurements

from fusion import graph_batch
from fusion.detection_errors import WhiteErrors
from fusion.fuse import fuse
from fusion.graph import run_graph
from fusion.graph_rows import Between
from fusion.graph_smoother import joint_covariance
from fusion.graph_variables import imu_bias_key, pose_key, velocity_key
from fusion.imu_noise import imu_rows
from fusion.memory import views
from fusion.nav_state import StateLayout, local_state, nominal_state, retract_state
from fusion.options import DetectionBias, FuseOptions, Gate, Graph
from fusion.prepare import fill_memory
from fusion.simulate import SimulationOptions, simulate, simulate_with_truth
from fusion.smoother import run_smoother

BATCH = FuseOptions(estimator="batch")


@pytest.mark.parametrize("measurements", ["camera", "objects"])
def test_with_small_white_noise_the_batch_is_the_smoothed_filter(measurements):
    options = FuseOptions(
        measurements=measurements,
        gate=Gate(probability=1.0),
        bias=DetectionBias(use=False),
        graph=Graph(kernel="none", rounds=1, keyframe_rate_hz=100.0),
    )
    problem = simulated(
        measurements,
        options=options,
        symmetric_objects=0,
        noise="white",
        white=WhiteErrors(across_m=0.0003, along_of_depth=0.0005, rotation_deg=0.1),
        camera_pose_position_sigma_m=0.001,
        camera_pose_rotation_sigma_deg=0.1,
    )
    smoothed, batch = run_smoother(problem, options), run_graph(problem, replace(options, estimator="batch"))
    assert batch.name == f"fuse/batch/{measurements}"
    later = batch.stamps_ns > batch.stamps_ns[0] + 500_000_000
    position, attitude = distances(batch, smoothed)
    assert np.all(position[later] < 0.1 * np.linalg.norm(smoothed.sigmas[later, 3:6], axis=1))
    assert np.all(attitude[later] < 0.1 * np.linalg.norm(smoothed.sigmas[later, :3], axis=1))
    np.testing.assert_allclose(batch.sigmas[later], smoothed.sigmas[later], rtol=0.02)
    shift = np.abs(batch.velocity - smoothed.velocity)[later]
    assert np.all(shift < 0.1 * smoothed.sigmas[later, 6:9])


def test_with_correlated_errors_the_batch_and_the_smoothed_filter_agree_within_three_sigma():
    problem = simulated(duration_s=10.0)
    smoothed, batch = run_smoother(problem, FuseOptions()), run_graph(problem, BATCH)
    difference = batch.T_world_imu.translation - smoothed.T_world_imu.translation
    joint = np.sqrt(batch.sigmas[:, 3:6] ** 2 + smoothed.sigmas[:, 3:6] ** 2)
    assert np.all(np.abs(difference) < 3.0 * joint)
    turn = (smoothed.T_world_imu.rotation.inv() * batch.T_world_imu.rotation).as_rotvec()
    assert np.all(np.abs(turn) < 3.0 * np.sqrt(batch.sigmas[:, :3] ** 2 + smoothed.sigmas[:, :3] ** 2))


def solved(monkeypatch, problem, options):
    """Return what the batch handed to its optimiser, and what came back."""
    calls = []
    optimise = graph_batch.optimise

    def watched(graph, values, steps):
        calls.append((graph, values, *optimise(graph, values, steps)))
        return calls[-1][2:]

    monkeypatch.setattr(graph_batch, "optimise", watched)
    run_graph(problem, options)
    return calls


def test_gtsams_own_optimiser_finds_nothing_better(monkeypatch):
    options = replace(BATCH, graph=Graph(rounds=1, keyframe_rate_hz=5.0))
    graph, start, values, _ = solved(monkeypatch, simulated(duration_s=4.0), options)[-1]
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    params.setRelativeErrorTol(1e-10)
    best = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    assert graph.error(values) < graph.error(start)
    assert graph.error(values) - graph.error(best) < 1e-2


def test_the_batchs_covariances_are_the_inverse_of_the_information(monkeypatch):
    options = replace(BATCH, graph=Graph(rounds=1, keyframe_rate_hz=3.0, kernel="none"))
    graph, _, values, tree = solved(monkeypatch, simulated(duration_s=4.0), options)[-1]
    poses = sorted(key for key in list(values.keys()) if gtsam.Symbol(key).chr() == ord("x"))
    numbers = [gtsam.Symbol(key).index() for key in poses[4:6]]
    keys = [f(k) for k in numbers for f in (pose_key, velocity_key, imu_bias_key)]
    ordering = gtsam.Ordering()
    for key in [*keys, *sorted(set(values.keys()) - set(keys))]:
        ordering.push_back(key)
    A, _ = graph.linearize(values).jacobian(ordering)
    scale = 1.0 / np.linalg.norm(A, axis=0)
    dense = (np.linalg.inv((A * scale).T @ (A * scale)) * np.outer(scale, scale))[:30, :30]
    sigma = np.sqrt(np.diag(dense))
    own = joint_covariance(tree, keys)
    np.testing.assert_allclose(own / np.outer(sigma, sigma), dense / np.outer(sigma, sigma), atol=2e-3)


def test_rows_between_keyframes_are_those_of_the_gaussian_given_both_ends():
    """Condition the joint Gaussian of start, moment and end, built from transitions, on the ends by dense algebra."""
    options, problem, rng = FuseOptions(), simulated(), np.random.default_rng(0)
    stamps = problem.imu.stamps_ns
    values = imu_rows(problem.imu)
    noise = views.py_func(*fill_memory(problem, options)).noise
    between = Between(stamps, values, noise, 15)
    x, layout = nominal_state(StateLayout()), StateLayout()
    start, moment, end = int(stamps[50]), int(stamps[57]) + 2_000_000, int(stamps[66])
    core, F, Q = between.predict(start, x, np.array([moment, end]))
    there = x.copy()
    there[:21] = core[1]
    gap = 0.3 * np.linalg.cholesky(Q[1] + 1e-16 * np.eye(15)) @ rng.normal(size=15)
    there = retract_state(there, gap, layout)
    A = 1e-3 * rng.normal(size=(30, 30))
    P = A @ A.T
    found, covariance = between.between((start, end), (x, there), P, np.array([moment]))

    F_rest = F[1] @ np.linalg.inv(F[0])
    joint = np.block([[Q[0], Q[0] @ F_rest.T], [F_rest @ Q[0], Q[1]]])
    gain = joint[:15, 15:] @ np.linalg.inv(joint[15:, 15:])
    expected = x.copy()
    expected[:21] = core[0]
    expected = retract_state(expected, gain @ gap, layout)
    moved = x.copy()
    moved[:21] = found[0]
    sigma = np.sqrt(np.diag(Q[0]))
    np.testing.assert_allclose(local_state(expected, moved, layout) / sigma, 0.0, atol=1e-6)
    L = np.hstack([F[0] - gain @ F[1], gain])
    dense = L @ P @ L.T + joint[:15, :15] - gain @ joint[15:, :15]
    size = np.sqrt(np.diag(dense))
    np.testing.assert_allclose(covariance[0] / np.outer(size, size), dense / np.outer(size, size), atol=1e-6)


def test_rows_join_where_keyframes_stand_and_do_not_depend_on_their_rate():
    problem = simulated(noise="white")
    options = replace(BATCH, bias=DetectionBias(use=False))
    dense = run_graph(problem, replace(options, graph=Graph(kernel="none", rounds=1, keyframe_rate_hz=15.0)))
    sparse = run_graph(problem, replace(options, graph=Graph(kernel="none", rounds=1, keyframe_rate_hz=7.5)))
    position, attitude = distances(dense, sparse)
    assert np.all(position < 0.5 * np.linalg.norm(dense.sigmas[:, 3:6], axis=1))
    assert np.all(attitude < 0.5 * np.linalg.norm(dense.sigmas[:, :3], axis=1))
    steps = np.diff(sparse.T_world_imu.translation, axis=0) / np.diff(sparse.stamps_ns)[:, None] * 1e9
    assert np.max(np.abs(steps - sparse.velocity[1:])) < 0.1


def test_the_batch_mends_wrong_decisions_of_the_filter(monkeypatch):
    """Good measurements that were refused come back, gross errors that were let in go."""
    options = replace(BATCH, bias=DetectionBias(use=False))
    problem = simulated(options=options, noise="white", symmetric_objects=0, duration_s=8.0)
    measured, rng = problem.measurements, np.random.default_rng(0)
    chosen = rng.choice(np.flatnonzero(measured.stamps_ns > measured.stamps_ns[0] + 2_000_000_000), 12, replace=False)
    gross, good = chosen[:4], chosen[4:]
    t = measured.translations.copy()
    t[gross] += [0.3, 0.0, 0.0]
    problem = replace(problem, measurements=replace(measured, translations=t))
    stretches = graph_batch._stretches

    def misled(walk):
        found = list(stretches(walk))
        walk.columns.decisions[gross], walk.columns.decisions[good] = 3, 0
        return found

    right = run_graph(problem, options)
    monkeypatch.setattr(graph_batch, "_stretches", misled)
    believing = run_graph(problem, replace(options, graph=Graph(rounds=1)))
    assert np.all(believing.gate.position_accepted[gross])
    asked = run_graph(problem, options)
    assert not np.any(asked.gate.position_accepted[gross])
    assert np.count_nonzero(asked.gate.position_accepted[good]) >= 7
    assert np.max(distances(asked, right)[0]) < 0.5 * np.max(distances(believing, right)[0])


def test_every_start_of_the_filter_begins_a_stretch_of_its_own():
    """Half way the camera is elsewhere in the world: the filter starts anew, and so does the batch."""
    options = replace(BATCH, measurements="camera")
    problem = simulated("camera", duration_s=16.0)
    measured = problem.measurements
    second = measured.stamps_ns > measured.stamps_ns[0] + 8_000_000_000
    shift = np.where(second[:, None], [3.0, 0.0, 0.0], 0.0)
    batch = run_graph(
        replace(problem, measurements=replace(measured, translations=measured.translations + shift)), options
    )
    assert batch.restarts == 1
    assert np.all(np.isfinite(batch.sigmas))
    assert np.all(np.diff(batch.stamps_ns) > 0)
    first = run_graph(with_measurements(problem, ~second), options)
    until = np.searchsorted(batch.stamps_ns, measured.stamps_ns[0] + 7_000_000_000)
    start = batch.stamps_ns.searchsorted(first.stamps_ns[0])
    apart = batch.T_world_imu.translation[start:until] - first.T_world_imu.translation[: until - start]
    assert np.max(np.abs(apart)) < 0.01
    last = run_graph(with_measurements(problem, second), options)
    apart = batch.T_world_imu.translation[-100:] - last.T_world_imu.translation[-100:] - [3.0, 0.0, 0.0]
    assert np.max(np.abs(apart)) < 0.01


def test_the_batch_is_better_than_the_filter_and_knows_how_good_it_is():
    errors = {"eskf": [], "batch": []}
    for seed in range(3):
        rates = {"imu_rate_hz": 100.0, "camera_rate_hz": 15.0}
        log, _ = simulate_with_truth(SimulationOptions(duration_s=12.0, seed=seed, objects=3, **rates))
        for estimator, rows in errors.items():
            rows.append(rms_errors(fuse(log, FuseOptions(estimator=estimator)), log.T_world_imu))
    causal, batch = (np.mean(np.square(rows), axis=0) ** 0.5 for rows in errors.values())
    assert np.all(batch[:2] < causal[:2])
    assert batch[2] < 1.5


def test_the_batch_pushes_nothing_away():
    """A bias of the same size explains more the further an object is; the batch must not make use of that.

    One object, errors that last; where the bias acted at the estimated position, the camera stood 20 mm too far away.
    """
    behind = []
    for seed in range(6):
        rates = {"imu_rate_hz": 100.0, "camera_rate_hz": 10.0}
        log = simulate(SimulationOptions(duration_s=20.0, seed=seed, objects=1, symmetric_objects=0, **rates))
        smoothed, batch = fuse(log, FuseOptions(smooth=True)), fuse(log, BATCH)
        T_world_cam = smoothed.T_world_imu * log.calibration.T_cam_imu.inv()
        ahead = T_world_cam.rotation.apply([0.0, 0.0, 1.0])
        apart = batch.T_world_imu.translation - smoothed.T_world_imu.translation
        behind.append(-np.mean(np.sum(apart * ahead, axis=1)))
    assert np.abs(np.mean(behind)) < 0.006


def test_what_shortcuts_through_the_tree_call_indeterminate_is_found_without_them(monkeypatch):
    log = simulate(SimulationOptions(duration_s=3.0, imu_rate_hz=100.0, camera_rate_hz=10.0, objects=3, odometry=True))
    options = FuseOptions(estimator="batch", motion="odometry")
    expected, asked = fuse(log, options), []

    def indeterminate(tree, keys):
        asked.append(keys)
        if len(asked) in (2, 9):
            raise RuntimeError("Indeterminate linear system detected")
        return joint_covariance(tree, keys)

    monkeypatch.setattr(graph_batch, "joint_covariance", indeterminate)
    found = fuse(log, options)
    assert len(asked) > 10
    np.testing.assert_allclose(found.pose_covariances, expected.pose_covariances, rtol=1e-3, atol=1e-12)
