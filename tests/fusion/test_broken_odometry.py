"""Odometry that jumps, has holes, begins late, ends early: the estimate is where it should be within a second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from filter_runs import assert_same, run
from scipy.spatial.transform import RigidTransform, Rotation
from test_online import assert_ends_like, estimator_for, events, feed, replace_rows

from fusion import filter_loop, reference_filter
from fusion.filter_motion import begin
from fusion.fuse import fuse, run_filter
from fusion.graph_motion import MotionChain
from fusion.measurements import ODOMETRY_STEP
from fusion.memory import allocate, views
from fusion.nav_state import StateLayout
from fusion.odometry import ROTATION_DOUBT, TRANSLATION_DOUBT
from fusion.options import DetectionBias, FuseOptions, Gap
from fusion.prepare import pose_problem
from fusion.result import FuseResult
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log

ODOMETRY, BOTH = FuseOptions(motion="odometry"), FuseOptions(motion="imu+odometry")
BREAK_S = 6.0
JUMP = make_pose(Rotation.from_rotvec([10.0, 38.0, -5.0], degrees=True), [0.3, -0.4, 0.1])
ELSEWHERE = make_pose(Rotation.from_rotvec([120.0, -60.0, 90.0], degrees=True), [1.5, 0.2, -0.7])


def seconds_of(stamps_ns, log: Log) -> np.ndarray:
    return (stamps_ns - log.imu.stamps_ns[0]) * 1e-9


def jumped(log: Log, jump: RigidTransform = JUMP) -> Log:
    """From a pose on, the odometry goes on from one that is a jump away."""
    odometry, poses = log.T_odom_cam, log.T_odom_cam.T_world_body
    k = int(np.argmax(seconds_of(odometry.stamps_ns, log) > BREAK_S))
    moved = poses[k] * jump * poses[k].inv() * poses[k:]
    return replace(log, T_odom_cam=Trajectory(odometry.stamps_ns, RigidTransform.concatenate([poses[:k], moved])))


def holed(log: Log, frame: RigidTransform | None, length_s: float = 2.0) -> Log:
    """No odometry for some time before the break; then it goes on in another frame, or (None) where it stopped."""
    odometry, poses = log.T_odom_cam, log.T_odom_cam.T_world_body
    seconds = seconds_of(odometry.stamps_ns, log)
    before, after = np.flatnonzero(seconds < BREAK_S - length_s), np.flatnonzero(seconds > BREAK_S)
    frame = poses[before[-1]] * poses[after[0]].inv() if frame is None else frame
    poses = RigidTransform.concatenate([poses[before], frame * poses[after]])
    return replace(log, T_odom_cam=Trajectory(np.r_[odometry.stamps_ns[before], odometry.stamps_ns[after]], poses))


def blinded(log: Log, length_s: float) -> Log:
    """No detections for some time before the break either."""
    poses = log.object_poses[""]
    seconds = seconds_of(poses.stamps_ns, log)
    return replace(log, object_poses={"": poses[(seconds < BREAK_S - length_s) | (seconds > BREAK_S)]})


SPOILED: dict[str, Callable[[Log], Log]] = {
    "jump of 0.5 m and 40 deg": jumped,
    "jump of 40 deg": lambda log: jumped(log, make_pose(JUMP.rotation, np.zeros(3))),
    "hole, then as before": lambda log: holed(log, RigidTransform.identity()),
    "hole, then from where it stopped": lambda log: holed(log, None),
    "hole, then a new frame": lambda log: holed(log, ELSEWHERE),
    "short hole, then a new frame": lambda log: holed(log, ELSEWHERE, 0.5),
    "nothing seen, then from where it stopped": lambda log: blinded(holed(log, None), 2.0),
    "nothing seen, then a new frame": lambda log: blinded(holed(log, ELSEWHERE), 2.0),
    "nothing seen for long, then a new frame": lambda log: blinded(holed(log, ELSEWHERE, 3.0), 3.0),
}


@pytest.fixture(scope="module")
def log() -> Log:
    return simulated(0)


def simulated(seed: int, **changed) -> Log:
    world = {"duration_s": 11.0, "camera_rate_hz": 30.0, "imu_rate_hz": 100.0, "objects": 4, "symmetric_objects": 0}
    return simulate(SimulationOptions(**({"seed": seed, "noise": "network", "odometry": True} | world | changed)))


def errors(result: FuseResult, log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return seconds, position (m) and attitude errors (deg) and NEES per degree of freedom of the rows."""
    truth = log.T_world_imu
    rows = (result.stamps_ns >= truth.stamps_ns[0]) & (result.stamps_ns <= truth.stamps_ns[-1])
    T, estimate = truth.interpolate(result.stamps_ns[rows])[0], result.T_world_imu[rows]
    turn, step = (estimate.rotation.inv() * T.rotation).as_rotvec(), T.translation - estimate.translation
    e = np.hstack([turn, step])
    nees = np.einsum("ni,ni->n", e, np.linalg.solve(result.pose_covariances[rows], e[..., None])[..., 0]) / 6.0
    angle = np.degrees(np.linalg.norm(turn, axis=1))
    return seconds_of(result.stamps_ns[rows], log), np.linalg.norm(step, axis=1), angle, nees


@pytest.mark.parametrize("estimator", ["eskf", "graph"])
@pytest.mark.parametrize("name", SPOILED)
def test_the_estimate_is_where_it_should_be_soon_after(log, name, estimator):
    spoiled = SPOILED[name](log)
    options = replace(ODOMETRY, estimator=estimator)
    seconds, position, angle, nees = errors(fuse(spoiled, options), log)
    settled = errors(fuse(log, options), log)
    later = seconds > BREAK_S + 0.5
    before = settled[0] > BREAK_S
    assert position[later].max() < settled[1][before].max() + 0.05
    assert angle[later].max() < settled[2][before].max() + 2.0
    assert nees[seconds > 2.0].mean() < 2.0
    assert nees[seconds > 2.0].max() < 15.0  # also while it does not know


def test_the_smoother_knows_what_the_filter_does_not(log):
    spoiled = blinded(holed(log, ELSEWHERE), 2.0)
    seconds, _, _, nees = errors(fuse(spoiled, replace(ODOMETRY, smooth=True)), log)
    inside = (seconds > 1.0) & (seconds < BREAK_S + 1.0)
    assert nees[inside].max() < 15.0
    spoiled = jumped(log)
    smoothed, causal = (errors(fuse(spoiled, replace(ODOMETRY, smooth=smooth)), log)[1] for smooth in (True, False))
    assert np.sqrt(np.mean(smoothed**2)) < np.sqrt(np.mean(causal**2)) < 0.05


@pytest.mark.parametrize("spoil", [jumped, SPOILED["nothing seen, then a new frame"]])
def test_compiled_is_plain_where_odometry_breaks(spoil):
    problem = pose_problem(spoil(simulated(1, duration_s=8.0, camera_rate_hz=15.0)), ODOMETRY)
    compiled, plain = (run(loop, problem, ODOMETRY) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)


@pytest.mark.parametrize("name", ["jump of 0.5 m and 40 deg", "hole, then a new frame"])
@pytest.mark.parametrize("estimator", ["eskf", "graph", "batch"])
def test_beside_an_imu_what_contradicts_it_is_not_used(log, name, estimator):
    options = replace(BOTH, estimator=estimator)
    problem = pose_problem(SPOILED[name](log), options)
    walked = run_filter(problem, BOTH) if estimator == "eskf" else fuse(SPOILED[name](log), options)
    clean = fuse(log, options)
    at = np.searchsorted(walked.stamps_ns, clean.stamps_ns).clip(max=len(walked.stamps_ns) - 1)
    both = walked.stamps_ns[at] == clean.stamps_ns
    apart = walked.T_world_imu.translation[at[both]] - clean.T_world_imu.translation[both]
    assert np.linalg.norm(apart, axis=1).max() < 0.01
    assert errors(walked, log)[3].mean() < 2.0


def test_fed_one_by_one_a_jump_is_refused_as_in_the_whole_log():
    spoiled = jumped(simulated(2, duration_s=8.0, camera_rate_hz=15.0))
    problem = pose_problem(spoiled, BOTH)
    steps = problem.measurements.kinds == ODOMETRY_STEP
    poses = replace(problem, measurements=replace_rows(problem.measurements, ~steps))
    estimator = estimator_for(problem, BOTH)
    waiting = list(zip(spoiled.T_odom_cam.stamps_ns, spoiled.T_odom_cam.T_world_body))
    for event in events(poses):
        while waiting and waiting[0][0] <= event[0]:
            stamp, T = waiting.pop(0)
            estimator.feed_odometry(stamp, T.translation, T.rotation.as_quat())
        feed(estimator, poses, event)
    assert_ends_like(estimator, problem, BOTH)
    decisions = run(filter_loop.run_log, problem, BOTH).decisions[steps]
    seconds = seconds_of(problem.measurements.stamps_ns[steps], spoiled)
    refused = seconds[(decisions == 0) & (seconds > 2.0)]
    assert len(refused) == 1
    assert BREAK_S < refused[0] < BREAK_S + 0.4


@pytest.mark.parametrize("length_s", [2.0, 3.0])
def test_after_a_gap_of_the_imu_the_votes_since_then_say_where_it_is(log, length_s):
    """The attitude may be any, and what was seen before says nothing of it."""
    seconds = seconds_of(log.imu.stamps_ns, log)
    gap = replace(log, imu=log.imu[(seconds < BREAK_S - length_s) | (seconds > BREAK_S)])
    seconds, position, angle, _ = errors(fuse(blinded(gap, length_s), FuseOptions(motion="imu")), log)
    later = seconds > BREAK_S + 0.5
    assert position[later].max() < 0.1
    assert angle[later].max() < 6.0


def test_odometry_that_begins_late_and_ends_early_leaves_the_rest_to_the_detections(log):
    odometry = log.T_odom_cam
    seconds = seconds_of(odometry.stamps_ns, log)
    part = replace(log, T_odom_cam=odometry[(seconds > 4.0) & (seconds < 7.0)])
    for estimator in ("eskf", "graph"):
        result = fuse(part, replace(ODOMETRY, estimator=estimator))
        assert result.stamps_ns[-1] == log.object_poses[""].stamps_ns[-1]
        at, position, angle, nees = errors(result, log)
        assert at[0] < 2.0
        assert at[-1] > 10.0
        later = at > 3.0
        assert position[later].max() < 0.1
        assert angle[later].max() < 6.0
        assert nees[later].max() < 6.0


@pytest.mark.parametrize("begin_s", [0.1, -5.0, -1000.0])
def test_where_time_begins_does_not_matter(log, begin_s):
    """Near zero, over it and before it; also where the filter starts again and where it follows the scatter."""

    def moved(record):
        return replace(record, stamps_ns=record.stamps_ns + round(begin_s * 1e9) - log.imu.stamps_ns[0])

    spoiled, known = blinded(holed(log, ELSEWHERE), 2.0), DetectionBias(scatter_rotation_deg=1.0, scatter_across=0.002)
    poses = spoiled.object_poses[""]
    shifted = replace(spoiled, object_poses={"": moved(poses)}, T_odom_cam=moved(spoiled.T_odom_cam))
    expected, found = (fuse(each, replace(ODOMETRY, bias=known)) for each in (spoiled, shifted))
    np.testing.assert_allclose(found.T_world_imu.translation, expected.T_world_imu.translation, atol=1e-9)
    assert found.restarts == expected.restarts > 0


@pytest.mark.parametrize("kept", [slice(0, 2), slice(0, 3), slice(150, 152), slice(-2, None), slice(15, None, 30)])
def test_a_few_poses_of_odometry_leave_all_else_to_the_detections(log, kept):
    """What lies before and behind them is no measure of how long its intervals usually are."""
    result = fuse(replace(log, T_odom_cam=log.T_odom_cam[kept]), ODOMETRY)
    assert result.stamps_ns[-1] >= log.object_poses[""].stamps_ns[-1]
    seconds, position, _, nees = errors(result, log)
    assert seconds[0] < 1.0
    assert position.max() < 0.12
    assert nees.mean() < 2.0


def test_a_filter_that_never_starts_names_what_is_missing(log):
    """The IMU where no poses lie in its time; the odometry where it tears all votes apart."""
    poses = log.object_poses[""]
    later = replace(log, object_poses={"": replace(poses, stamps_ns=poses.stamps_ns + 10**11)})
    with pytest.raises(InputError, match=rf"imu\.csv: .* 0 of {len(poses)} poses lie between its"):
        fuse(later, BOTH)
    odometry, rng = log.T_odom_cam, np.random.default_rng(0)
    anywhere = make_pose(Rotation.random(len(odometry), rng=rng), rng.normal(size=(len(odometry), 3)))
    with pytest.raises(InputError, match="agree with each other and with the odometry"):
        fuse(replace(log, T_odom_cam=Trajectory(odometry.stamps_ns, anywhere)), ODOMETRY)


def test_the_shift_of_the_cameras_clock_is_odometrys_too():
    found = []
    for shift_s in (0.0, 0.1):
        log = simulated(3, noise="white", timeshift_cam_imu_s=shift_s)
        found.append(np.sqrt(np.mean(errors(fuse(log, ODOMETRY), log)[1][60:] ** 2)))
    assert found[1] < 1.1 * found[0]


def test_the_graph_takes_odometry_for_as_uncertain_as_the_filter_does(log):
    """The filter's variance over any stretch: drift and what is not known, each by the time that it lasted."""
    options = replace(ODOMETRY, gap=Gap(angular_rate=0.7, speed=0.4))
    chain = MotionChain.of(problem := pose_problem(holed(log, ELSEWHERE), options), options)
    rng, walk = np.random.default_rng(0), np.array([np.radians(0.25), 0.005])
    stamps, doubts = problem.imu.stamps_ns, problem.rows[:, ROTATION_DOUBT : TRANSLATION_DOUBT + 1]
    assert doubts.any()
    for _ in range(20):
        start, end = np.sort(rng.integers(stamps[0], stamps[-1], 2))
        factor, _ = chain.link(0, int(start), int(end), np.r_[np.eye(3).ravel(), np.zeros(60)])
        fine = np.linspace(start, end, 20001)
        rates = walk**2 + doubts[np.searchsorted(stamps, 0.5 * (fine[1:] + fine[:-1]), side="right") - 1]
        sigmas = np.sqrt(rates.mean(axis=0) * (end - start) * 1e-9)
        np.testing.assert_allclose(factor.noiseModel().sigmas(), np.repeat(sigmas, 3), rtol=2e-3)


@pytest.mark.parametrize("axis", range(3))
def test_a_level_attitude_is_found_whatever_axis_points_up(axis):
    m = views.py_func(*allocate(StateLayout()))
    begin(m, 0, 9.81 * np.eye(3)[axis], 0)
    R = m.x[:9].reshape(3, 3)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R @ np.eye(3)[axis], [0.0, 0.0, 1.0], atol=1e-12)


def test_a_hole_leaves_no_batch_indeterminate():
    """gtsam's shortcuts through this log's Bayes tree call a sound system indeterminate."""
    log = simulate(SimulationOptions(seed=1, duration_s=12.0, odometry=True))
    odometry = log.T_odom_cam
    kept = np.r_[0:100, 160 : len(odometry)]
    result = fuse(replace(log, T_odom_cam=odometry[kept]), FuseOptions(estimator="batch", motion="odometry"))
    _, position, _, nees = errors(result, log)
    assert position.max() < 0.1
    assert nees.mean() < 1.5
