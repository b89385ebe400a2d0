"""Largest sets of agreeing votes against all subsets, means against scipy's, tie rules by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors

from landmarks.association import associate
from landmarks.camera_pose import SolverOptions, solve
from landmarks.consensus import agreement, average, largest_sets
from landmarks.landmark_map import map_arrays
from landmarks.votes import Votes, cast_votes
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import LandmarkMap, ObjectPoses


def votes_of(poses: ObjectPoses, landmarks: LandmarkMap) -> Votes:
    arrays = map_arrays(landmarks)
    return cast_votes(poses, arrays, associate(poses, arrays, SolverOptions()))


def cliques_by_all_subsets(agree: np.ndarray) -> list[tuple[bool, ...]]:
    there = [v for v in range(len(agree)) if agree[v, v]]
    for size in range(len(there), 0, -1):
        found = [
            subset
            for subset in itertools.combinations(there, size)
            if all(agree[i, j] for i, j in itertools.combinations(subset, 2))
        ]
        if found:
            return sorted((tuple(v in subset for v in range(len(agree))) for subset in found), reverse=True)
    return []


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.floats(0.0, 1.0))
def test_largest_sets_are_the_largest_of_all_subsets(seed: int, places: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    upper = rng.random((6, places, places)) < share
    agree = np.triu(upper, 1) | np.swapaxes(np.triu(upper, 1), -1, -2)
    there = rng.random((6, places)) < 0.8
    agree |= np.eye(places, dtype=bool)
    agree &= there[:, :, None] & there[:, None]
    frame, members = largest_sets(agree)
    for index in range(6):
        found = [tuple(row.tolist()) for row in members[frame == index]]
        assert found == cliques_by_all_subsets(agree[index])


def test_twenty_objects_in_a_frame() -> None:
    agree = np.zeros((1, 20, 20), bool)
    for start in range(0, 20, 2):  # ten pairs that agree with nobody else
        agree[0, start : start + 2, start : start + 2] = True
    frame, members = largest_sets(agree)
    assert len(frame) == 10
    np.testing.assert_array_equal(members.sum(axis=1), 2)


def test_agreement_is_within_distance_and_angle() -> None:
    rng = np.random.default_rng(0)
    landmarks, truth = make_map(rng, range(6)), fly_around(rng, 50)
    votes = votes_of(detect(truth, landmarks, small_errors(rng, 50, 6, 3.0), rng.random((50, 6)) < 0.8), landmarks)
    agree = agreement(votes, 0.08, np.radians(7.0))
    rotation = Rotation.from_matrix(votes.R_world_cam.reshape(-1, 3, 3))
    for i, j in itertools.product(range(6), repeat=2):
        rows = [np.arange(50) * 6 + place for place in (i, j)]
        angle = (rotation[rows[0]].inv() * rotation[rows[1]]).magnitude()
        apart = np.linalg.norm(votes.t_world_cam[:, i] - votes.t_world_cam[:, j], axis=1)
        both = votes.valid[:, i] & votes.valid[:, j]
        np.testing.assert_array_equal(agree[:, i, j], both & (angle <= np.radians(7.0)) & (apart <= 0.08))


def test_a_vote_agrees_with_itself_however_small_the_thresholds_are() -> None:
    rng = np.random.default_rng(1)
    landmarks, truth = make_map(rng, range(6)), fly_around(rng, 200)
    poses = detect(truth, landmarks, small_errors(rng, 200, 6, 3.0), rng.random((200, 6)) < 0.5)
    votes = votes_of(poses, landmarks)
    np.testing.assert_array_equal(agreement(votes, 1e-12, 1e-12), votes.valid[:, :, None] & np.eye(6, dtype=bool))
    assert len(solve(poses, landmarks, SolverOptions(mode="out", angle_deg=1e-9)).camera_poses) == len(votes)


@pytest.mark.parametrize("weights", ["equal", "score"])
def test_means_against_scipy_and_the_definition(weights: str) -> None:
    rng = np.random.default_rng(1)
    landmarks, truth = make_map(rng, range(5)), fly_around(rng, 20)
    poses = detect(truth, landmarks, small_errors(rng, 20, 5, 5.0))
    poses = ObjectPoses(**{**vars(poses), "scores": rng.uniform(0.1, 1.0, 100)})
    votes = votes_of(poses, landmarks)
    members = rng.random((20, 5)) < 0.7
    members[:, 0] = True
    chordal, mean, used = average(votes, members, SolverOptions(vote_weights=weights))
    middle = SolverOptions(position_average="median", rotation_average="geodesic", vote_weights=weights)
    geodesic, median, _ = average(votes, members, middle)
    for frame in range(20):
        inside = members[frame]
        share = votes.scores[frame][inside] if weights == "score" else np.ones(inside.sum())
        np.testing.assert_allclose(used[frame][inside], share / share.sum())
        rotations = Rotation.from_matrix(votes.R_world_cam[frame][inside])
        np.testing.assert_allclose(chordal[frame], rotations.mean(share).as_matrix(), atol=1e-9)
        positions = votes.t_world_cam[frame][inside]
        np.testing.assert_allclose(mean[frame], np.average(positions, axis=0, weights=share), atol=1e-12)
        np.testing.assert_allclose(median[frame], np.median(positions, axis=0), atol=1e-12)
        # the geodesic mean is where the rotation vectors to the members cancel
        steps = (Rotation.from_matrix(geodesic[frame]).inv() * rotations).as_rotvec()
        np.testing.assert_allclose(share @ steps, 0.0, atol=1e-12)


def two_by_two(rng: np.random.Generator) -> tuple[LandmarkMap, ObjectPoses, np.ndarray]:
    """Four objects in one frame: 0 and 1 agree on the truth, 2 and 3 on a pose half a metre aside."""
    landmarks, truth = make_map(rng, range(4)), fly_around(rng, 1)
    aside = make_pose(truth.T_world_body.rotation, truth.T_world_body.translation + [0.5, 0.0, 0.0])
    right, wrong = detect(truth, landmarks), detect(type(truth)(truth.stamps_ns, aside), landmarks)
    T_cam_obj = type(right.T_cam_obj).concatenate([right.T_cam_obj[:2], wrong.T_cam_obj[2:]])
    return landmarks, ObjectPoses(**{**vars(right), "T_cam_obj": T_cam_obj}), truth.T_world_body.translation[0]


def test_tie_rules() -> None:
    landmarks, poses, right = two_by_two(np.random.default_rng(2))
    wrong = right + [0.5, 0.0, 0.0]

    def position(poses: ObjectPoses, rule: str) -> np.ndarray:
        estimates = solve(poses, landmarks, SolverOptions(mode="out", tie_rule=rule))
        return estimates.camera_poses.T_world_cam.translation[0]

    np.testing.assert_allclose(position(poses, "order"), right, atol=1e-9)
    scored = ObjectPoses(**{**vars(poses), "scores": np.array([0.5, 0.5, 0.6, 0.5])})
    np.testing.assert_allclose(position(scored, "score"), wrong, atol=1e-9)
    distance = np.linalg.norm(poses.T_cam_obj.translation, axis=1)
    nearer = right if distance[:2].mean() < distance[2:].mean() else wrong
    np.testing.assert_allclose(position(scored, "close"), nearer, atol=1e-9)
    np.testing.assert_allclose(position(poses, "score"), nearer, atol=1e-9)  # equal scores go by distance
    moved = make_pose(poses.T_cam_obj.rotation, poses.T_cam_obj.translation + np.eye(4)[0][:, None] * [0.0, 0.02, 0.0])
    loose = ObjectPoses(**{**vars(poses), "T_cam_obj": moved})  # 0 and 1 now agree less well
    np.testing.assert_allclose(position(loose, "compact"), wrong, atol=1e-9)
    back = poses[np.array([2, 3, 0, 1])]
    np.testing.assert_allclose(position(back, "order"), right, atol=1e-9)


def test_prev_decides_ties_by_the_frame_before_and_nothing_else() -> None:
    rng = np.random.default_rng(3)
    landmarks, truth = make_map(rng, range(3)), fly_around(rng, 50)
    errors = small_errors(rng, 50, 3, 0.3)
    errors[1:, 1] = gross_errors(rng, 49)
    errors[1::2, 2] = gross_errors(rng, 25)  # 1 : 1 : 1 in every other frame
    poses = detect(truth, landmarks, errors)
    far = {}
    for mode in ("out", "prev"):
        estimate = solve(poses, landmarks, SolverOptions(mode=mode)).camera_poses.T_world_cam
        far[mode] = np.linalg.norm(estimate.translation - truth.T_world_body.translation, axis=1)
    assert far["prev"].max() < 0.1
    assert np.mean(far["out"] > 0.3) > 0.2
    clear = np.arange(0, 50, 2)
    np.testing.assert_allclose(far["out"][clear], far["prev"][clear], atol=1e-12)
