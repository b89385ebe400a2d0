"""Alignments against evo, brute-force optimisation and their own laws."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core.trajectory import PosePath3D
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.alignment import align, position_yaw, umeyama
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory


def pair(seed: int, poses: int = 60) -> tuple[Trajectory, Trajectory]:
    """An estimate in another world, scaled and noisy, and its reference."""
    rng = np.random.default_rng(seed)
    ref = make_pose(Rotation.from_rotvec(rng.normal(size=(poses, 3))), np.cumsum(rng.normal(size=(poses, 3)), axis=0))
    R_est_ref, noise = Rotation.from_rotvec(rng.normal(size=3)), rng.normal(0.0, 0.05, (poses, 3))
    est = make_pose(R_est_ref * ref.rotation, 0.7 * R_est_ref.apply(ref.translation) + [5.0, 6.0, 7.0] + noise)
    stamps_ns = np.arange(poses, dtype=np.int64)
    return Trajectory(stamps_ns, est), Trajectory(stamps_ns, ref)


def as_evo(trajectory: Trajectory) -> PosePath3D:
    return PosePath3D(poses_se3=list(trajectory.T_world_body.as_matrix()))


@pytest.mark.parametrize("kind", ["se3", "sim3", "origin"])
def test_alignment_agrees_with_evo(kind: str) -> None:
    est, ref = pair(1)
    oracle = as_evo(est)
    if kind == "origin":
        oracle.align_origin(as_evo(ref))
    else:
        rotation, translation, scale = oracle.align(as_evo(ref), correct_scale=kind == "sim3")
        alignment = align(est, ref, kind)
        np.testing.assert_allclose(alignment.rotation.as_matrix(), rotation, rtol=0, atol=1e-9)
        np.testing.assert_allclose(alignment.translation, translation, rtol=0, atol=1e-9)
        assert alignment.scale == pytest.approx(scale, abs=1e-9)
    aligned = align(est, ref, kind).apply(est)
    np.testing.assert_allclose(aligned.T_world_body.as_matrix(), np.array(oracle.poses_se3), rtol=0, atol=1e-9)


@pytest.mark.parametrize("with_scale", [False, True])
def test_umeyama_is_the_minimiser(with_scale: bool) -> None:
    est, ref = (trajectory.T_world_body.translation for trajectory in pair(2, 12))
    best = umeyama(est, ref, with_scale)

    def cost(x: np.ndarray) -> float:
        scale = x[6] * best.scale if with_scale else 1.0
        R = Rotation.from_rotvec(x[:3]) * best.rotation
        return float(np.mean(np.sum((ref - scale * R.apply(est) - best.translation - x[3:6]) ** 2, axis=1)))

    start = np.array([0.0, 0, 0, 0, 0, 0, 1.0])
    found = minimize(cost, start + np.random.default_rng(3).normal(0.0, 0.1, 7) * [*[1.0] * 6, 0.1])
    assert cost(start) <= found.fun + 1e-9


def test_mirrored_points_still_give_a_rotation() -> None:
    points = np.random.default_rng(4).normal(size=(20, 3))
    alignment = umeyama(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(alignment.rotation.as_matrix()) == pytest.approx(1.0)


def test_position_yaw_finds_the_heading_and_is_the_minimiser() -> None:
    est, ref = (trajectory.T_world_body.translation for trajectory in pair(5, 30))
    turned = Rotation.from_rotvec([0.0, 0.0, 2.5]).apply(ref) + [1.0, 2.0, 3.0]
    exact = position_yaw(turned, ref)
    np.testing.assert_allclose(exact.rotation.apply(turned) + exact.translation, ref, atol=1e-12)
    best = position_yaw(est, ref)

    def cost(yaw: float) -> float:
        moved = Rotation.from_rotvec([0.0, 0.0, yaw]).apply(est)
        gap = ref - moved - (ref - moved).mean(axis=0)
        return float(np.sum(gap**2))

    yaws = np.linspace(-np.pi, np.pi, 20001)
    brute = yaws[np.argmin([cost(yaw) for yaw in yaws])]
    assert best.rotation.as_rotvec()[2] == pytest.approx(brute, abs=4e-4)
    np.testing.assert_allclose(best.rotation.apply([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], atol=1e-15)


def test_planar_motion_aligns() -> None:
    points = np.random.default_rng(6).normal(size=(20, 3)) * [1.0, 1.0, 0.0]
    R = Rotation.from_rotvec([0.5, 1.0, -0.3])
    alignment = umeyama(points, R.apply(points) + 1.0)
    np.testing.assert_allclose(alignment.rotation.as_matrix(), R.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("kind", ["se3", "sim3"])
def test_a_line_leaves_the_rotation_open(kind: str) -> None:
    line = make_pose(Rotation.identity(5), np.arange(5.0)[:, None] * [1.0, 2.0, 3.0])
    trajectory = Trajectory(np.arange(5), line)
    with pytest.raises(InputError, match="on a line"):
        align(trajectory, trajectory, kind)


def test_what_cannot_be_aligned_says_so() -> None:
    upright = Trajectory(np.arange(5), make_pose(Rotation.identity(5), np.arange(5.0)[:, None] * [0.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="heading open"):
        align(upright, upright, "yaw")
    with pytest.raises(InputError, match="no pose"):
        align(upright[:0], upright[:0], "origin")
    with pytest.raises(ValueError, match="5 estimated poses for 4"):
        align(upright, upright[:4], "se3")


def test_none_changes_nothing() -> None:
    est, ref = pair(7, 5)
    aligned = align(est, ref, "none").apply(est)
    np.testing.assert_allclose(aligned.T_world_body.as_matrix(), est.T_world_body.as_matrix(), atol=1e-15)
    assert isinstance(aligned.T_world_body, RigidTransform)
