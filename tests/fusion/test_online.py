"""Fed sample by sample, in order or not, the filter gives the numbers of the whole-log call."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from filter_runs import LAYOUTS, run, simulated
from scipy.linalg import sqrtm
from scipy.spatial.transform import Rotation

from fusion import filter_loop, memory
from fusion.bias_spread import white_part
from fusion.measurements import CAMERA_POSE, ODOMETRY_STEP, Measurements
from fusion.online import Estimator
from fusion.online_input import OnlineOptions
from fusion.options import DetectionBias, FuseOptions, Odometry
from fusion.prepare import Problem, pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.input_error import InputError
from poet_loc.io.log_folder import read_log


def estimator_for(problem: Problem, options: FuseOptions, online: OnlineOptions | None = None) -> Estimator:
    estimator = Estimator(problem.calibration, problem.landmark_map, options, online, layout=problem.layout)
    estimator.memory.prior[estimator.memory.prior == 0.0] = 0.02
    return estimator


def events(problem: Problem) -> list[tuple[int, int, int]]:
    """Return (stamp, 0 for poses or 1 for an IMU sample, index) in order: poses first, a frame is one event."""
    frames = np.unique(problem.measurements.stamps_ns)
    found = [(int(stamp), 0, int(stamp)) for stamp in frames]
    return sorted(found + [(int(stamp), 1, k) for k, stamp in enumerate(problem.imu.stamps_ns)])


def feed(estimator: Estimator, problem: Problem, event: tuple[int, int, int]) -> None:
    _, what, index = event
    if what == 1:
        imu = problem.imu
        estimator.feed_imu(imu.stamps_ns[index], imu.angular_velocity[index], imu.specific_force[index])
        return
    m, shift = problem.measurements, problem.calibration.timeshift_ns
    rows = np.flatnonzero(m.stamps_ns == index)
    q = Rotation.from_matrix(m.rotations[rows].reshape(-1, 3, 3)).as_quat()
    if m.kinds[rows[0]] == CAMERA_POSE:
        estimator.feed_camera_pose(index - shift, m.translations[rows[0]], q[0], m.covariances[rows[0]])
        return
    keys, t = np.array(problem.keys)[m.objects[rows]], m.translations[rows]
    R = stated_for(m.covariances[rows], t, estimator.options)
    estimator.feed_object_poses(index - shift, keys[:, 0], t, q, R, instances=keys[:, 1])


def stated_for(white: np.ndarray, t: np.ndarray, options: FuseOptions) -> np.ndarray:
    """Return the covariances whose white part is this."""
    of_unit, R = white_part(np.tile(np.eye(6), (len(t), 1, 1)), t, options.noise, options.bias), []
    for squared, wanted in zip(of_unit, white):
        root = np.linalg.inv(sqrtm(squared).real) if np.isfinite(squared).all() else np.eye(6)
        R.append(root @ wanted @ root)
    return np.array(R)


def assert_ends_like(estimator: Estimator, problem: Problem, options: FuseOptions, tolerance: float = 1e-9) -> None:
    whole = run(filter_loop.run_log, problem, options)
    assert np.count_nonzero(whole.decisions) > 30
    np.testing.assert_allclose(estimator.memory.x, whole.memory.x, rtol=tolerance, atol=tolerance)
    scale = np.sqrt(np.diag(whole.memory.P))
    np.testing.assert_allclose(
        estimator.memory.P / np.outer(scale, scale), whole.memory.P / np.outer(scale, scale), rtol=0, atol=tolerance
    )
    kept = [memory.NOW, memory.MODE, memory.STARTED_AT, memory.VOTE_HEAD, memory.RESTARTS, memory.LAST_UPDATE]
    np.testing.assert_array_equal(estimator.memory.counters[kept], whole.memory.counters[kept])
    np.testing.assert_allclose(estimator.memory.votes, whole.memory.votes, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(estimator.memory.tallies, whole.memory.tallies, rtol=1e-7)
    np.testing.assert_allclose(estimator.memory.places, whole.memory.places, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(estimator.memory.used, whole.memory.used)
    np.testing.assert_allclose(estimator.memory.scatter, whole.memory.scatter, rtol=1e-7)


def shuffled(problem: Problem, lateness_s: float, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Return the events by arrival: each up to lateness_s late."""
    in_order = events(problem)
    late = rng.uniform(0.0, lateness_s * 1e9, len(in_order))
    return [in_order[i] for i in np.argsort([event[0] + wait for event, wait in zip(in_order, late)])]


@pytest.mark.parametrize("measurements", ["camera", "objects"])
def test_every_state_is_the_whole_logs_row(measurements):
    problem, options = simulated(measurements, noise="network"), FuseOptions(measurements=measurements)
    whole = run(filter_loop.run_log, problem, options)
    rows = {int(stamp): i for i, stamp in enumerate(whole.stamps)}
    estimator, seen = estimator_for(problem, options), 0
    for event in events(problem):
        feed(estimator, problem, event)
        state = estimator.state()
        if event[1] == 0:
            continue
        assert (state is None) == (event[0] not in rows)
        if state is not None:
            row = rows[state.stamp_ns]
            np.testing.assert_allclose(state.position, whole.core[row, 9:12], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(state.R_world_imu.ravel(), whole.core[row, :9], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(state.sigmas, whole.sigma[row], rtol=1e-9)
            seen += 1
    assert seen > 200
    assert_ends_like(estimator, problem, options)


@pytest.mark.parametrize("layout", ["no biases", "everything"])
@pytest.mark.parametrize("seed", [0, 1])
def test_shuffled_input_gives_the_in_order_result(layout, seed):
    problem, options = simulated(layout=LAYOUTS[layout], noise="network", timeshift_cam_imu_s=0.013), FuseOptions()
    estimator = estimator_for(problem, options, OnlineOptions(horizon_s=0.4))
    for event in shuffled(problem, 0.4, np.random.default_rng(seed)):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)
    health = estimator.health()
    assert health.too_late == 0
    assert health.replays > 50


def test_shuffled_input_gives_the_in_order_result_where_scatter_sizes_the_biases():
    options = FuseOptions(bias=DetectionBias(scatter_rotation_deg=1.0, scatter_margin=1.0))
    problem = simulated(noise="network", options=options)
    estimator = estimator_for(problem, options, OnlineOptions(horizon_s=0.4))
    for event in shuffled(problem, 0.4, np.random.default_rng(5)):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)
    assert np.ptp(estimator.memory.x[problem.layout.spread_start :].reshape(-1, 4)[:, :3], axis=0).min() > 0.0
    assert estimator.health().replays > 50


@pytest.mark.parametrize("delay_s", [-0.03, 0.03])
def test_shuffled_input_gives_the_in_order_result_while_the_time_offset_is_followed(delay_s):
    problem = simulated(layout=LAYOUTS["time offset"], noise="white", stamp_delay_s=delay_s)
    options = FuseOptions()
    estimator = estimator_for(problem, options, OnlineOptions(horizon_s=0.4))
    for event in shuffled(problem, 0.3, np.random.default_rng(3)):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)
    assert abs(estimator.memory.counters[memory.DELAY]) > 15_000_000
    assert estimator.health().too_late == 0


def test_poses_that_are_always_late_give_the_in_order_result():
    problem, options = simulated("camera"), FuseOptions(measurements="camera")
    delayed = sorted(events(problem), key=lambda event: event[0] + (50_000_000 if event[1] == 0 else 0))
    estimator = estimator_for(problem, options)
    for event in delayed:
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)


def test_duplicates_are_ignored_and_counted():
    problem, options = simulated(noise="network"), FuseOptions()
    estimator, rng, sent = estimator_for(problem, options), np.random.default_rng(3), 0
    history: list[tuple[int, int, int]] = []
    for event in events(problem):
        feed(estimator, problem, event)
        history.append(event)
        if rng.uniform() < 0.3:
            again = history[-1 - rng.integers(0, min(10, len(history)))]
            feed(estimator, problem, again)
            sent += 1 if again[1] == 1 else int(np.count_nonzero(problem.measurements.stamps_ns == again[2]))
    assert_ends_like(estimator, problem, options)
    assert estimator.health().duplicates == sent > 100


def test_what_is_too_late_is_refused_and_counted():
    problem, options = simulated("camera"), FuseOptions(measurements="camera")
    in_order = events(problem)
    estimator = estimator_for(problem, options, OnlineOptions(horizon_s=0.1))
    for event in in_order:
        feed(estimator, problem, event)
    before = estimator.memory.x.copy()
    too_old = problem.imu.stamps_ns[-1] - 100_000_001
    for event in [event for event in in_order if event[0] <= too_old][-20:]:
        feed(estimator, problem, event)
    assert estimator.health().too_late == 20
    np.testing.assert_array_equal(estimator.memory.x, before)


def test_gaps_and_jitter():
    rng, problem, options = np.random.default_rng(7), simulated("camera"), FuseOptions(measurements="camera")
    stamps = problem.imu.stamps_ns
    kept = (stamps < stamps[300]) | (stamps > stamps[380])
    moved = stamps[kept] + rng.integers(-2_000_000, 2_000_000, np.count_nonzero(kept))
    imu = problem.imu[kept]
    problem = replace(problem, imu=replace(imu, stamps_ns=moved))
    estimator = estimator_for(problem, options)
    for event in shuffled(problem, 0.2, rng):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)


def test_a_restart_undone_by_late_input_leaves_no_trace():
    """Wrong poses all through a second make the filter start anew; they come late, in shreds and in the wrong order."""
    problem, options = simulated("camera", duration_s=8.0), FuseOptions(measurements="camera")
    options = replace(options, start=replace(options.start, lost_window_s=0.8, lost_min_votes=6))
    m = problem.measurements
    translations, half = m.translations.copy(), len(m) // 2
    translations[half:] += [1.0, 0.5, 0.0]
    problem = replace(problem, measurements=replace(m, translations=translations))
    whole = run(filter_loop.run_log, problem, options)
    assert whole.memory.counters[memory.RESTARTS] > 0
    estimator = estimator_for(problem, options, OnlineOptions(horizon_s=1.5))
    for event in shuffled(problem, 1.5, np.random.default_rng(0)):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)


def test_small_buffers_are_emptied_in_time():
    problem, options = simulated("camera"), FuseOptions(measurements="camera")
    online = OnlineOptions(horizon_s=0.3, ahead_s=0.4, max_imu_rate_hz=100.0, max_pose_rate_hz=1.0)
    estimator = estimator_for(problem, options, online)
    for event in shuffled(problem, 0.3, np.random.default_rng(1)):
        feed(estimator, problem, event)
    assert estimator.health().overflowed == 0
    assert_ends_like(estimator, problem, options)


def test_a_faster_imu_than_the_buffers_are_made_for_still_runs():
    problem, options = simulated("camera", imu_rate_hz=500.0), FuseOptions(measurements="camera")
    estimator = estimator_for(problem, options, OnlineOptions(horizon_s=0.5, max_imu_rate_hz=50.0))
    for event in events(problem):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)


def test_broken_numbers_and_unknown_objects_change_nothing():
    problem, options = simulated(noise="white"), FuseOptions()
    estimator = estimator_for(problem, options)
    for k, event in enumerate(events(problem)):
        feed(estimator, problem, event)
        if k % 50 == 0:
            stamp = event[0] + 1
            estimator.feed_imu(stamp, [np.nan, 0.0, 0.0], [0.0, 0.0, 9.81])
            estimator.feed_object_poses(stamp, [1], [[0.0, np.inf, 1.0]], [[0.0, 0.0, 0.0, 1.0]])
            estimator.feed_object_poses(stamp, [999], [[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0, 1.0]])
            estimator.feed_object_poses(stamp + 10_000_000_000, [1], [[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0, 1.0]])
    assert_ends_like(estimator, problem, options)
    health = estimator.health()
    assert health.malformed == 2 * health.not_in_map
    assert health.too_early == health.not_in_map > 10
    assert health.mode == "tracking"


def test_health_tells_of_accepted_poses_and_of_silence():
    options = FuseOptions(bias=DetectionBias(use=False))
    problem = simulated(noise="white", options=options)
    estimator = estimator_for(problem, options)
    assert estimator.health().mode == "initialising"
    assert estimator.state() is None
    for event in events(problem):
        feed(estimator, problem, event)
    for health in estimator.health().objects.values():
        assert health.poses == 0 or health.position_accepted > 0.7
        assert health.poses == 0 or 0.0 < health.test_ratio < 1.0
    imu, last = problem.imu, int(problem.imu.stamps_ns[-1])
    for k in range(1, 101):
        estimator.feed_imu(last + k * 10_000_000, imu.angular_velocity[-1], imu.specific_force[-1])
    assert estimator.health().mode == "coasting"


def test_reset_forgets_everything():
    problem, options = simulated("camera"), FuseOptions(measurements="camera")
    estimator = estimator_for(problem, options)
    for _ in range(2):
        for event in events(problem):
            feed(estimator, problem, event)
        assert_ends_like(estimator, problem, options)
        estimator.reset()
        assert estimator.state() is None


def test_the_whole_log_on_real_data(shared_data):
    log, options = read_log(shared_data / "euroc_v101"), FuseOptions()
    problem = pose_problem(log, options, object_poses=log.detections()[1])
    problem = replace(problem, imu=problem.imu[:2500])
    estimator = estimator_for(problem, options)
    rng = np.random.default_rng(0)
    for event in shuffled(problem, 0.3, rng):
        feed(estimator, problem, event)
    inside = problem.measurements.stamps_ns <= problem.imu.stamps_ns[-1]
    assert np.count_nonzero(inside) > 300
    assert_ends_like(estimator, problem, options)


@pytest.mark.parametrize("lateness_s", [0.0, 0.3])
def test_odometry_is_fed_beside_the_imu(lateness_s):
    options = FuseOptions(motion="imu+odometry")
    wanted = SimulationOptions(duration_s=6.0, imu_rate_hz=100.0, camera_rate_hz=15.0, objects=3, odometry=True)
    log = simulate(wanted)
    problem = pose_problem(log, options)
    steps = problem.measurements.kinds == ODOMETRY_STEP
    assert np.count_nonzero(steps) > 15
    poses = replace(problem, measurements=replace_rows(problem.measurements, ~steps))
    seconds = np.random.default_rng(0).uniform(0.0, lateness_s, len(log.T_odom_cam))
    arrivals = np.maximum.accumulate(log.T_odom_cam.stamps_ns + (seconds * 1e9).astype(np.int64))
    waiting = list(zip(arrivals, log.T_odom_cam.stamps_ns, log.T_odom_cam.T_world_body))
    estimator = estimator_for(problem, options)
    for event in events(poses):
        while waiting and waiting[0][0] <= event[0]:
            _, stamp, T = waiting.pop(0)
            estimator.feed_odometry(stamp, T.translation, T.rotation.as_quat())
        feed(estimator, poses, event)
    assert_ends_like(estimator, problem, options)


@pytest.mark.parametrize("stated", [None, np.tile(0.01 * np.eye(6), (2, 1, 1))], ids=["unstated", "stated"])
def test_a_detection_at_the_camera_is_left_out_before_its_ray_is_asked_for(stated):
    problem, q = simulated(noise="white"), [[0.0, 0.0, 0.0, 1.0]] * 2
    estimator = estimator_for(problem, FuseOptions())
    ids = [object_id for object_id, _ in problem.keys[:2]]
    with np.errstate(all="raise"):
        estimator.feed_object_poses(10**9, ids, [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], q, stated)
    assert estimator.health().not_in_map == 1
    assert estimator.health().waiting == 1


def test_odometry_that_was_refused_is_made_up_for_by_the_next():
    options = FuseOptions(motion="imu+odometry", odometry=Odometry(step_s=0.1))
    log = simulate(SimulationOptions(duration_s=6.0, camera_rate_hz=10.0, objects=3, noise="white", odometry=True))
    poses = pose_problem(log, FuseOptions(motion="imu"))
    estimator = estimator_for(replace(poses, layout=replace(poses.layout, clone=True)), options)
    odometry = dict(zip(log.T_odom_cam.stamps_ns.tolist(), log.T_odom_cam.T_world_body))
    sent = 0
    for event in events(poses):
        feed(estimator, poses, event)
        if event[1] == 0:
            T, broken = odometry[event[0]], event[0] // 10**8 % 3 == 0
            place = np.full(3, np.nan) if broken else T.translation
            estimator.feed_odometry(event[0], place, T.rotation.as_quat())
            estimator.feed_odometry(event[0] - 1, T.translation, T.rotation.as_quat())  # out of its order: ignored
            sent += broken
    assert estimator.health().malformed == sent > 10
    truth, _ = log.T_world_imu.interpolate(np.array([estimator.state().stamp_ns]))
    assert np.linalg.norm(estimator.state().position - truth.translation[0]) < 0.03
    with pytest.raises(InputError, match="odometry"):
        estimator_for(poses, FuseOptions()).feed_odometry(0, np.zeros(3), [0.0, 0.0, 0.0, 1.0])


def replace_rows(measurements: Measurements, rows: np.ndarray) -> Measurements:
    return Measurements(*(getattr(measurements, each.name)[rows] for each in fields(Measurements)))


def test_missing_calibration_and_map_are_said_so():
    problem = simulated("camera")
    with pytest.raises(InputError, match="noise densities"):
        Estimator(replace(problem.calibration, imu=None))
    with pytest.raises(InputError, match="odometry"):
        Estimator(problem.calibration, None, FuseOptions(measurements="camera", motion="odometry"))
    with pytest.raises(InputError, match="map"):
        Estimator(problem.calibration, None, FuseOptions(measurements="objects"))
