"""The solver as a whole: exact without noise, invariant, causal, the same as one frame at a time, and on long logs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from per_frame_solver import solve_per_frame
from scipy.spatial.transform import Rotation
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors, transformed

from landmarks.camera_pose import MODES, ORACLES, CameraPoseEstimates, Memory, Mode, SolverOptions, solve
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import LandmarkMap, ObjectPoses, Symmetry
from poet_loc.core.trajectory import Trajectory

SYMMETRIES = {2: Symmetry((0.0, 0.0, 1.0), 2), 3: Symmetry((0.0, 1.0, 0.0), "continuous")}
World = tuple[LandmarkMap, Trajectory, ObjectPoses]


def messy_world(seed: int, frames: int, objects: int, symmetric: bool = False) -> World:
    """A fifth of the detections are gross errors, a fifth is missing."""
    rng = np.random.default_rng(seed)
    landmarks = make_map(rng, range(1, objects + 1), SYMMETRIES if symmetric else None)
    truth = fly_around(rng, frames)
    errors = small_errors(rng, frames, objects)
    gross = rng.random((frames, objects)) < 0.2
    errors[gross] = gross_errors(rng, int(gross.sum()))
    poses = detect(truth, landmarks, errors, rng.random((frames, objects)) < 0.8)
    return landmarks, truth, ObjectPoses(**{**vars(poses), "scores": rng.uniform(0.2, 1.0, len(poses))})


def matrices(estimates: CameraPoseEstimates) -> np.ndarray:
    return estimates.camera_poses.T_world_cam.as_matrix()


def far(estimates: CameraPoseEstimates, truth: Trajectory) -> np.ndarray:
    """Distance to the truth, m."""
    true, _ = truth.interpolate(estimates.camera_poses.stamps_ns)
    return np.linalg.norm(estimates.camera_poses.T_world_cam.translation - true.translation, axis=1)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("symmetric", [False, True])
def test_without_noise_every_mode_is_exact(mode: Mode, symmetric: bool) -> None:
    rng = np.random.default_rng(0)
    landmarks = make_map(rng, range(4), SYMMETRIES if symmetric else None)
    truth = fly_around(rng, 20)
    estimates = solve(detect(truth, landmarks), landmarks, SolverOptions(mode=mode), truth)
    np.testing.assert_array_equal(estimates.camera_poses.stamps_ns, truth.stamps_ns)
    np.testing.assert_array_equal(estimates.camera_poses.frames, np.arange(20))
    np.testing.assert_allclose(matrices(estimates), truth.T_world_body.as_matrix(), atol=1e-8)
    np.testing.assert_array_equal(estimates.landmark_of_detection, np.tile(np.arange(4), 20))
    np.testing.assert_array_equal(estimates.frame_of_detection, np.repeat(np.arange(20), 4))
    assert estimates.voted.sum() == (20 if mode == "best" else 80)
    assert not estimates.held.any()
    assert np.linalg.eigvalsh(estimates.camera_poses.covariances).min() > 0.0


@pytest.mark.parametrize("mode", MODES)
def test_the_same_as_one_frame_at_a_time(mode: Mode) -> None:
    landmarks, truth, poses = messy_world(1, 30 if mode == "robust" else 60, 4)
    options = SolverOptions(mode=mode)
    plain = solve_per_frame(poses, landmarks, options, truth)
    estimates = solve(poses, landmarks, options, truth)
    np.testing.assert_allclose(matrices(estimates), plain.as_matrix(), atol=1e-5 if mode == "robust" else 1e-9)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), mode=st.sampled_from(MODES), symmetric=st.booleans())
def test_rows_in_another_order_change_nothing(seed: int, mode: Mode, symmetric: bool) -> None:
    landmarks, truth, poses = messy_world(seed, 12, 4, symmetric)
    rng = np.random.default_rng(seed)
    order = np.lexsort((rng.random(len(poses)), poses.stamps_ns))
    options = SolverOptions(mode=mode)
    one, other = solve(poses, landmarks, options, truth), solve(poses[order], landmarks, options, truth)
    np.testing.assert_array_equal(matrices(one), matrices(other))
    np.testing.assert_array_equal(one.camera_poses.covariances, other.camera_poses.covariances)
    np.testing.assert_array_equal(one.voted[order], other.voted)
    np.testing.assert_array_equal(one.landmark_of_detection[order], other.landmark_of_detection)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), mode=st.sampled_from(MODES), symmetric=st.booleans())
def test_another_world_frame_moves_the_result_and_nothing_else(seed: int, mode: Mode, symmetric: bool) -> None:
    landmarks, truth, poses = messy_world(seed, 12, 4, symmetric)
    rng = np.random.default_rng(seed)
    T = make_pose(Rotation.random(rng=rng), rng.uniform(-3, 3, 3))
    options = SolverOptions(mode=mode)
    there = Trajectory(truth.stamps_ns, T * truth.T_world_body)
    one = solve(poses, landmarks, options, truth)
    other = solve(poses, transformed(T, landmarks), options, there)
    np.testing.assert_array_equal(one.voted, other.voted)
    np.testing.assert_allclose((T * one.camera_poses.T_world_cam).as_matrix(), matrices(other), atol=1e-5)
    turn = np.eye(6)
    turn[3:, 3:] = T.rotation.as_matrix()
    moved = turn @ one.camera_poses.covariances @ turn.T
    scale = np.abs(moved).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(moved / scale, other.camera_poses.covariances / scale, atol=1e-3)


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode not in ORACLES])
@pytest.mark.parametrize("symmetric", [False, True])
def test_what_comes_later_changes_nothing(mode: Mode, symmetric: bool) -> None:
    landmarks, _, poses = messy_world(2, 60, 4, symmetric)
    whole = solve(poses, landmarks, SolverOptions(mode=mode))
    part = solve(poses[poses.frames < 35], landmarks, SolverOptions(mode=mode))
    np.testing.assert_array_equal(matrices(whole)[: len(part.camera_poses)], matrices(part))


def test_robust_is_better_than_every_mode_that_may_not_look_at_the_truth() -> None:
    landmarks, truth, poses = messy_world(3, 600, 5)
    estimates = {mode: solve(poses, landmarks, SolverOptions(mode=mode), truth) for mode in MODES}
    rmse = {mode: np.sqrt(np.mean(far(estimate, truth) ** 2)) for mode, estimate in estimates.items()}
    assert rmse["robust"] < min(rmse["all"], rmse["out"], rmse["prev"])
    assert rmse["robust"] < 0.05


def test_one_object_is_enough() -> None:
    rng = np.random.default_rng(4)
    landmarks, truth = make_map(rng, [6]), fly_around(rng, 30)
    poses = detect(truth, landmarks, small_errors(rng, 30, 1))
    votes = landmarks.T_world_obj[np.zeros(30, int)] * poses.T_cam_obj.inv()
    for mode in MODES:
        estimates = solve(poses, landmarks, SolverOptions(mode=mode, memory=Memory(hold_s=0.0)), truth)
        np.testing.assert_allclose(matrices(estimates), votes.as_matrix(), atol=1e-9)
        assert estimates.voted.all()


def test_flags_of_strangers_and_of_frames_that_nobody_solves() -> None:
    rng = np.random.default_rng(5)
    landmarks, truth = make_map(rng, [1, 2, 3]), fly_around(rng, 6)
    seen = np.ones((6, 3), bool)
    seen[2] = [False, False, True]  # object 3 will be a stranger
    poses = detect(truth, landmarks, seen=seen)
    known = LandmarkMap(landmarks.landmarks[:2])
    estimates = solve(poses, known, SolverOptions(mode="out"))
    np.testing.assert_array_equal(estimates.camera_poses.frames, [0, 1, 3, 4, 5])
    strangers = poses.object_ids == 3
    np.testing.assert_array_equal(estimates.landmark_of_detection[strangers], -1)
    assert not estimates.voted[strangers].any()
    assert estimates.voted[~strangers].all()
    np.testing.assert_array_equal(estimates.frame_of_detection[poses.frames == 2], -1)
    np.testing.assert_array_equal(
        estimates.camera_poses.stamps_ns[estimates.frame_of_detection[~strangers]], poses.stamps_ns[~strangers]
    )


def test_best_takes_the_vote_nearest_the_truth_and_only_inside_its_span() -> None:
    landmarks, truth, poses = messy_world(6, 40, 4)
    part = truth[10:30]
    estimates = solve(poses, landmarks, SolverOptions(mode="best"), part)
    assert estimates.camera_poses.stamps_ns.min() >= part.stamps_ns[0]
    assert estimates.camera_poses.stamps_ns.max() <= part.stamps_ns[-1]
    assert not estimates.voted[estimates.frame_of_detection < 0].any()
    for row, stamp in enumerate(estimates.camera_poses.stamps_ns):
        mine = np.flatnonzero(poses.stamps_ns == stamp)
        votes = landmarks.T_world_obj[poses.object_ids[mine] - 1] * poses.T_cam_obj[mine].inv()
        true = part.T_world_body[int(np.flatnonzero(part.stamps_ns == stamp)[0])]
        nearest = int(np.argmin(np.linalg.norm(votes.translation - true.translation, axis=1)))
        np.testing.assert_allclose(matrices(estimates)[row], votes[nearest].as_matrix(), atol=1e-12)
        np.testing.assert_array_equal(np.flatnonzero(estimates.voted[mine]), [nearest])


def test_several_instances_of_a_class() -> None:
    rng = np.random.default_rng(7)
    landmarks, truth = make_map(rng, [1, 5, 5, 5]), fly_around(rng, 60)
    poses = detect(truth, landmarks, small_errors(rng, 60, 4))
    order = np.lexsort((rng.random(len(poses)), poses.stamps_ns))
    for mode in ("all", "robust"):
        estimates = solve(poses[order], landmarks, SolverOptions(mode=mode))
        assert far(estimates, truth).max() < 0.1


@pytest.mark.parametrize("mode", MODES)
def test_a_symmetric_world_is_as_good_as_a_plain_one(mode: Mode) -> None:
    rng = np.random.default_rng(8)
    landmarks, truth = make_map(rng, range(4), SYMMETRIES), fly_around(rng, 60)
    poses = detect(truth, landmarks, small_errors(rng, 60, 4))
    half_turn = np.where(rng.random((240, 1)) < 0.5, 0.0, np.pi)
    axes = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])[np.tile(np.arange(4), 60)]
    rotation = poses.T_cam_obj.rotation * Rotation.from_rotvec(half_turn * axes)
    flipped = ObjectPoses(**{**vars(poses), "T_cam_obj": make_pose(rotation, poses.T_cam_obj.translation)})
    assert far(solve(flipped, landmarks, SolverOptions(mode=mode), truth), truth).max() < 0.12


def test_mistakes_and_empty_input() -> None:
    landmarks, truth, poses = messy_world(9, 5, 3)
    with pytest.raises(InputError, match="oracle and needs the ground truth"):
        solve(poses, landmarks, SolverOptions(mode="best"))
    with pytest.raises(InputError, match="mode is 'median'; choose among all, out"):
        solve(poses, landmarks, SolverOptions(mode="median"))  # type: ignore[arg-type]
    for threshold in ("distance", "angle_deg"):  # differences are counted in them
        with pytest.raises(InputError, match=r"is 0\.0; give more than 0"):
            SolverOptions(**{threshold: 0.0})
    for mode in MODES:
        for nothing, world in ((poses[:0], landmarks), (poses, LandmarkMap())):
            estimates = solve(nothing, world, SolverOptions(mode=mode), truth)
            assert len(estimates.camera_poses) == 0
            assert estimates.camera_poses.covariances.shape == (0, 6, 6)
            assert len(estimates.voted) == len(nothing)
            assert np.all(estimates.frame_of_detection == -1)


@pytest.mark.parametrize("mode", MODES)
def test_twenty_thousand_frames(mode: Mode) -> None:
    landmarks, truth, poses = messy_world(10, 20_000, 5)
    estimates = solve(poses, landmarks, SolverOptions(mode=mode), truth)
    frames = len(np.unique(poses.frames))
    assert frames > 19_900
    assert len(estimates.camera_poses) == frames
    assert np.isfinite(matrices(estimates)).all()
    if mode != "all":
        assert np.median(far(estimates, truth)) < 0.05
