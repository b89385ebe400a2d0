"""What a robot's program gets wrong: stamps in another unit, a clock that is set, arrays of another shape."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from filter_runs import simulated
from test_online import estimator_for, events, feed

from fusion.graph_online import GraphEstimator
from fusion.online import Estimator
from fusion.online_input import OnlineOptions
from fusion.options import Estimate, FuseOptions
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.input_error import InputError

BOTH = pytest.mark.parametrize("kind", [Estimator, GraphEstimator])
SECOND_NS = 1_000_000_000


@pytest.fixture(scope="module")
def log():
    return simulate(SimulationOptions(duration_s=6.0, imu_rate_hz=100.0, camera_rate_hz=15.0, objects=3, rest_s=0.5))


def new(kind, log, options=None, **online):
    return kind(log.calibration, log.landmark_map, options, OnlineOptions(**online))


def replay(estimator, log, until_s=np.inf, stamp=lambda ns: ns, covariance=None, since_s=-np.inf):
    """Feed a log by stamps, from after one time since its start up to another."""
    imu, poses, start = log.imu, log.object_poses[""], int(log.imu.stamps_ns[0])
    arrivals = [(int(t), 1, i) for i, t in enumerate(imu.stamps_ns)]
    arrivals += [(int(t), 0, int(t)) for t in np.unique(poses.stamps_ns)]
    for t, is_sample, which in sorted(arrivals):
        if t > start + until_s * 1e9:
            break
        if t <= start + since_s * 1e9:
            continue
        if is_sample:
            estimator.feed_imu(stamp(t), imu.angular_velocity[which], imu.specific_force[which])
            continue
        seen = poses[poses.stamps_ns == which]
        R = None if covariance is None else np.tile(covariance, (len(seen), 1, 1))
        T = seen.T_cam_obj
        estimator.feed_object_poses(stamp(t), seen.object_ids, T.translation, T.rotation.as_quat(), R)


def error_m(estimator, log, shift_ns=0):
    state = estimator.state()
    truth, _ = log.T_world_imu.interpolate(np.array([state.stamp_ns - shift_ns]))
    return np.linalg.norm(state.position - truth.translation[0])


@BOTH
@pytest.mark.parametrize("unit_ns", [1_000, 1_000_000, SECOND_NS])
def test_stamps_in_another_unit_are_refused(kind, unit_ns, log):
    with pytest.raises(InputError, match="nanoseconds"):
        replay(new(kind, log), log, stamp=lambda ns: ns // unit_ns)


@BOTH
def test_stamps_may_be_counted_from_after_the_beginning(kind, log):
    shift, estimator = -int(log.imu.stamps_ns[-1]), new(kind, log)
    replay(estimator, log, stamp=lambda ns: ns + shift)
    assert error_m(estimator, log, shift) < 0.1


@BOTH
def test_a_clock_that_is_set_back_begins_anew(kind, log):
    estimator = new(kind, log)
    replay(estimator, log, until_s=4.0)
    assert estimator.health().clock_jumps == 0
    back = -100 * SECOND_NS
    replay(estimator, log, stamp=lambda ns: ns + back)
    assert estimator.state().stamp_ns == log.imu.stamps_ns[-1] + back
    assert error_m(estimator, log, back) < 0.05
    assert estimator.health().clock_jumps == 1
    estimator.reset()
    assert estimator.health().clock_jumps == 0


@BOTH
def test_one_stamp_far_ahead_does_not_end_the_flight(kind, log):
    estimator = new(kind, log)
    replay(estimator, log, until_s=1.0)
    imu = log.imu
    estimator.feed_imu(int(imu.stamps_ns[100]) + 86_400 * SECOND_NS, imu.angular_velocity[100], imu.specific_force[100])
    replay(estimator, log)
    assert estimator.state().stamp_ns == imu.stamps_ns[-1]
    assert error_m(estimator, log) < 0.05


@BOTH
def test_the_stamp_of_a_broken_sample_says_nothing_of_the_clock(kind, log):
    estimator, ahead = new(kind, log), int(log.imu.stamps_ns[0]) + 6 * SECOND_NS
    replay(estimator, log, until_s=4.0)
    estimator.feed_imu(ahead, np.full(3, np.nan), log.imu.specific_force[0])
    replay(estimator, log, since_s=4.0)
    assert estimator.health().clock_jumps == 0
    assert estimator.health().malformed == 1
    assert error_m(estimator, log) < 0.05


def test_late_samples_among_others_are_no_set_clock():
    problem, options = simulated(noise="white"), FuseOptions()
    estimator, imu, late = estimator_for(problem, options), problem.imu, 0
    for event in events(problem):
        feed(estimator, problem, event)
        if event[1] == 1 and event[2] > 100:
            estimator.feed_imu(imu.stamps_ns[event[2] - 100], imu.angular_velocity[0], imu.specific_force[0])
            late += 1
    health = estimator.health()
    assert health.too_late == late > 300
    assert health.clock_jumps == 0


@BOTH
def test_arrays_of_another_shape_are_refused_and_not_read_across(kind, log):
    """Positions as the columns of a matrix have as many numbers as positions as its rows."""
    estimator, ids = new(kind, log), [1, 2]
    t, q = np.array([[0.1, 0.2, 1.0], [0.3, 0.1, 0.9]]), np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    with pytest.raises(ValueError, match=r"positions.*\(2, 3\).*\(3, 2\)"):
        estimator.feed_object_poses(0, ids, t.T, q)
    with pytest.raises(ValueError, match=r"q_xyzw.*\(2, 4\).*\(4, 2\)"):
        estimator.feed_object_poses(0, ids, t, q.T)
    with pytest.raises(ValueError, match=r"instances.*\(2,\).*\(1,\)"):
        estimator.feed_object_poses(0, ids, t, q, instances=[0])
    with pytest.raises(ValueError, match=r"covariances.*\(2, 6, 6\).*\(6, 6\)"):
        estimator.feed_object_poses(0, ids, t, q, np.eye(6))
    with pytest.raises(ValueError, match=r"angular_velocity.*\(3,\)"):
        estimator.feed_imu(0, 0.0, [0.0, 0.0, 9.81])
    with pytest.raises(ValueError, match=r"specific_force.*\(3,\)"):
        estimator.feed_imu(0, [0.0, 0.0, 0.0], [[0.0, 0.0, 9.81]])
    for wrong in ([1.7, 2.0], ["a", "b"], [[1, 2]], [np.nan, 1.0]):
        with pytest.raises(ValueError, match="object_ids must be whole numbers"):
            estimator.feed_object_poses(0, wrong, t, q)
    assert estimator.health().waiting == 0
    estimator.feed_object_poses(0, np.array([1.0, 2.0]), t, q)
    assert estimator.health().waiting == 2


@BOTH
def test_one_object_and_none_need_no_second_dimension(kind, log):
    estimator = new(kind, log)
    estimator.feed_object_poses(0, 1, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0], np.eye(6))
    estimator.feed_object_poses(1, [], [], [])
    assert estimator.health().waiting == 1


@BOTH
@pytest.mark.parametrize("wrong", [-np.eye(6), np.zeros((6, 6)), np.eye(6) - np.ones((6, 6))])
def test_what_is_no_covariance_is_counted_and_not_believed(kind, wrong, log):
    estimator = new(kind, log)
    replay(estimator, log, covariance=1e-4 * wrong)
    health = estimator.health()
    assert estimator.state() is None
    assert health.malformed + health.not_in_map == len(log.object_poses[""])
    camera = kind(log.calibration, None, FuseOptions(measurements="camera"))
    camera.feed_camera_pose(0, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0], wrong)
    assert (camera.health().malformed, camera.health().waiting) == (1, 0)


@BOTH
def test_object_poses_are_refused_where_camera_poses_are_fused(kind, log):
    estimator = new(kind, log, FuseOptions(measurements="camera"))
    with pytest.raises(InputError, match="measurements"):
        estimator.feed_object_poses(0, [1], [[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0, 1.0]])


@BOTH
def test_what_was_found_beside_the_trajectory_can_be_asked_for(kind):
    """Of the map that is being estimated, and the camera's clock: with the truth within 4 sigma."""
    log = simulate(SimulationOptions(duration_s=12.0, imu_rate_hz=100.0, objects=3, stamp_delay_s=0.02, noise="white"))
    assert new(kind, log).calibrated() is None
    estimator = new(kind, log, FuseOptions(estimate=Estimate(time_offset=True, map="approximate")))
    replay(estimator, log)
    found = estimator.calibrated()
    assert abs(found.timeshift_cam_imu_s + 0.02) < 4.0 * found.timeshift_sigma_s < 0.015
    assert [landmark.key for landmark in found.landmark_map] == [landmark.key for landmark in log.landmark_map]


def test_an_estimator_that_is_not_there_online_is_not_replaced_by_another(log):
    for kind, options in (
        (Estimator, FuseOptions(estimator="graph")),
        (Estimator, FuseOptions(smooth=True)),
        (GraphEstimator, FuseOptions(estimator="batch")),
    ):
        with pytest.raises(InputError, match="GraphEstimator"):
            new(kind, log, options)
    assert new(GraphEstimator, log, FuseOptions(estimator="graph")).options.estimator == "graph"


@pytest.mark.parametrize("again", [copy.deepcopy, lambda estimator: pickle.loads(pickle.dumps(estimator))])
def test_a_copy_of_a_filter_goes_on_by_itself(again, log):
    estimator = new(Estimator, log)
    replay(estimator, log, until_s=3.0)
    before = estimator.state()
    other = again(estimator)
    assert other.state().stamp_ns == before.stamp_ns
    replay(other, log)
    assert other.state().stamp_ns == log.imu.stamps_ns[-1]
    np.testing.assert_array_equal(estimator.state().position, before.position)
    replay(estimator, log)
    np.testing.assert_array_equal(estimator.state().position, other.state().position)


def test_a_copy_of_a_graph_is_refused(log):
    with pytest.raises(TypeError, match="cannot be copied"):
        copy.deepcopy(new(GraphEstimator, log))


@BOTH
def test_a_landmark_seen_twice_at_a_stamp_counts_twice_and_the_same_pose_once(kind, log):
    estimator, poses = new(kind, log), log.object_poses[""]
    start = int(poses.stamps_ns[0])
    samples = log.imu[log.imu.stamps_ns >= start]
    estimator.feed_imu(start, samples.angular_velocity[0], samples.specific_force[0])
    seen = poses[(poses.stamps_ns == start) & (poses.object_ids == poses.object_ids[0])]
    position, q = seen.T_cam_obj.translation, seen.T_cam_obj.rotation.as_quat()
    for t in (position, position + 0.01, position, position + 0.01):
        estimator.feed_object_poses(start, seen.object_ids, t, q)
    assert estimator.health().too_late == 0  # although the first sample is of that stamp
    assert estimator.health().duplicates == 2


@BOTH
def test_odometry_that_is_not_finite_is_counted_and_of_another_shape_refused(kind, log):
    estimator = new(kind, log, FuseOptions(motion="imu+odometry"))
    start, at_rest = int(log.imu.stamps_ns[0]), [0.0, 0.0, 0.0, 1.0]
    estimator.feed_imu(start, log.imu.angular_velocity[0], log.imu.specific_force[0])
    estimator.feed_odometry(start, [0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0])
    estimator.feed_odometry(start, [np.nan, 0.0, 0.0], at_rest)
    assert estimator.health().malformed == 2
    with pytest.raises(ValueError, match="zero"):
        estimator.feed_odometry(start, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0])
    for position, q in (([0.0, 0.0], at_rest), ([0.0, 0.0, 0.0], at_rest[:3])):
        with pytest.raises(ValueError, match="must have the shape"):
            estimator.feed_odometry(start, position, q)
    estimator.feed_odometry(start, [0.0, 0.0, 0.0], at_rest)
    assert estimator.health().malformed == 2


@BOTH
def test_an_unknown_map_of_symmetric_objects_alone_is_refused_as_on_a_whole_log(kind):
    log = simulate(SimulationOptions(duration_s=2.0, objects=2, symmetric_objects=2))
    with pytest.raises(InputError, match="none can anchor the world"):
        new(kind, log, FuseOptions(estimate=Estimate(map="unknown")))


@BOTH
def test_a_log_without_calibration_is_told_what_is_missing(kind):
    with pytest.raises(InputError, match="T_cam_imu and the IMU's noise densities"):
        kind(None, None, FuseOptions(estimator=kind._estimator, measurements="camera"))


@BOTH
def test_shapes_are_told_as_they_are_documented(kind, log):
    estimator = kind(log.calibration, None, FuseOptions(estimator=kind._estimator, measurements="camera"))
    with pytest.raises(ValueError, match=r"position must have the shape \(3,\), not \(2,\)"):
        estimator.feed_camera_pose(1, [0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match=r"covariance must have the shape \(6, 6\), not \(3, 3\)"):
        estimator.feed_camera_pose(1, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], np.eye(3))
