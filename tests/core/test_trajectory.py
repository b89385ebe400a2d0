"""Trajectories: interpolation along a screw, gaps, slices, and the matching of stamps against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.trajectory import Trajectory, match_stamps

START_NS = 1_600_049_000_000_000_000


def screw(seconds: np.ndarray) -> RigidTransform:
    """A body that turns and slides with a constant twist: geodesic interpolation is exact on it."""
    twist = np.array([0.3, -0.5, 0.8, 0.1, 1.2, -0.4])
    return RigidTransform.from_exp_coords([0.1, 0.2, 0.3, 5.0, -2.0, 1.0]) * RigidTransform.from_exp_coords(
        np.asarray(seconds)[..., None] * twist
    )


def screw_trajectory(stamps_s: np.ndarray) -> Trajectory:
    return Trajectory(START_NS + np.round(stamps_s * 1e9).astype(np.int64), screw(stamps_s))


def test_interpolation_is_exact_on_a_constant_twist() -> None:
    trajectory = screw_trajectory(np.array([0.0, 0.4, 0.5, 1.3, 2.0]))
    seconds = np.linspace(0.0, 2.0, 41)
    poses, valid = trajectory.interpolate(START_NS + np.round(seconds * 1e9).astype(np.int64))
    assert valid.all()
    np.testing.assert_allclose(poses.as_matrix(), screw(seconds).as_matrix(), atol=1e-8)


def test_interpolation_returns_the_samples_themselves() -> None:
    trajectory = screw_trajectory(np.arange(20) * 0.033333333)
    poses, valid = trajectory.interpolate(trajectory.stamps_ns, max_gap_ns=0)
    assert valid.all()
    np.testing.assert_allclose(poses.as_matrix(), trajectory.T_world_body.as_matrix(), atol=1e-12)


def test_interpolation_marks_the_outside_and_the_gaps() -> None:
    trajectory = screw_trajectory(np.array([0.0, 0.1, 1.1, 1.2]))
    queries = START_NS + np.array([-1, 0, 50_000_000, 600_000_000, 1_100_000_000, 1_200_000_000, 1_200_000_001])
    poses, valid = trajectory.interpolate(queries, max_gap_ns=100_000_000)
    assert valid.tolist() == [False, True, True, False, True, True, False]
    np.testing.assert_allclose(poses[0].as_matrix(), trajectory.T_world_body[0].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(poses[6].as_matrix(), trajectory.T_world_body[3].as_matrix(), atol=1e-12)


def test_a_single_pose_is_valid_only_at_its_stamp() -> None:
    trajectory = screw_trajectory(np.array([0.5]))
    stamp = trajectory.stamps_ns[0]
    poses, valid = trajectory.interpolate(np.array([stamp - 1, stamp, stamp + 1]))
    assert valid.tolist() == [False, True, False]
    np.testing.assert_allclose(poses.as_matrix(), np.repeat(trajectory.T_world_body.as_matrix(), 3, axis=0))


def test_nothing_to_interpolate() -> None:
    trajectory = screw_trajectory(np.array([0.0, 1.0]))
    poses, valid = trajectory.interpolate(np.empty(0, np.int64))
    assert len(poses) == len(valid) == 0
    with pytest.raises(ValueError, match="empty"):
        trajectory[:0].interpolate(trajectory.stamps_ns)


def test_stamps_must_increase_and_match_the_poses() -> None:
    with pytest.raises(ValueError, match="increase"):
        Trajectory(np.array([1, 1]), screw(np.zeros(2)))
    with pytest.raises(ValueError, match="2 stamps for 3 poses"):
        Trajectory(np.array([1, 2]), screw(np.zeros(3)))


def test_between_includes_both_ends() -> None:
    trajectory = screw_trajectory(np.arange(5.0))
    picked = trajectory.between(int(trajectory.stamps_ns[1]), int(trajectory.stamps_ns[3]))
    assert picked.stamps_ns.tolist() == trajectory.stamps_ns[1:4].tolist()
    assert len(trajectory.between(0, 5)) == 0


def test_to_body_composes_on_the_right() -> None:
    trajectory = screw_trajectory(np.arange(4.0))
    T_body_other = make_pose(Rotation.from_rotvec([0.0, 0.0, 1.0]), [0.1, 0.0, 0.0])
    moved = trajectory.to_body(T_body_other)
    expected = trajectory.T_world_body.as_matrix() @ T_body_other.as_matrix()
    np.testing.assert_allclose(moved.T_world_body.as_matrix(), expected, atol=1e-14)


sorted_stamps = st.lists(st.integers(0, 60), unique=True, max_size=15).map(sorted).map(lambda x: np.array(x, np.int64))


@settings(max_examples=200, deadline=None)
@given(sorted_stamps, sorted_stamps, st.integers(0, 10))
def test_matched_stamps_are_mutually_nearest(a: np.ndarray, b: np.ndarray, limit: int) -> None:
    i, j = match_stamps(a, b, limit)
    assert len(set(i.tolist())) == len(i) == len(set(j.tolist()))
    assert np.all(np.diff(i) > 0)
    assert np.all(np.diff(j) > 0)
    matched = set(zip(i.tolist(), j.tolist(), strict=True))
    for ia, stamp_a in enumerate(a):
        for jb, stamp_b in enumerate(b):
            gap = abs(stamp_a - stamp_b)
            others = np.concatenate([np.abs(np.delete(b, jb) - stamp_a), np.abs(np.delete(a, ia) - stamp_b)])
            if (ia, jb) in matched:
                assert gap <= limit
                assert np.all(others >= gap)
            elif gap <= limit:  # an unmatched close pair has a rival at most as far away
                assert np.any(others <= gap)
