"""Every Jacobian against a central difference on the manifold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import imu, measurements, new_states
from fusion.nav_state import (
    TIME_OFFSET,
    StateLayout,
    gravity_tangent,
    local_state,
    nominal_state,
    put_pose,
    retract_state,
)
from poet_loc.core.geometry import make_pose

LAYOUTS = [
    StateLayout(n_objects=2),
    StateLayout(n_objects=2, extrinsics=True),
    StateLayout(n_objects=2, objects=True, bias_kinds=1),
    StateLayout(n_objects=3, extrinsics=True, time_offset=True, gravity=True, objects=True, bias_kinds=2),
]


def random_state(layout: StateLayout, rng: np.random.Generator) -> np.ndarray:
    x = nominal_state(
        layout,
        T_world_imu=RigidTransform.from_exp_coords(rng.normal(size=6)),
        T_imu_cam=RigidTransform.from_exp_coords(rng.normal(size=6)),
        T_world_obj=RigidTransform.from_exp_coords(rng.normal(size=(layout.n_objects, 6))),
    )
    if layout.bias_kinds:
        x[layout.spread_start :] *= rng.uniform(0.5, 2.0, len(x) - layout.spread_start)
    return retract_state(x, 0.1 * rng.normal(size=layout.n_error), layout)


def evaluate(kind, k, R_m, t_m, x, rate, layout, nominal_offset=0.0):
    residual, columns = np.zeros(6), np.zeros(measurements.MAX_COLUMNS, dtype=np.int64)
    H = np.zeros((6, measurements.MAX_COLUMNS))
    count = measurements.residual_and_jacobian(
        kind, k, R_m, t_m, x, rate, nominal_offset, layout.as_integers(), residual, H, columns, np.zeros(128)
    )
    dense = np.zeros((6, layout.n_error))
    dense[:, columns[:count]] = H[:, :count]
    return residual, dense


WITH_CLONE = [
    StateLayout(n_objects=1, clone=True),
    StateLayout(n_objects=1, extrinsics=True, time_offset=True, objects=True, bias_kinds=1, clone=True),
]


@pytest.mark.parametrize(
    ("kind", "layout"),
    [(kind, layout) for kind in (measurements.CAMERA_POSE, measurements.OBJECT_POSE) for layout in LAYOUTS]
    + [(measurements.ODOMETRY_STEP, layout) for layout in WITH_CLONE],
)
def test_jacobian_is_the_derivative_of_the_residual(kind, layout):
    rng = np.random.default_rng(5)
    for k in range(layout.n_objects):
        x = random_state(layout, rng)
        R_m = Rotation.from_rotvec(rng.normal(size=3)).as_matrix().ravel()
        t_m, rate = rng.normal(size=3) + [0, 0, 2], rng.normal(size=3)
        stamped_with = 0.01 if layout.time_offset else x[TIME_OFFSET]
        _, H = evaluate(kind, k, R_m, t_m, x, rate, layout, stamped_with)
        numeric, step = np.zeros_like(H), 1e-6
        for j in range(layout.n_error):
            error = np.zeros(layout.n_error)
            error[j] = step
            ahead = evaluate(kind, k, R_m, t_m, retract_state(x, error, layout), rate, layout, stamped_with)[0]
            behind = evaluate(kind, k, R_m, t_m, retract_state(x, -error, layout), rate, layout, stamped_with)[0]
            numeric[:, j] = -(ahead - behind) / (2 * step)
        np.testing.assert_allclose(H, numeric, atol=2e-7)


def test_object_residual_is_the_error_the_convention_states():
    rng = np.random.default_rng(1)
    layout = StateLayout(n_objects=1)
    T_world_imu, T_imu_cam, T_world_obj = (RigidTransform.from_exp_coords(rng.normal(size=6)) for _ in range(3))
    x = nominal_state(
        layout, T_world_imu=T_world_imu, T_imu_cam=T_imu_cam, T_world_obj=RigidTransform.concatenate([T_world_obj])
    )
    T_cam_obj = (T_world_imu * T_imu_cam).inv() * T_world_obj
    e_r, e_t = 0.1 * rng.normal(size=3), 0.1 * rng.normal(size=3)
    measured = make_pose(Rotation.from_rotvec(e_r) * T_cam_obj.rotation, T_cam_obj.translation + e_t)
    R_m = measured.rotation.as_matrix().ravel()
    residual, _ = evaluate(measurements.OBJECT_POSE, 0, R_m, measured.translation, x, np.zeros(3), layout, 0.0)
    np.testing.assert_allclose(residual, np.r_[e_r, e_t], atol=1e-12)


def test_camera_residual_is_the_error_the_convention_states():
    rng = np.random.default_rng(1)
    layout = StateLayout()
    T_world_imu, T_imu_cam = (RigidTransform.from_exp_coords(rng.normal(size=6)) for _ in range(2))
    x = nominal_state(layout, T_world_imu=T_world_imu, T_imu_cam=T_imu_cam)
    T_world_cam = T_world_imu * T_imu_cam
    e_r, e_t = 0.1 * rng.normal(size=3), 0.1 * rng.normal(size=3)
    R_m = (T_world_cam.rotation * Rotation.from_rotvec(e_r)).as_matrix().ravel()
    t_m = T_world_cam.translation + e_t
    residual, _ = evaluate(measurements.CAMERA_POSE, -1, R_m, t_m, x, np.zeros(3), layout, 0.0)
    np.testing.assert_allclose(residual, np.r_[e_r, e_t], atol=1e-12)


def test_odometry_residual_is_the_error_the_convention_states():
    rng = np.random.default_rng(3)
    layout = StateLayout(clone=True)
    T_world_then, T_world_now, T_imu_cam = (RigidTransform.from_exp_coords(rng.normal(size=6)) for _ in range(3))
    x = nominal_state(layout, T_world_imu=T_world_now, T_imu_cam=T_imu_cam)
    put_pose(x, layout.clone_start, T_world_then)
    T_then_cam = (T_world_then * T_imu_cam).inv() * T_world_now * T_imu_cam
    e_r, e_t = 0.1 * rng.normal(size=3), 0.1 * rng.normal(size=3)
    R_m = (T_then_cam.rotation * Rotation.from_rotvec(e_r)).as_matrix().ravel()
    residual, _ = evaluate(
        measurements.ODOMETRY_STEP, -1, R_m, T_then_cam.translation + e_t, x, np.zeros(3), layout, 0.0
    )
    np.testing.assert_allclose(residual, np.r_[e_r, e_t], atol=1e-12)


@pytest.mark.parametrize("layout", WITH_CLONE)
def test_a_clone_is_the_pose_with_its_error(layout):
    """Its error is the derivative of cloning, so that the odometry from a pose to its own clone says nothing."""
    rng = np.random.default_rng(4)
    x, A = random_state(layout, rng), rng.normal(size=(layout.n_error, layout.n_error))
    P, start = A @ A.T, layout.clone_start

    def cloned(state):
        state = state.copy()
        state[start : start + 12] = state[:12]
        return state

    J = np.zeros_like(P)
    for j in range(layout.n_error):
        error = 1e-6 * np.eye(layout.n_error)[j]
        ahead, behind = (cloned(retract_state(x, sign * error, layout)) for sign in (1, -1))
        J[:, j] = (local_state(cloned(x), ahead, layout) - local_state(cloned(x), behind, layout)) / 2e-6
    after, spread = x.copy(), P.copy()
    new_states.clone_pose(after, spread, layout.as_integers())
    np.testing.assert_array_equal(after, cloned(x))
    np.testing.assert_allclose(spread, J @ P @ J.T, atol=1e-6 * np.abs(P).max())
    np.testing.assert_array_equal(spread, spread.T)
    still, H = evaluate(measurements.ODOMETRY_STEP, -1, np.eye(3).ravel(), np.zeros(3), after, np.zeros(3), layout)
    np.testing.assert_allclose(still, 0.0, atol=1e-12)
    np.testing.assert_allclose(H @ spread @ H.T, 0.0, atol=1e-9)


def test_position_rows_do_not_touch_the_objects_rotation():
    rng = np.random.default_rng(2)
    layout = StateLayout(n_objects=2, objects=True)
    x = random_state(layout, rng)
    _, H = evaluate(measurements.OBJECT_POSE, 1, np.eye(3).ravel(), np.array([0, 0, 1.0]), x, np.zeros(3), layout)
    assert np.all(H[3:, layout.error_slice("objects", 1)][:, :3] == 0)
    assert np.all(H[:, layout.error_slice("objects", 0)] == 0)


def test_ray_aligned_covariance_has_its_long_axis_on_the_ray():
    t = np.array([[0.3, -0.2, 0.9], [0.0, 0.0, 2.0]])
    covariances = measurements.ray_aligned_covariance(t, across=0.01, along=0.05, rotation=0.1)
    for covariance, point in zip(covariances, t):
        values, vectors = np.linalg.eigh(covariance[3:, 3:])
        distance = np.linalg.norm(point)
        np.testing.assert_allclose(np.sqrt(values), distance * np.array([0.01, 0.01, 0.05]))
        assert abs(vectors[:, 2] @ point) == pytest.approx(distance)


def transition(x, layout, dt, rate, force, noise):
    work, blocks = np.zeros(64), np.zeros(45)
    moved, n = x.copy(), layout.n_error
    basis = np.zeros(6)
    imu.write_gravity_basis(x, basis)
    imu.propagate_nominal(moved, dt, rate, force, work)
    imu.transition_blocks(dt, work, blocks)

    def propagate(P):
        P = P.copy()
        core, scratch = np.zeros((17, 15)), np.zeros((3, n))
        imu.propagate_covariance(P, blocks, dt, dt, noise, np.zeros(9), basis, layout.as_integers(), core, scratch)
        return P

    return moved, propagate


@pytest.mark.parametrize("layout", LAYOUTS)
def test_covariance_propagation_is_the_derivative_of_the_motion(layout):
    rng = np.random.default_rng(3)
    x = random_state(layout, rng)
    dt, rate, force = 0.02, rng.normal(size=3), rng.normal(size=3) + [0, 0, 9.81]
    noise = np.r_[np.zeros(4), 1.0, 0.0, 0.0]
    moved, propagate = transition(x, layout, dt, rate, force, noise)
    F, step, n = np.zeros((layout.n_error, layout.n_error)), 1e-5, layout.n_error
    for j in range(n):
        error = step * np.eye(n)[j]
        ahead = transition(retract_state(x, error, layout), layout, dt, rate, force, noise)[0]
        behind = transition(retract_state(x, -error, layout), layout, dt, rate, force, noise)[0]
        F[:, j] = (local_state(moved, ahead, layout) - local_state(moved, behind, layout)) / (2 * step)
    A = rng.normal(size=(n, n))
    P = A @ A.T
    np.testing.assert_allclose(propagate(P), F @ P @ F.T, atol=2e-6 * np.abs(P).max())


def test_gravity_basis_is_the_one_of_the_state():
    rng = np.random.default_rng(4)
    for _ in range(5):
        x = nominal_state(StateLayout())
        g = rng.normal(size=3)
        x[34:37] = g
        basis = np.zeros(6)
        imu.write_gravity_basis(x, basis)
        np.testing.assert_allclose(basis.reshape(3, 2), gravity_tangent(g), atol=1e-12)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_retract_and_local_are_inverse(layout):
    rng = np.random.default_rng(6)
    x = random_state(layout, rng)
    error = 0.05 * rng.normal(size=layout.n_error)
    np.testing.assert_allclose(local_state(x, retract_state(x, error, layout), layout), error, atol=1e-12)
