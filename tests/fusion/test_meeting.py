"""Objects of an unknown map that are first seen flipped or elsewhere end where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filter_runs import assert_same, run
from scipy.spatial.transform import RigidTransform, Rotation
from test_online import assert_ends_like, estimator_for, feed, shuffled

from fusion import filter_loop, memory, reference_filter
from fusion.fuse import fuse
from fusion.online_input import OnlineOptions
from fusion.options import DetectionBias, Estimate, FuseOptions, Meeting
from fusion.prepare import Problem, pose_problem
from fusion.simulate import SimulationOptions, simulate
from fusion.smoother import run_smoother
from poet_loc.core.geometry import local
from poet_loc.core.records import LandmarkMap
from poet_loc.io.log_folder import Log

SECOND = 1_000_000_000
OPTIONS = FuseOptions(estimate=Estimate(map="unknown"), bias=DetectionBias(use=False))
TRUSTING = replace(OPTIONS, meeting=Meeting(min_poses=1, min_span_s=0.0, replace=False))
HALF_TURN = RigidTransform.from_exp_coords([0.0, 0.0, np.pi, 0.0, 0.0, 0.0])


def table(seed: int = 4, symmetric_objects: int = 0, **others) -> Log:
    wanted = {"duration_s": 16.0, "imu_rate_hz": 100.0, "camera_rate_hz": 15.0, "noise": "white", "objects": 4}
    return simulate(SimulationOptions(seed=seed, symmetric_objects=symmetric_objects, **(wanted | others)))


def upright(log: Log) -> Log:
    """Return the log in which objects stand, so that a half turn about their z is one about the vertical."""
    stand = tuple(
        replace(each, T_world_obj=RigidTransform.from_translation(each.T_world_obj.translation))
        for each in log.landmark_map
    )
    poses, ids = log.object_poses[""], log.landmark_map.object_ids
    at = np.searchsorted(ids, poses.object_ids)
    turned = log.landmark_map.T_world_obj[at].inv() * LandmarkMap(stand).T_world_obj[at]
    poses = replace(poses, T_cam_obj=poses.T_cam_obj * turned)
    return replace(log, landmark_map=LandmarkMap(stand), object_poses={"": poses})


def wrong_for(log: Log, object_id: int, seconds: float, error: RigidTransform = HALF_TURN, share: float = 1.0) -> Log:
    """Return the log in which an object's detections within so many seconds of its first one are wrong."""
    poses = log.object_poses[""]
    own = np.flatnonzero(poses.object_ids == object_id)
    own = own[poses.stamps_ns[own] < poses.stamps_ns[own[0]] + seconds * SECOND]
    own = own[np.random.default_rng(0).random(len(own)) < share]
    shown = poses.T_cam_obj.as_matrix()
    shown[own] = shown[own] @ error.as_matrix()
    return replace(log, object_poses={"": replace(poses, T_cam_obj=RigidTransform.from_matrix(shown))})


def map_errors(log: Log, options: FuseOptions) -> dict[int, tuple[float, float]]:
    """Return per object the errors of the map that was found: angle (deg) and distance (m)."""
    found = fuse(log, options).calibrated.landmark_map
    true = {mark.object_id: mark.T_world_obj for mark in log.landmark_map}
    errors = {mark.object_id: local(true[mark.object_id], mark.T_world_obj) for mark in found}
    return {k: (float(np.degrees(np.linalg.norm(e[:3]))), float(np.linalg.norm(e[3:]))) for k, e in errors.items()}


def problem_of(log: Log, options: FuseOptions = OPTIONS) -> Problem:
    return pose_problem(log, options)


@pytest.mark.parametrize("seconds", [0.7, 1.8])
@pytest.mark.parametrize("error", [HALF_TURN, RigidTransform.from_translation([0.3, 0.1, 0.0])])
def test_an_object_first_seen_wrong_ends_where_it_is(seconds, error):
    log = wrong_for(table(), 3, seconds, error)
    turn, distance = map_errors(log, OPTIONS)[3]
    assert turn < 1.0
    assert distance < 0.015
    turn, distance = map_errors(log, TRUSTING)[3]
    assert turn > 90.0 or distance > 0.1


def test_an_object_is_put_nowhere_until_detections_agree():
    """Each of the first detections is somewhere else: none of them is used."""
    log = table()
    poses, rng = log.object_poses[""], np.random.default_rng(1)
    own = np.flatnonzero(poses.object_ids == 2)[:30]
    shown = poses.T_cam_obj.as_matrix()
    shown[own, :3, :3] = Rotation.random(len(own), rng=rng).as_matrix()
    log = replace(log, object_poses={"": replace(poses, T_cam_obj=RigidTransform.from_matrix(shown))})
    result = fuse(log, OPTIONS)
    gate = result.gate
    mine = gate.object_ids == 2
    until = poses.stamps_ns[own[-1]]
    assert not gate.position_accepted[mine & (gate.stamps_ns <= until)].any()
    assert gate.position_accepted[mine & (gate.stamps_ns > until + SECOND)].mean() > 0.9
    assert map_errors(log, OPTIONS)[2][0] < 1.0


def test_a_lasting_minority_of_wrong_detections_moves_nothing():
    log = wrong_for(table(), 3, 100.0, share=0.35)
    result = run(filter_loop.run_log, problem_of(log), OPTIONS)
    assert result.memory.counters[memory.REPLACED] == 0
    assert map_errors(log, OPTIONS)[3][0] < 1.0


def test_a_world_anchored_at_a_flipped_object_is_turned_round():
    log = wrong_for(upright(table()), 1, 2.0)
    problem = problem_of(log)
    assert problem.measurements.objects[0] == 0
    result = fuse(log, OPTIONS)
    assert result.restarts == 1
    truth = log.T_world_imu.between(int(log.imu.stamps_ns[0]) + 8 * SECOND, int(result.stamps_ns[-1]))
    estimate, _ = result.trajectory.interpolate(truth.stamps_ns)
    error = np.linalg.norm(estimate.translation - truth.T_world_body.translation, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert all(turn < 1.5 for turn, _ in map_errors(log, OPTIONS).values())
    lasting = fuse(log, replace(OPTIONS, meeting=Meeting(replace=False)))
    estimate, _ = lasting.trajectory.interpolate(truth.stamps_ns)
    assert np.linalg.norm(estimate.translation - truth.T_world_body.translation, axis=1).mean() > 0.3


def test_look_alikes_of_a_symmetric_object_support_one_pose():
    log = table(symmetric_objects=2)
    poses, rng = log.object_poses[""], np.random.default_rng(2)
    turns = rng.integers(0, 2, len(poses)) * np.pi
    symmetric = {mark.object_id: mark.symmetry for mark in log.landmark_map}
    shown = poses.T_cam_obj.as_matrix()
    for row, k in enumerate(poses.object_ids):
        if symmetric[k] is not None:
            angle = turns[row] if symmetric[k].order == 2 else rng.uniform(-np.pi, np.pi)
            shown[row, :3, :3] = shown[row, :3, :3] @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    log = replace(log, object_poses={"": replace(poses, T_cam_obj=RigidTransform.from_matrix(shown))})
    found = fuse(log, OPTIONS)
    settled = found.gate.stamps_ns > found.stamps_ns[0] + SECOND
    assert found.gate.rotation_accepted[settled].mean() > 0.97
    for mark in found.calibrated.landmark_map:
        true = next(each for each in log.landmark_map if each.key == mark.key).T_world_obj
        off = true.rotation.inv() * mark.T_world_obj.rotation
        if symmetric[mark.object_id] is not None:  # the axis, up to its turns
            off = Rotation.from_rotvec(np.cross([0.0, 0.0, 1.0], off.apply([0.0, 0.0, 1.0])))
        assert np.degrees(off.magnitude()) < 1.5


@pytest.mark.parametrize("object_id", [1, 3])
def test_compiled_is_plain_where_objects_are_put_elsewhere(object_id):
    log = wrong_for(upright(table(duration_s=7.0, imu_rate_hz=50.0)), object_id, 1.2)
    problem = problem_of(log)
    compiled, plain = (run(loop, problem, OPTIONS) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert compiled.memory.counters[memory.RESTARTS if object_id == 1 else memory.REPLACED] == 1
    assert_same(compiled, plain, 1e-8)
    np.testing.assert_allclose(compiled.memory.supposed, plain.memory.supposed, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("object_id", [1, 3])
def test_shuffled_input_gives_the_in_order_result_and_map(object_id):
    problem = problem_of(wrong_for(upright(table(duration_s=7.0)), object_id, 1.2))
    estimator = estimator_for(problem, OPTIONS, OnlineOptions(horizon_s=0.6))
    for event in shuffled(problem, 0.6, np.random.default_rng(5)):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, OPTIONS)
    whole = run(filter_loop.run_log, problem, OPTIONS).memory
    np.testing.assert_allclose(estimator.memory.supposed, whole.supposed, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(estimator.memory.known, whole.known)


def test_smoother_and_graph_go_over_a_replacement():
    log = wrong_for(table(duration_s=10.0), 3, 1.2)
    smoothed = run_smoother(problem_of(log), OPTIONS)
    truth = log.T_world_imu.between(int(smoothed.stamps_ns[0]), int(smoothed.stamps_ns[-1]))
    estimate, _ = smoothed.trajectory.interpolate(truth.stamps_ns)
    assert np.sqrt(np.mean((estimate.translation - truth.T_world_body.translation) ** 2)) < 0.02
    assert np.isfinite(smoothed.pose_covariances).all()
    for estimator in ("graph", "batch"):
        turn, distance = map_errors(log, replace(OPTIONS, estimator=estimator))[3]
        assert turn < 1.0
        assert distance < 0.015


@pytest.mark.parametrize("smooth", [False, True])
def test_a_filter_that_gave_up_is_no_surer_of_the_objects_that_it_had_found(smooth):
    """Nothing is seen for ten seconds, and without IMU and odometry the filter then starts anew."""
    log = simulate(SimulationOptions(duration_s=30.0, objects=4, symmetric_objects=0, seed=1))
    poses, truth = log.object_poses[""], log.landmark_map
    seconds = (poses.stamps_ns - poses.stamps_ns[0]) * 1e-9
    poses = poses[(seconds < 8.0) | (seconds > 20.0)]
    log = replace(log, imu=None, calibration=None, object_poses={"": poses})
    result = fuse(log, FuseOptions(estimate=Estimate(map="unknown"), smooth=smooth))
    assert result.restarts > 0
    found = result.calibrated.landmark_map
    assert len(found) == 4
    for landmark, true in list(zip(found, truth, strict=True))[1:]:  # the first is the anchor
        error = landmark.T_world_obj.translation - true.T_world_obj.translation
        sigma = np.sqrt(np.diag(landmark.covariance)[3:].max())
        assert 0.005 < sigma < 0.05
        assert np.linalg.norm(error) < 3.0 * sigma
