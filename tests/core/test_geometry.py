"""Geometry against expm, numeric derivatives and brute force, over batch shapes, near zero and near a half turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm, logm
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core import geometry as geo

ANGLES = [0.0, 1e-12, 1e-8, 9.9e-5, 1.01e-4, 1e-3, 0.1, 1.0, 2.0, np.pi - 1e-3, np.pi - 1e-7, np.pi]
BATCHES = [(), (1,), (5,), (2, 3)]


def rotvec_of_angle(angle: float, seed: int = 0) -> np.ndarray:
    axis = np.random.default_rng(seed).normal(size=3)
    return angle * axis / np.linalg.norm(axis)


def finite_vectors(size: int, bound: float) -> st.SearchStrategy[np.ndarray]:
    return arrays(float, size, elements=st.floats(-bound, bound, allow_nan=False, width=64))


def matrix_of_twist(xi: np.ndarray) -> np.ndarray:
    """The 4x4 matrix of the tangent vector [rotation, translation]."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = geo.skew(xi[:3]), xi[3:]
    return matrix


def left_jacobian_by_expm(rotvec: np.ndarray) -> np.ndarray:
    """J_l is the integral of Exp(s rotvec) over s in [0, 1]: a block of one matrix exponential."""
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:] = geo.skew(rotvec), np.eye(3)
    return expm(block)[:3, 3:]


def random_pose(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> RigidTransform:
    return geo.make_pose(Rotation.from_rotvec(rng.normal(size=(*shape, 3))), rng.normal(size=(*shape, 3)))


@pytest.mark.parametrize("batch", BATCHES)
def test_skew_is_the_cross_product(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    v, w = rng.normal(size=(2, *batch, 3))
    np.testing.assert_allclose((geo.skew(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_jacobians_match_expm_and_are_inverse(angle: float) -> None:
    rotvec = rotvec_of_angle(angle)
    left = geo.so3_left_jacobian(rotvec)
    np.testing.assert_allclose(left, left_jacobian_by_expm(rotvec), rtol=0, atol=2e-15)
    np.testing.assert_allclose(geo.so3_right_jacobian(rotvec), left.T, rtol=0, atol=1e-15)
    np.testing.assert_allclose(geo.so3_left_jacobian_inverse(rotvec) @ left, np.eye(3), rtol=0, atol=3e-15)
    np.testing.assert_allclose(geo.so3_right_jacobian_inverse(rotvec) @ left.T, np.eye(3), rtol=0, atol=3e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 2.0, np.pi - 0.05])
def test_jacobians_against_central_differences(angle: float) -> None:
    rotvec, step = rotvec_of_angle(angle, seed=3), 1e-6
    R = Rotation.from_rotvec(rotvec)
    right, left, inverse = np.empty((3, 3, 3))
    for axis in range(3):
        d = step * np.eye(3)[axis]
        plus, minus = Rotation.from_rotvec(rotvec + d), Rotation.from_rotvec(rotvec - d)
        right[:, axis] = ((R.inv() * plus).as_rotvec() - (R.inv() * minus).as_rotvec()) / (2 * step)
        left[:, axis] = ((plus * R.inv()).as_rotvec() - (minus * R.inv()).as_rotvec()) / (2 * step)
        moved = [(R * Rotation.from_rotvec(s * d)).as_rotvec() for s in (1, -1)]
        inverse[:, axis] = (moved[0] - moved[1]) / (2 * step)
    np.testing.assert_allclose(geo.so3_right_jacobian(rotvec), right, atol=1e-8)
    np.testing.assert_allclose(geo.so3_left_jacobian(rotvec), left, atol=1e-8)
    np.testing.assert_allclose(geo.so3_right_jacobian_inverse(rotvec), inverse, atol=1e-7)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(
    "function",
    [
        geo.so3_left_jacobian,
        geo.so3_right_jacobian,
        geo.so3_left_jacobian_inverse,
        geo.so3_right_jacobian_inverse,
    ],
)
def test_batches_equal_single_calls(function, batch: tuple[int, ...]) -> None:  # type: ignore[no-untyped-def]
    vectors = np.random.default_rng(2).normal(size=(*batch, 3))
    if vectors.size > 3:
        vectors.reshape(-1, 3)[0] = 0.0
    result = function(vectors)
    assert result.shape == (*batch, 3, 3)
    for index in np.ndindex(batch):
        np.testing.assert_array_equal(result[index], function(vectors[index]))


@pytest.mark.parametrize("batch", [(), (1,), (5,)])
def test_adjoint_moves_a_tangent_to_the_other_side(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    T, xi = random_pose(rng, batch), rng.normal(size=(*batch, 6))
    Ad = geo.adjoint(T)
    assert Ad.shape == (*batch, 6, 6)
    for index in np.ndindex(batch):
        matrix = T.as_matrix()[index]
        moved = expm(matrix_of_twist(Ad[index] @ xi[index]))
        np.testing.assert_allclose(matrix @ expm(matrix_of_twist(xi[index])), moved @ matrix, atol=1e-12)


def test_adjoint_is_a_homomorphism() -> None:
    rng = np.random.default_rng(5)
    a, b = random_pose(rng, (7,)), random_pose(rng, (7,))
    np.testing.assert_allclose(geo.adjoint(a * b), geo.adjoint(a) @ geo.adjoint(b), atol=1e-13)
    np.testing.assert_allclose(geo.adjoint(a.inv()) @ geo.adjoint(a), np.broadcast_to(np.eye(6), (7, 6, 6)), atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_local_and_retract_against_expm_and_logm(angle: float) -> None:
    rng = np.random.default_rng(6)
    T, xi = random_pose(rng), np.concatenate([rotvec_of_angle(angle, seed=7), rng.normal(size=3)])
    T_to = geo.retract(T, xi)
    np.testing.assert_allclose(T_to.as_matrix(), T.as_matrix() @ expm(matrix_of_twist(xi)), atol=1e-12)
    np.testing.assert_allclose(geo.local(T, T_to), xi, atol=1e-7 if angle > 3 else 1e-12)
    if angle < 3:
        logarithm = np.real(logm(T.inv().as_matrix() @ T_to.as_matrix()))
        np.testing.assert_allclose(matrix_of_twist(geo.local(T, T_to)), logarithm, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(finite_vectors(6, 1.7), finite_vectors(6, 50.0))
def test_retract_of_local_returns(xi: np.ndarray, pose: np.ndarray) -> None:
    T = RigidTransform.from_exp_coords(pose)
    np.testing.assert_allclose(geo.local(T, geo.retract(T, xi)), xi, atol=1e-11)
    T_to = RigidTransform.from_exp_coords(pose[::-1])
    np.testing.assert_allclose(geo.retract(T, geo.local(T, T_to)).as_matrix(), T_to.as_matrix(), atol=1e-9)


def test_local_of_stacked_poses_has_one_row_each() -> None:
    rng = np.random.default_rng(8)
    a, b = random_pose(rng, (4,)), random_pose(rng, (4,))
    assert geo.local(a, b).shape == (4, 6)
    assert geo.local(a[0], b[0]).shape == (6,)


def test_pose_from_quaternion_is_scalar_last_and_maps_points() -> None:
    quarter_about_z = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    T_a_b = geo.pose_from_quaternion([1.0, 2.0, 3.0], quarter_about_z)
    np.testing.assert_allclose(T_a_b.apply([1.0, 0.0, 0.0]), [1.0, 3.0, 3.0], atol=1e-15)


def test_chordal_mean_is_the_minimiser_and_ignores_zero_weights() -> None:
    rng = np.random.default_rng(9)
    spread = Rotation.from_rotvec(0.5 * rng.normal(size=(6, 3))) * Rotation.from_rotvec(rng.normal(size=3))
    weights = np.array([1.0, 2.0, 0.5, 1.0, 3.0, 0.0])
    mean = Rotation.from_matrix(geo.chordal_mean(spread.as_matrix(), weights))

    def cost(rotvec: np.ndarray) -> float:
        candidate = (mean * Rotation.from_rotvec(rotvec)).as_matrix()
        return float(np.sum(weights[:, None, None] * (spread.as_matrix() - candidate) ** 2))

    found = minimize(cost, 0.2 * rng.normal(size=3), method="BFGS", options={"gtol": 1e-10})
    np.testing.assert_allclose(found.x, 0.0, atol=1e-6)
    np.testing.assert_allclose(geo.chordal_mean(spread.as_matrix()[:5], weights[:5]), mean.as_matrix(), atol=1e-12)


def test_chordal_mean_is_a_rotation_even_of_far_apart_rotations() -> None:
    rotations = Rotation.random(300, random_state=10).as_matrix().reshape(100, 3, 3, 3)
    means = geo.chordal_mean(rotations, np.ones((100, 3)))
    np.testing.assert_allclose(np.linalg.det(means), 1.0, atol=1e-12)
    np.testing.assert_allclose(means @ means.mT, np.broadcast_to(np.eye(3), (100, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(means[3], geo.chordal_mean(rotations[3], np.ones(3)), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(finite_vectors(3, 1.5))
def test_yaw_pitch_roll_rebuild_the_rotation(angles: np.ndarray) -> None:
    yaw, pitch, roll = angles * [2.0, 1.0, 2.0]
    about = [Rotation.from_rotvec(np.eye(3)[axis] * angle) for axis, angle in ((2, yaw), (1, pitch), (0, roll))]
    R = about[0] * about[1] * about[2]
    np.testing.assert_allclose(geo.yaw_pitch_roll(R), [yaw, pitch, roll], atol=1e-9)


@pytest.mark.filterwarnings("error")
def test_yaw_pitch_roll_at_the_gimbal_lock_is_quiet_and_right() -> None:
    R = Rotation.from_euler("ZYX", [0.3, np.pi / 2, 0.1])
    np.testing.assert_allclose(Rotation.from_euler("ZYX", geo.yaw_pitch_roll(R)).as_matrix(), R.as_matrix(), atol=1e-7)
