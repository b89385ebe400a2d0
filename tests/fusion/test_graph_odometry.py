"""Odometry beside the IMU in the graph: its factor against the filter's model, its result against filter and truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform
from test_graph import EVERY_STAMP, distances, rms_errors
from test_graph_factors import QUIET, assert_jacobians, random_poses, random_state, values_of
from test_graph_online import Feed, assert_same_state

from fusion.fuse import fuse, run_filter
from fusion.graph import run_graph
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import Model
from fusion.graph_motion import MotionChain
from fusion.graph_odometry import OdometryStep, odometry_error_at, odometry_factor
from fusion.graph_smoother import FixedLagSmoother
from fusion.graph_variables import CloneVariable, errors_of, keyframe_variables, pose3, static_variables
from fusion.graph_walk import Walk
from fusion.measurements import ODOMETRY_STEP
from fusion.memory import CLONED
from fusion.nav_state import EXTRINSIC_ROTATION, StateLayout, local_state, pose_at, put_pose
from fusion.options import DetectionBias, Estimate, FuseOptions, Gate, Graph, Odometry, Prior
from fusion.prepare import pose_problem
from fusion.reference_models import residual_and_jacobian
from fusion.simulate import SimulationOptions, simulate
from fusion.smoother import run_smoother
from poet_loc.core.trajectory import Trajectory

BOTH = FuseOptions(motion="imu+odometry")
GRAPH = replace(BOTH, estimator="graph", graph=Graph(lag_s=0.8))
SHORT = {"duration_s": 6.0, "imu_rate_hz": 100.0, "camera_rate_hz": 15.0, "objects": 3, "symmetric_objects": 0}


def log_with_odometry(shift_s=0.0, without=(np.inf, np.inf), **simulation):
    """Return a log whose odometry comes shift_s after the frames, and not at all between two times."""
    log = simulate(SimulationOptions(**(SHORT | {"odometry": True} | simulation)))
    stamps = log.T_odom_cam.stamps_ns + round(1e9 * shift_s)
    seconds = (stamps - stamps[0]) * 1e-9
    stamps = stamps[(stamps <= log.T_odom_cam.stamps_ns[-1]) & ~((seconds > without[0]) & (seconds < without[1]))]
    poses, _ = log.T_odom_cam.interpolate(stamps)
    return replace(log, T_odom_cam=Trajectory(stamps, poses))


def random_step(rng, rows=(0, 6)):
    A = 0.03 * rng.normal(size=(6, 6))
    T = random_poses(rng, 1)[0]
    T_then_now = gtsam.Pose3(gtsam.Rot3(T.rotation.as_matrix()), T.translation)
    return OdometryStep(0, rows[0], rows[1], T_then_now, A @ A.T + 1e-4 * np.eye(6))


@pytest.mark.parametrize("rows", [(0, 6), (3, 3), (0, 3)])
@pytest.mark.parametrize("extrinsics", [False, True])
def test_a_steps_jacobians_are_its_derivatives(extrinsics, rows):
    rng, layout = np.random.default_rng(1), StateLayout(extrinsics=extrinsics, clone=True)
    x, then = random_state(rng, layout), random_state(rng, layout)
    values = values_of([*keyframe_variables(1, True), *static_variables(layout)], x)
    keyframe_variables(0, True)[0].insert(values, then)
    assert_jacobians(odometry_factor(random_step(rng, rows), 0, 1, Model(layout, x.copy(), True, QUIET)), values)


def test_a_step_says_what_the_filter_says_of_it():
    """The same rows as the filter's, of the state and its clone; and gtsam's between factor, carried to the imu."""
    rng, layout = np.random.default_rng(2), StateLayout(extrinsics=True, clone=True)
    x, then, step = random_state(rng, layout), random_state(rng, layout), random_step(rng)
    put_pose(x, layout.clone_start, pose_at(then, 0))
    R_m, t_m = step.T_then_now.rotation().matrix(), step.T_then_now.translation()
    residual, _ = residual_and_jacobian(ODOMETRY_STEP, -1, R_m, t_m, x, np.zeros(3), 0.0, layout)
    np.testing.assert_allclose(odometry_error_at(step, then, x), -residual, atol=1e-12)

    T_imu_cam, A = pose3(x, EXTRINSIC_ROTATION), pose3(then, 0)
    near = T_imu_cam.compose(step.T_then_now).compose(T_imu_cam.inverse()).retract(1e-4 * rng.normal(size=6))
    values = gtsam.Values()
    for k, T in enumerate((A, A.compose(near))):
        values.insert(keyframe_variables(k, True)[0].key, T)
    known = StateLayout(clone=True)
    factor = odometry_factor(step, 0, 1, Model(known, x.copy(), True, QUIET))
    to_imu = T_imu_cam.AdjointMap() @ block_diag(np.eye(3), R_m.T)
    noise = gtsam.noiseModel.Gaussian.Covariance(to_imu @ step.covariance @ to_imu.T)
    between = T_imu_cam.compose(step.T_then_now).compose(T_imu_cam.inverse())
    own = gtsam.BetweenFactorPose3(*factor.keys(), between, noise)
    assert factor.error(values) == pytest.approx(own.error(values), rel=1e-2)


def test_the_clones_error_is_the_filters():
    rng, layout = np.random.default_rng(3), StateLayout(clone=True)
    x = random_state(rng, layout)
    put_pose(x, layout.clone_start, random_poses(rng, 1)[0])
    variable = CloneVariable(1, errors_of(layout, "clone"), layout.clone_start)
    J, T = variable.to_filter(x), pose_at(x, layout.clone_start)
    for column in range(6):
        moved = x.copy()
        put_pose(moved, layout.clone_start, T * RigidTransform.from_exp_coords(1e-6 * np.eye(6)[column]))
        error = local_state(x, moved, layout)[layout.error_slice("clone")]
        np.testing.assert_allclose(error / 1e-6, J[:, column], atol=1e-5)


@pytest.mark.parametrize("estimate", [Estimate(), Estimate(extrinsics=True)])
@pytest.mark.parametrize("shift_s", [0.0, 0.017])
def test_a_lag_of_one_keyframe_is_the_filter_with_its_clone(shift_s, estimate):
    """Odometry's stamps stand among the keyframes, wherever they fall; a step outlasts the lag, and a gap does too."""
    nearly_right = Prior(extrinsic_rotation_deg=0.5, extrinsic_position=0.005)  # so that all is linear
    believing = {"bias": DetectionBias(use=False), "gate": Gate(adaptation=0.0)}
    options = replace(BOTH, estimate=estimate, prior=nearly_right, **believing)
    problem = pose_problem(log_with_odometry(shift_s, (2.0, 3.5), noise="white"), options)
    causal = run_filter(problem, options)
    graph = run_graph(problem, replace(options, estimator="graph", graph=EVERY_STAMP))
    assert graph.motion == "imu+odometry"
    later = causal.stamps_ns > causal.stamps_ns[0] + 1_000_000_000
    position, attitude = distances(graph, causal)
    assert np.all(position[later] < 0.1 * np.linalg.norm(causal.sigmas[later, 3:6], axis=1))
    assert np.all(attitude[later] < 0.1 * np.linalg.norm(causal.sigmas[later, :3], axis=1))
    np.testing.assert_allclose(graph.sigmas[later, :9], causal.sigmas[later, :9], rtol=0.02)


@pytest.mark.parametrize("shift_s", [0.0, 0.017])
def test_the_batch_is_the_smoothed_filter(shift_s):
    options = replace(BOTH, bias=DetectionBias(use=False), graph=Graph(kernel="none", rounds=1, keyframe_rate_hz=100.0))
    problem = pose_problem(log_with_odometry(shift_s, noise="white"), options)
    smoothed, batch = run_smoother(problem, options), run_graph(problem, replace(options, estimator="batch"))
    later = batch.stamps_ns > batch.stamps_ns[0] + 1_000_000_000
    position, attitude = distances(batch, smoothed)
    assert np.all(position[later] < 0.3 * np.linalg.norm(smoothed.sigmas[later, 3:6], axis=1))
    assert np.all(attitude[later] < 0.3 * np.linalg.norm(smoothed.sigmas[later, :3], axis=1))
    np.testing.assert_allclose(batch.sigmas[later, :9], smoothed.sigmas[later, :9], rtol=0.05)


def test_every_step_counts_once_and_ends_at_keyframes(monkeypatch):
    """Also where none of its stamps is a frame's, and where the lag is shorter than a step."""
    added, keyframes, widths = [], [], []
    add, extend = GraphBuilder.add_odometry, FixedLagSmoother.extend

    def noting(self, step):
        if step is not None and step.size and self.clone >= 0:
            added.append((self.clone, self.keyframe, step.measurement))
        add(self, step)

    def watched(self, keyframe, walk):
        extend(self, keyframe, walk)
        keyframes.append(keyframe.stamp_ns)
        widths.append(len(self._came))

    monkeypatch.setattr(GraphBuilder, "add_odometry", noting)
    monkeypatch.setattr(FixedLagSmoother, "extend", watched)
    options = replace(GRAPH, graph=Graph(lag_s=0.2), bias=DetectionBias(use=False))
    problem = pose_problem(log_with_odometry(0.017, duration_s=12.0, noise="white"), options)
    run_graph(problem, options)
    m = problem.measurements
    steps = np.flatnonzero((m.kinds == ODOMETRY_STEP) & (m.stamps_ns > keyframes[0]))
    assert len(steps) > 25
    assert np.isin(m.stamps_ns[steps], keyframes).all()
    numbers = [number for _, _, number in added]
    assert len(set(numbers)) == len(numbers) > 0.9 * len(steps)
    assert all(then >= before for (_, before, _), (then, _, _) in pairwise(added))
    assert max(widths[20:]) <= max(widths[:20])


@pytest.mark.parametrize("estimator", ["graph", "batch"])
def test_odometry_holds_the_graph_where_nothing_is_seen(estimator):
    drift = {}
    for seed in range(2):
        log = simulate(
            SimulationOptions(**(SHORT | {"duration_s": 14.0, "odometry": True, "noise": "white", "seed": seed}))
        )
        seconds = (log.object_poses[""].stamps_ns - log.imu.stamps_ns[0]) * 1e-9
        log = replace(log, object_poses={"": log.object_poses[""][(seconds < 6.0) | (seconds > 12.0)]})
        blind = (int(log.imu.stamps_ns[0]) + 10**9 * np.array([7, 12])).astype(np.int64)
        for motion in ("imu", "imu+odometry"):
            result = fuse(log, FuseOptions(estimator=estimator, motion=motion))
            rows = slice(*np.searchsorted(result.stamps_ns, blind))
            truth, _ = log.T_world_imu.interpolate(result.stamps_ns[rows])
            away = np.linalg.norm(result.T_world_imu.translation[rows] - truth.translation, axis=1)
            sigma = np.linalg.norm(result.sigmas[rows, 3:6], axis=1)
            drift.setdefault(motion, []).append(away.max())
            assert np.all(away < 4.0 * sigma)
    share = 0.6 if estimator == "graph" else 0.8  # the batch holds both ends of the gap
    assert np.mean(drift["imu+odometry"]) < share * np.mean(drift["imu"])


@pytest.mark.parametrize("estimator", ["graph", "batch"])
def test_odometry_that_jumps_is_refused(estimator):
    log = log_with_odometry(duration_s=8.0)
    options = replace(BOTH, estimator=estimator)
    T_odom_cam = log.T_odom_cam
    jumped = RigidTransform.from_translation([0.4, 0.0, 0.0]) * T_odom_cam.T_world_body[60:]
    poses = RigidTransform.concatenate([T_odom_cam.T_world_body[:60], jumped])
    right, wrong = fuse(log, options), fuse(replace(log, T_odom_cam=Trajectory(T_odom_cam.stamps_ns, poses)), options)
    assert right.motion == wrong.motion == "imu+odometry"
    assert rms_errors(wrong, log.T_world_imu)[0] < 1.2 * rms_errors(right, log.T_world_imu)[0]


def test_the_graph_with_odometry_is_as_accurate_and_as_honest_as_the_filter():
    errors = {"eskf": [], "graph": [], "batch": []}
    for seed in range(3):
        log = log_with_odometry(duration_s=12.0, seed=seed, symmetric_objects=1)
        for estimator, rows in errors.items():
            rows.append(rms_errors(fuse(log, FuseOptions(estimator=estimator)), log.T_world_imu))
    causal, graph, batch = (np.mean(np.square(rows), axis=0) ** 0.5 for rows in errors.values())
    assert np.all(graph[:2] < 1.1 * causal[:2])
    assert graph[2] < 1.2 * causal[2]
    assert np.all(batch[:2] < causal[:2])


@pytest.mark.parametrize("lateness_s", [0.0, 0.6])
def test_fed_online_it_is_the_graph_on_the_whole_log(lateness_s):
    """Odometry comes late and between the poses that came before it; poses come through the public call."""
    log = log_with_odometry(0.017)
    options = replace(GRAPH, odometry=Odometry(step_s=0.25))
    problem = pose_problem(log, options)
    whole = run_graph(problem, options)
    feed, T = Feed(problem, options), log.T_odom_cam
    rng, last = np.random.default_rng(0), int(problem.imu.stamps_ns[-2])
    late = (T.stamps_ns + rng.uniform(0.0, lateness_s * 1e9, len(T))).astype(np.int64)
    arrivals = np.minimum(np.maximum.accumulate(late), np.maximum(last, T.stamps_ns))
    waiting = list(zip(arrivals, T.stamps_ns, T.T_world_body))
    m = problem.measurements
    poses = [(int(t), 0, j) for j, t in enumerate(m.stamps_ns) if m.kinds[j] != ODOMETRY_STEP]
    for arrival, is_sample, i in sorted(poses + [(int(t), 1, i) for i, t in enumerate(problem.imu.stamps_ns)]):
        while waiting and waiting[0][0] <= arrival:
            _, stamp, pose = waiting.pop(0)
            feed.estimator.feed_odometry(stamp, pose.translation, pose.rotation.as_quat())
        feed.sample(i) if is_sample else feed.pose(i)
        if is_sample and arrival == last:
            state = feed.estimator.state()
    assert feed.estimator.health().too_late == 0
    assert lateness_s == 0.0 or feed.estimator.health().replays > 10
    assert_same_state(state, whole, 1e-9)


def test_a_graph_that_starts_without_odometry_takes_the_filters_clone_away():
    """Else the filter would take in the next step against a pose that the graph knows nothing of."""
    problem = pose_problem(log_with_odometry(0.017, noise="white"), GRAPH)
    walk = Walk(problem, GRAPH)
    keyframe, m = walk.next_keyframe(), walk.memory
    assert keyframe.started
    m.counters[CLONED] = 1
    builder = GraphBuilder(problem.layout, m.x, m.bias_model, MotionChain.of(problem, GRAPH), GRAPH.graph)
    FixedLagSmoother(builder, GRAPH.graph).start(keyframe, walk)
    assert m.counters[CLONED] == 0
