"""The graph fed sample by sample, in order and out of it, against the graph on the whole log."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from filter_runs import simulated
from scipy.spatial.transform import Rotation
from test_online import stated_for

from fusion.graph import run_graph
from fusion.graph_online import GraphEstimator
from fusion.measurements import CAMERA_POSE, Measurements
from fusion.online_input import OnlineOptions
from fusion.options import DetectionBias, Estimate, FuseOptions, Graph

OPTIONS = FuseOptions(estimator="graph", graph=Graph(lag_s=0.8))


class Feed:
    """A problem's samples and poses, given to an estimator in any order of arrival."""

    def __init__(self, problem, options, **online):
        self.problem, self.layout = problem, problem.layout
        self.estimator = GraphEstimator(
            problem.calibration, problem.landmark_map, options, OnlineOptions(**online), problem.layout
        )

    def sample(self, i):
        imu = self.problem.imu
        self.estimator.feed_imu(imu.stamps_ns[i], imu.angular_velocity[i], imu.specific_force[i])

    def pose(self, j):
        m = self.problem.measurements
        stamp = int(m.stamps_ns[j]) - self.problem.calibration.timeshift_ns
        q = Rotation.from_matrix(m.rotations[j].reshape(3, 3)).as_quat()
        if m.kinds[j] == CAMERA_POSE:
            self.estimator.feed_camera_pose(stamp, m.translations[j], q, m.covariances[j])
            return
        t = m.translations[j : j + 1]
        columns = t, q[None], stated_for(m.covariances[j : j + 1], t, self.estimator.options)
        object_id, instance = self.problem.keys[m.objects[j]]
        self.estimator.feed_object_poses(stamp, [object_id], *columns, instances=[instance])

    def all(self, delays_ns, states_from=np.inf):
        """Feed everything by time of arrival; return the states at the samples."""
        imu, m, states = self.problem.imu.stamps_ns, self.problem.measurements.stamps_ns, {}
        events = [(int(t), 1, i) for i, t in enumerate(imu)]
        events += [(int(t) + int(d), 0, j) for j, (t, d) in enumerate(zip(m, delays_ns, strict=True))]
        for arrival, is_sample, i in sorted(events):
            self.sample(i) if is_sample else self.pose(i)
            if is_sample and arrival >= states_from:
                states[arrival] = self.estimator.state()
        return states


def assert_same_state(state, result, tolerance):
    row = int(np.searchsorted(result.stamps_ns, state.stamp_ns))
    assert result.stamps_ns[row] == state.stamp_ns
    np.testing.assert_allclose(state.position, result.T_world_imu.translation[row], atol=tolerance)
    np.testing.assert_allclose(state.R_world_imu, result.T_world_imu.rotation[row].as_matrix(), atol=tolerance)
    np.testing.assert_allclose(state.velocity, result.velocity[row], atol=10 * tolerance)
    np.testing.assert_allclose(state.sigmas, result.sigmas[row], rtol=1e3 * tolerance)


@pytest.fixture(scope="module")
def problem():
    return simulated(options=OPTIONS)


@pytest.fixture(scope="module")
def whole(problem):
    return run_graph(problem, OPTIONS)


def test_in_order_it_is_the_graph_on_the_whole_log(problem, whole):
    feed = Feed(problem, OPTIONS)
    states = feed.all(np.zeros(len(problem.measurements)), whole.stamps_ns[0])
    assert len(states) > 300
    # the log's end is a keyframe of its own, and a state before the poses of its stamp have come does not know them
    waiting = set(problem.measurements.stamps_ns.tolist())
    checked = [s for t, s in states.items() if s is not None and t not in waiting and t < whole.stamps_ns[-1]]
    for state in checked:
        assert_same_state(state, whole, 1e-9)
    assert len(checked) > 250
    assert feed.estimator.health().too_late == 0


@pytest.mark.parametrize("seed", [0, 1])
def test_late_and_shuffled_poses_give_the_result_in_order(problem, whole, seed):
    """Each pose comes up to 0.7 s late, so that a frame's come one by one and later frames before earlier ones."""
    rng = np.random.default_rng(seed)
    stamps = problem.measurements.stamps_ns
    delays = rng.uniform(0.0, 0.7e9, len(stamps))
    last = problem.imu.stamps_ns[-2]
    delays = np.minimum(delays, np.maximum(last - stamps, 0))
    feed = Feed(problem, OPTIONS)
    states = feed.all(delays, last)
    assert feed.estimator.health().replays > 50
    assert feed.estimator.health().too_late == 0
    assert_same_state(states[last], whole, 1e-9)


def test_poses_older_than_the_lag_are_refused_and_counted(problem):
    feed = Feed(problem, OPTIONS)
    delays = np.zeros(len(problem.measurements))
    delays[150] = 2e9
    feed.all(delays)
    assert feed.estimator.health().too_late == 1
    feed.pose(len(problem.measurements) - 1)
    assert feed.estimator.health().duplicates == 1


def test_buffers_turn_over_and_nothing_grows():
    options = replace(OPTIONS, graph=Graph(lag_s=0.4))
    problem = simulated(options=options, duration_s=14.0)
    whole = run_graph(problem, options)
    feed = Feed(problem, options, ahead_s=0.1, max_imu_rate_hz=120.0, max_pose_rate_hz=50.0)
    last = problem.imu.stamps_ns[-2]
    states = feed.all(np.minimum(0.1e9, last - np.minimum(problem.measurements.stamps_ns, last)), last)
    health = feed.estimator.health()
    assert health.overflowed == health.too_late == 0
    assert len(feed.estimator._kept) < 60
    assert feed.estimator._samples < 400
    assert_same_state(states[last], whole, 1e-9)


def test_poses_with_pauses_while_buffers_turn_over():
    """Keyframes without poses, poses between keyframes, and room for four seconds of them in a log of twelve.

    Each pose has the biases' spread that the filter knew when it came, which moves with it.
    """
    scatter = DetectionBias(scatter_rotation_deg=1.0, scatter_across=0.002, scatter_along=0.01)
    options = replace(OPTIONS, bias=scatter, graph=Graph(lag_s=0.4, keyframe_rate_hz=4.0, idle_s=0.3))
    problem = simulated(options=options, duration_s=12.0)
    m = problem.measurements
    seconds = (m.stamps_ns - m.stamps_ns[0]) * 1e-9
    kept = (seconds < 2.5) | (seconds % 0.9 < 0.35)
    seen = Measurements(*(getattr(m, each.name)[kept] for each in fields(m)))
    problem = replace(problem, measurements=seen)
    feed = Feed(problem, options, ahead_s=0.1, max_pose_rate_hz=25.0, max_imu_rate_hz=70.0)
    last = problem.imu.stamps_ns[-2]
    states = feed.all(np.zeros(len(seen)), last)
    assert feed.estimator.health().overflowed == 0
    assert_same_state(states[last], run_graph(problem, options), 1e-9)


def test_an_approximate_map_and_calibration_come_out_the_same():
    options = replace(OPTIONS, estimate=Estimate(extrinsics=True, time_offset=True, map="approximate"))
    problem = simulated(options=options, symmetric_objects=0)
    whole = run_graph(problem, options)
    last = problem.imu.stamps_ns[-2]
    stamps = problem.measurements.stamps_ns
    states = Feed(problem, options).all(np.minimum(0.05e9, np.maximum(last - stamps, 0)), last)
    assert_same_state(states[last], whole, 1e-8)


@pytest.mark.parametrize("lateness_s", [0.0, 0.6])
def test_an_unknown_map_is_found_as_on_the_whole_log(lateness_s):
    """Nobody says which object anchors the world: the first that is seen does, whatever the order of arrival."""
    options = replace(OPTIONS, motion="imu", estimate=Estimate(map="unknown"))
    problem = simulated(options=options, symmetric_objects=0, noise="white")
    whole = run_graph(problem, options)
    last, stamps = problem.imu.stamps_ns[-2], problem.measurements.stamps_ns
    delays = np.random.default_rng(1).uniform(0.0, lateness_s * 1e9, len(stamps))
    feed = Feed(problem, options)
    states = feed.all(np.minimum(delays, np.maximum(last - stamps, 0)), last)
    assert feed.estimator.health().too_late == 0
    assert lateness_s == 0.0 or feed.estimator.health().replays > 50
    assert_same_state(states[last], whole, 1e-8)
    np.testing.assert_array_equal(feed.estimator.memory.known, 1.0)


@pytest.mark.parametrize("rate_hz", [15.0, 100.0])
def test_a_restart_undone_by_late_poses_leaves_no_trace(rate_hz):
    """Camera poses that jump make the filter start anew; they come late, in shreds and in the wrong order."""
    options = FuseOptions(estimator="graph", measurements="camera")
    options = replace(options, start=replace(options.start, lost_window_s=0.8, lost_min_votes=6))
    problem = simulated("camera", duration_s=8.0, seed=1, camera_rate_hz=rate_hz)
    m = problem.measurements
    later = np.arange(len(m))[:, None] >= len(m) // 2
    m = replace(m, translations=m.translations + later * [1.0, 0.5, 0.0])
    problem = replace(problem, measurements=m)
    whole = run_graph(problem, options)
    assert whole.restarts == 1
    fed = Feed(problem, options)
    fed.all(np.random.default_rng(1).uniform(0.0, 1.5e9, len(m)))
    assert fed.estimator.health().restarts == 1
    assert_same_state(fed.estimator.state(), whole, 1e-3)


def test_late_poses_give_the_result_in_order_where_factors_are_linearised_anew():
    """Biases that spread more by and by: what was seen before is linearised as it was then."""
    options = replace(OPTIONS, graph=replace(OPTIONS.graph, relinearize_every=3))
    problem = simulated(options=options, noise="network")
    m, states = problem.measurements, []
    growing = np.linspace(0.5, 4.0, len(m))[:, None, None]
    problem = replace(problem, measurements=replace(m, covariances=growing * m.covariances))
    for delays in (np.zeros(len(m)), np.random.default_rng(0).uniform(0.0, 0.5e9, len(m))):
        fed = Feed(problem, options)
        fed.all(delays)
        states.append(fed.estimator.state())
    np.testing.assert_allclose(states[0].position, states[1].position, atol=1e-6)
    np.testing.assert_allclose(states[0].sigmas, states[1].sigmas, rtol=1e-4)
