"""Starting where single votes do not do: symmetric objects only, rotations that are wrong, poses that are ambiguous."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filter_runs import assert_same, run
from scipy.spatial.transform import RigidTransform, Rotation
from test_online import assert_ends_like, estimator_for, feed, shuffled

from fusion import filter_loop, reference_filter
from fusion.fuse import fuse
from fusion.options import DetectionBias, FuseOptions
from fusion.prepare import pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import LandmarkMap, Symmetry
from poet_loc.io.log_folder import Log

OPTIONS = FuseOptions(bias=DetectionBias(use=False))
CAN, BOX = Symmetry((0.0, 0.0, 1.0), "continuous"), Symmetry((0.0, 0.0, 1.0), 2)
LYING = Rotation.from_euler("X", 90.0, degrees=True)


def table(symmetries: list[Symmetry | None], lying: bool = False, seed: int = 3, **others) -> Log:
    """Return a log of objects with these symmetries, all standing or all lying, seen turned by any of them."""
    wanted = {"duration_s": 6.0, "imu_rate_hz": 100.0, "camera_rate_hz": 15.0, "noise": "white", "rest_s": 0.0}
    log = simulate(SimulationOptions(seed=seed, objects=len(symmetries), symmetric_objects=0, **(wanted | others)))
    marks = []
    for mark, symmetry in zip(log.landmark_map, symmetries):
        T_world_obj = mark.T_world_obj
        x_axis = T_world_obj.rotation.as_matrix()[:, 0]
        heading = Rotation.from_euler("Z", np.arctan2(x_axis[1], x_axis[0]))
        T_world_obj = RigidTransform.from_components(T_world_obj.translation, heading * LYING if lying else heading)
        marks.append(replace(mark, symmetry=symmetry, T_world_obj=T_world_obj))
    poses, rng = log.object_poses[""], np.random.default_rng(seed)
    at = poses.object_ids - 1
    turn = rng.uniform(-np.pi, np.pi, len(poses))
    own = np.array([0.0 if each is None else np.nan if each is CAN else np.pi for each in symmetries])[at]
    turn = np.where(np.isnan(own), turn, own * rng.integers(0, 2, len(poses)))
    spin = Rotation.from_rotvec(turn[:, None] * [0.0, 0.0, 1.0])
    moved = log.landmark_map.T_world_obj[at].inv() * LandmarkMap(tuple(marks)).T_world_obj[at]
    shown = poses.T_cam_obj * moved * RigidTransform.from_rotation(spin)
    return replace(log, landmark_map=LandmarkMap(tuple(marks)), object_poses={"": replace(poses, T_cam_obj=shown)})


def turned(log: Log, degrees: float, share: float = 1.0, seed: int = 0) -> Log:
    """Return the log in which each object's detections are turned by so much about an axis of its own."""
    poses, rng = log.object_poses[""], np.random.default_rng(seed)
    axes = rng.standard_normal((20, 3))
    axes *= np.radians(degrees) / np.linalg.norm(axes, axis=1, keepdims=True)
    wrong = Rotation.from_rotvec(axes[poses.object_ids] * (rng.random(len(poses)) < share)[:, None])
    T_cam_obj = RigidTransform.from_components(poses.T_cam_obj.translation, wrong * poses.T_cam_obj.rotation)
    return replace(log, object_poses={"": replace(poses, T_cam_obj=T_cam_obj)})


def start_of(log: Log, options: FuseOptions = OPTIONS) -> tuple[float, float, float]:
    """Return when the filter starts (s), and the errors of its first second: position (m) and angle (deg)."""
    result = fuse(log, options)
    began = int(result.stamps_ns[0])
    truth = log.T_world_imu.between(began, began + 1_000_000_000)
    estimate, _ = result.trajectory.interpolate(truth.stamps_ns)
    away = np.linalg.norm(estimate.translation - truth.T_world_body.translation, axis=1)
    off = (estimate.rotation.inv() * truth.T_world_body.rotation).magnitude()
    return (began - int(log.imu.stamps_ns[0])) * 1e-9, float(away.mean()), float(np.degrees(off.mean()))


@pytest.mark.parametrize(
    ("symmetries", "lying"),
    [
        ([CAN, CAN], False),
        ([CAN] * 4, False),
        ([CAN], True),
        ([CAN, CAN], True),
        ([BOX] * 3, False),
        ([CAN, BOX], False),
    ],
)
def test_symmetric_objects_alone_start_the_filter(symmetries, lying):
    when, distance, angle = start_of(table(symmetries, lying))
    assert when < 1.5
    assert distance < 0.1
    assert angle < 6.0


@pytest.mark.parametrize(("symmetries", "lying"), [([CAN], False), ([BOX], False)])
def test_nothing_is_published_where_the_pose_is_ambiguous(symmetries, lying):
    with pytest.raises(InputError, match="never started"):
        fuse(table(symmetries, lying), OPTIONS)


def test_a_box_that_lies_is_told_from_its_half_turn_by_gravity():
    when, distance, angle = start_of(tilted(table([None])))
    assert when < 1.5
    assert distance < 0.1
    assert angle < 6.0


def tilted(log: Log) -> Log:
    """Return the log in which the objects' z axes are level, so that a half turn about them stands on its head."""
    turn = RigidTransform.from_rotation(Rotation.from_euler("Y", 90.0, degrees=True))
    marks = tuple(replace(mark, T_world_obj=mark.T_world_obj * turn, symmetry=BOX) for mark in log.landmark_map)
    poses = log.object_poses[""]
    half = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, np.pi]))
    shown = (poses.T_cam_obj * turn).as_matrix()
    odd = np.random.default_rng(1).random(len(poses)) < 0.5
    shown[odd] = shown[odd] @ half.as_matrix()
    return replace(
        log,
        landmark_map=LandmarkMap(marks),
        object_poses={"": replace(poses, T_cam_obj=RigidTransform.from_matrix(shown))},
    )


def test_places_start_the_filter_where_rotations_are_wrong():
    log = turned(table([None] * 5), 25.0)
    when, distance, angle = start_of(log)
    assert when < 1.0
    assert distance < 0.1
    assert angle < 6.0
    votes_only = replace(OPTIONS, start=replace(OPTIONS.start, min_objects=10))
    with pytest.raises(InputError, match="never started"):
        fuse(log, votes_only)


def test_two_objects_that_agree_whole_need_no_span_and_one_does():
    patient = replace(OPTIONS, start=replace(OPTIONS.start, min_span_s=0.8))
    when, distance, angle = start_of(table([None, None]), patient)
    assert when < 0.5
    assert distance < 0.1
    assert angle < 6.0
    assert start_of(table([None]), patient)[0] >= 0.8
    turned_apart = turned(table([None, None]), 25.0)  # each is alone with what it says
    with pytest.raises(InputError, match="never started"):
        fuse(turned_apart, patient)


@pytest.mark.parametrize("rate_hz", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_slow_sensor_that_sees_one_object_starts_the_filter(rate_hz, seed):
    """What the IMU integrates from a level guess holds for two or three seconds, not until the seventh vote."""
    began, away, _ = start_of(table([None], camera_rate_hz=rate_hz, duration_s=15.0, seed=seed))
    assert began < 3.5 / rate_hz + 1.0
    assert away < 0.3


@pytest.mark.parametrize("rate_hz", [2.0, 15.0])
def test_votes_that_agree_by_chance_start_nothing(rate_hz):
    """Each detection of one object shows it somewhere else, turned at random."""
    for seed in range(5):
        log, rng = table([None], camera_rate_hz=rate_hz, duration_s=40.0, seed=seed), np.random.default_rng(seed)
        poses = log.object_poses[""]
        anywhere = rng.uniform([-0.4, -0.3, 0.6], [0.4, 0.3, 2.0], (len(poses), 3))
        T_cam_obj = make_pose(Rotation.random(len(poses), rng), anywhere)
        with pytest.raises(InputError, match="never started"):
            fuse(replace(log, object_poses={"": replace(poses, T_cam_obj=T_cam_obj)}), OPTIONS)


def test_one_object_of_which_every_other_detection_is_flipped_starts_nothing():
    log = table([None])
    poses = log.object_poses[""]
    shown = poses.T_cam_obj.as_matrix()
    half = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, np.pi])).as_matrix()
    shown[::2] = shown[::2] @ half
    log = replace(log, object_poses={"": replace(poses, T_cam_obj=RigidTransform.from_matrix(shown))})
    with pytest.raises(InputError, match="never started"):
        fuse(log, OPTIONS)


def at_the_first_detection(log: Log, shift: float = 0.0) -> FuseOptions:
    """Return options that start at the true pose of the first detection, moved along x by so many metres."""
    first = int(log.object_poses[""].stamps_ns[0])
    truth, _ = log.T_world_imu.interpolate(np.array([first]))
    pose = (*truth.translation[0] + [shift, 0.0, 0.0], *truth.rotation.as_quat()[0])
    return replace(OPTIONS, start=replace(OPTIONS.start, pose=pose), prior=replace(OPTIONS.prior, velocity=1.0))


@pytest.mark.parametrize("estimator", ["eskf", "graph"])
def test_a_given_pose_starts_the_filter_where_votes_are_ambiguous(estimator):
    log = table([CAN])
    with pytest.raises(InputError, match=r"never started.*start\.pose"):
        fuse(log, OPTIONS)
    options = replace(at_the_first_detection(log), estimator=estimator)
    when, distance, angle = start_of(log, options)
    first, began = int(log.object_poses[""].stamps_ns[0]), int(log.imu.stamps_ns[0])
    assert when == pytest.approx((first - began) * 1e-9, abs=1e-9)
    assert distance < 0.02
    assert angle < 3.0


def test_a_wrong_given_pose_is_left_for_what_the_detections_say():
    log = table([None] * 3)
    result = fuse(log, at_the_first_detection(log, shift=3.0))
    estimate, _ = result.trajectory.interpolate(log.T_world_imu.stamps_ns[-50:])
    off = np.linalg.norm(estimate.translation - log.T_world_imu.T_world_body.translation[-50:], axis=1)
    assert result.restarts == 1
    assert off.max() < 0.05


@pytest.mark.parametrize("tilt_deg", [90.0, 170.0])
def test_a_filter_whose_attitude_is_far_off_gravity_starts_again(tilt_deg):
    log = table([None] * 3, duration_s=8.0)
    options = at_the_first_detection(log)
    pose = options.start.pose
    upset = Rotation.from_euler("x", tilt_deg, degrees=True) * Rotation.from_quat(pose[3:])
    result = fuse(log, replace(options, start=replace(options.start, pose=(*pose[:3], *upset.as_quat()))))
    estimate, _ = result.trajectory.interpolate(log.T_world_imu.stamps_ns[-50:])
    truth = log.T_world_imu.T_world_body[-50:]
    assert result.restarts >= 1
    assert np.linalg.norm(estimate.translation - truth.translation, axis=1).max() < 0.1
    assert np.degrees((estimate.rotation.inv() * truth.rotation).magnitude()).max() < 5.0


@pytest.mark.parametrize("pose", [(0.0, 0.0, np.nan, 0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)])
def test_a_given_pose_that_is_none_is_refused(pose):
    with pytest.raises(InputError, match=r"start\.pose"):
        replace(OPTIONS.start, pose=pose)


def test_a_given_pose_and_an_unknown_map_exclude_each_other():
    log = table([None] * 3)
    options = at_the_first_detection(log)
    with pytest.raises(InputError, match="first object is what makes the world"):
        fuse(log, replace(options, estimate=replace(options.estimate, map="unknown")))


def test_flips_soon_after_the_start_do_not_move_the_filter():
    """A flipped box also seems to stand aside, and the gate of an unsure state is wide."""
    log = table([None])
    poses = log.object_poses[""]
    shown = poses.T_cam_obj.as_matrix()
    half = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, np.pi])).as_matrix()
    shown[1:4] = shown[1:4] @ half
    shown[1:4, :3, 3] += [0.06, 0.0, 0.0]
    log = replace(log, object_poses={"": replace(poses, T_cam_obj=RigidTransform.from_matrix(shown))})
    used = fuse(log, at_the_first_detection(log)).gate.position_accepted
    assert not used[1:4].any()
    assert used[4:12].all()


def test_a_gross_error_right_after_the_start_does_not_win_the_state():
    """The poses of the start's own stamp are taken in, so that the gate is theirs when the next one comes."""
    log = table([None], camera_rate_hz=30.0)
    began = int(fuse(log, OPTIONS).stamps_ns[0])
    poses = log.object_poses[""]
    next_one = np.searchsorted(poses.stamps_ns, began, side="right")
    shown = poses.T_cam_obj.translation
    shown[next_one] *= 1.0 + 0.3 / np.linalg.norm(shown[next_one])
    log = replace(log, object_poses={"": replace(poses, T_cam_obj=make_pose(poses.T_cam_obj.rotation, shown))})
    result = fuse(log, OPTIONS)
    used = result.gate.position_accepted
    assert result.stamps_ns[0] == began
    assert result.gate.stamps_ns[next_one - 1] == began
    assert used[next_one - 1]
    assert not used[next_one]
    assert used[next_one + 1 : next_one + 11].all()


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("log", [table([CAN, CAN, BOX]), turned(table([None] * 4), 25.0)])
def test_compiled_is_plain_and_shuffled_is_in_order(log, given):
    options = at_the_first_detection(log) if given else OPTIONS
    problem = pose_problem(log, options)
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain, 1e-8)
    estimator = estimator_for(problem, options)
    for event in shuffled(problem, 0.3, np.random.default_rng(0)):
        feed(estimator, problem, event)
    assert_ends_like(estimator, problem, options)


@pytest.mark.parametrize("motion", ["imu", "odometry", "imu+odometry", "constant-velocity"])
def test_detections_none_of_which_can_be_used_are_told(motion):
    log = simulate(SimulationOptions(duration_s=2.0, objects=3, odometry=True))
    poses = log.object_poses[""]
    behind = make_pose(poses.T_cam_obj.rotation, poses.T_cam_obj.translation * [1.0, 1.0, -1.0])
    for useless in (poses[:0], replace(poses, T_cam_obj=behind), replace(poses, object_ids=poses.object_ids + 100)):
        with pytest.raises(InputError, match=f"none of {len(useless)} detections"):
            fuse(replace(log, object_poses={"": useless}), FuseOptions(motion=motion))


@pytest.mark.parametrize("degrees", [360.0, 500.0])
def test_votes_that_may_be_turned_anyhow_agree_by_their_places(degrees):
    options = replace(OPTIONS, start=replace(OPTIONS.start, max_angle_deg=degrees))
    half_a_turn = replace(OPTIONS, start=replace(OPTIONS.start, max_angle_deg=180.0))
    log = table([None, None])
    np.testing.assert_array_equal(fuse(log, options).stamps_ns, fuse(log, half_a_turn).stamps_ns)


def test_an_angle_too_small_for_any_votes_to_agree_ends_in_one_line():
    with pytest.raises(InputError, match="never started"):
        fuse(table([None]), replace(OPTIONS, start=replace(OPTIONS.start, max_angle_deg=1e-9)))
