"""The filter's models as dense matrices in plain numpy: F and Q, residual and H, and what a correction turns.

Written to be read beside the papers and to hold the compiled kernels against, not to be fast.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from fusion import imu
from fusion.measurements import CAMERA_POSE, ODOMETRY_STEP
from fusion.nav_state import (
    ACCEL_BIAS,
    AT_CLONE,
    AT_EXTRINSICS,
    AT_GRAVITY,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    EXTRINSIC_POSITION,
    EXTRINSIC_ROTATION,
    GRAVITY,
    GYRO_BIAS,
    N_BIAS_KINDS,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    SPREAD_SIZE,
    TIME_OFFSET,
    VELOCITY,
    Array,
    Ints,
    StateLayout,
    gravity_tangent,
)
from poet_loc.core.geometry import (
    skew,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_right_jacobian,
    so3_right_jacobian_inverse,
)

# Error states of the core as slices.
ATT, POS, VEL, BG, BA = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
BOTH, ROTATION_ROWS, POSITION_ROWS = slice(0, 6), slice(0, 3), slice(3, 6)


def exp(vector: Array) -> Array:
    """Return the rotation matrix of a rotation vector (rad)."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def log(matrix: Array) -> Array:
    """Return the rotation vector (rad) of a rotation matrix."""
    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


def layout_from_integers(layout: Ints) -> StateLayout:
    """Return the layout that a filter's memory holds as integers."""
    on = layout >= 0
    return StateLayout(
        n_objects=int(layout[N_OBJECTS]),
        extrinsics=bool(on[AT_EXTRINSICS]),
        time_offset=bool(on[AT_TIME_OFFSET]),
        gravity=bool(on[AT_GRAVITY]),
        objects=bool(on[AT_OBJECTS]),
        bias_kinds=int(layout[N_BIAS_KINDS]),
        clone=bool(on[AT_CLONE]),
    )


def transition(x: Array, dt: float, rate: Array, force: Array, layout: StateLayout) -> tuple[Array, Array]:
    """Return the nominal state `dt` seconds later and the dense transition F (n, n) of its error.

    rate (3,) rad/s and force (3,) m/s^2 are means over the interval with their biases still on.
    Source: J. Sola, arXiv:1711.02508, eq. 260 and 270, with the attitude of the interval's middle.
    """
    R = x[:9].reshape(3, 3)
    w, a = rate - x[GYRO_BIAS : GYRO_BIAS + 3], force - x[ACCEL_BIAS : ACCEL_BIAS + 3]
    R_mid, gravity = R @ exp(0.5 * dt * w), x[GRAVITY : GRAVITY + 3]
    acceleration = R_mid @ a + gravity
    moved = x.copy()
    moved[:9] = (Rotation.from_matrix(R) * Rotation.from_rotvec(dt * w)).as_matrix().ravel()
    moved[POSITION : POSITION + 3] += dt * x[VELOCITY : VELOCITY + 3] + 0.5 * dt**2 * acceleration
    moved[VELOCITY : VELOCITY + 3] += dt * acceleration

    F = np.eye(layout.n_error)
    F[ATT, ATT] = exp(-dt * w)
    F[ATT, BG] = -dt * so3_right_jacobian(dt * w)
    gained = np.zeros((3, layout.n_error))  # velocity error gained by each error
    gained[:, ATT] = -dt * R_mid @ skew(a) @ exp(-0.5 * dt * w)
    gained[:, BG] = 0.5 * dt**2 * R_mid @ skew(a) @ so3_right_jacobian(0.5 * dt * w)
    gained[:, BA] = -dt * R_mid
    if layout.gravity:
        gained[:, layout.error_slice("gravity")] = dt * gravity_tangent(gravity)
    F[VEL] += gained
    F[POS] += 0.5 * dt * gained
    F[POS, VEL] += dt * np.eye(3)
    return moved, F


def odometry_transition(x: Array, dt: float, rate: Array, velocity: Array, layout: StateLayout) -> tuple[Array, Array]:
    """Return the state after `dt` seconds of a constant twist (rad/s, m/s in body axes) and the dense F (n, n).

    R <- R Exp(w dt), p <- p + R J_l(w dt) v dt; the velocity is the twist's, its error stays as it is.
    """
    R, w = x[:9].reshape(3, 3), rate * dt
    step = so3_left_jacobian(w) @ velocity * dt
    moved = x.copy()
    moved[:9] = (Rotation.from_matrix(R) * Rotation.from_rotvec(w)).as_matrix().ravel()
    moved[POSITION : POSITION + 3] += R @ step
    moved[VELOCITY : VELOCITY + 3] = R @ exp(w) @ velocity
    F = np.eye(layout.n_error)
    F[ATT, ATT] = exp(-w)
    F[POS, ATT] = -R @ skew(step)
    return moved, F


def process_noise(n: int, dt: float, interval: float, noise: Array, sample: Array) -> Array:
    """Return the dense Q (n, n) of `dt` seconds, Sola eq. 261 position integrated; a long interval is a gap.

    sample (9,) is the row of the interval's end, with what the samples themselves show.
    """
    Q, I = np.zeros((n, n)), np.eye(3)  # noqa: E741
    gap = interval > noise[imu.GAP_S]
    shown = sample[6:8] / sample[8] if noise[imu.MEASURED] and sample[8] > 0.0 else np.zeros(2)
    gyro = max(noise[imu.GYRO_NOISE] ** 2, shown[0]) + (noise[imu.GAP_RATE] ** 2 * interval if gap else 0.0)
    accel = max(noise[imu.ACCEL_NOISE] ** 2, shown[1]) + (noise[imu.GAP_ACCEL] ** 2 * interval if gap else 0.0)
    Q[ATT, ATT] = gyro * dt * I
    Q[VEL, VEL] = accel * dt * I
    Q[POS, VEL] = Q[VEL, POS] = 0.5 * accel * dt**2 * I
    Q[POS, POS] = accel * dt**3 / 3.0 * I
    Q[BG, BG] = noise[imu.GYRO_WALK] ** 2 * dt * I
    Q[BA, BA] = noise[imu.ACCEL_WALK] ** 2 * dt * I
    return Q


def camera_pose_residual(x: Array, R_m: Array, t_m: Array, layout: StateLayout) -> tuple[Array, Array]:
    """Return residual (6,) and dense H (6, n) of a measured T_world_cam."""
    R_wi, p_wi, R_ic, p_ic = _imu_and_camera(x)
    residual = np.r_[log((R_wi @ R_ic).T @ R_m), t_m - p_wi - R_wi @ p_ic]
    inverse = so3_left_jacobian_inverse(residual[:3])
    H = np.zeros((6, layout.n_error))
    H[ROTATION_ROWS, ATT] = inverse @ R_ic.T
    H[POSITION_ROWS, ATT] = -R_wi @ skew(p_ic)
    H[POSITION_ROWS, POS] = np.eye(3)
    if layout.extrinsics:
        at = layout.error_slice("extrinsics").start
        H[ROTATION_ROWS, at : at + 3] = inverse
        H[POSITION_ROWS, at + 3 : at + 6] = R_wi
    return residual, H


def odometry_residual(x: Array, R_m: Array, t_m: Array, layout: StateLayout) -> tuple[Array, Array]:
    """Return residual (6,) and dense H (6, n) of the camera's measured motion since the clone.

    With C, q the camera then and R_wc, s the camera now: R_m = C^T R_wc Exp(e_r), t_m = C^T (s - q) + e_t.
    """
    R_wi, p_wi, R_ic, p_ic = _imu_and_camera(x)
    then = x[layout.clone_start : layout.clone_start + 12]
    C, q = then[:9].reshape(3, 3) @ R_ic, then[9:] + then[:9].reshape(3, 3) @ p_ic
    R_wc, s = R_wi @ R_ic, p_wi + R_wi @ p_ic
    residual = np.r_[log((C.T @ R_wc).T @ R_m), t_m - C.T @ (s - q)]
    inverse = so3_left_jacobian_inverse(residual[:3])
    H = np.zeros((6, layout.n_error))
    H[ROTATION_ROWS, ATT] = inverse @ R_ic.T
    H[POSITION_ROWS, ATT] = -C.T @ R_wi @ skew(p_ic)
    H[POSITION_ROWS, POS] = C.T
    at = layout.error_slice("clone").start
    H[ROTATION_ROWS, at : at + 3] = -inverse @ R_wc.T
    H[POSITION_ROWS, at : at + 3] = C.T @ skew(s)
    H[POSITION_ROWS, at + 3 : at + 6] = -C.T
    if layout.extrinsics:
        at = layout.error_slice("extrinsics").start
        H[ROTATION_ROWS, at : at + 3] = inverse @ (np.eye(3) - R_wc.T @ C)
        H[POSITION_ROWS, at : at + 3] = skew(C.T @ (s - q))
        H[POSITION_ROWS, at + 3 : at + 6] = C.T @ R_wi - R_ic.T
    return residual, H


def cloning(x: Array, layout: StateLayout) -> Array:
    """Return the dense map (n, n) that makes the clone's error of the pose's: xi = R theta, rho = dp + p x xi."""
    R, rows = x[:9].reshape(3, 3), layout.error_slice("clone")
    A = np.eye(layout.n_error)
    A[rows] = 0.0
    A[rows.start : rows.start + 3, ATT] = R
    A[rows.start + 3 : rows.stop, ATT] = skew(x[POSITION : POSITION + 3]) @ R
    A[rows.start + 3 : rows.stop, POS] = np.eye(3)
    return A


def object_pose_residual(x: Array, k: int, R_m: Array, t_m: Array, layout: StateLayout) -> tuple[Array, Array]:
    """Return residual (6,) and dense H (6, n) of a measured T_cam_obj of object k.

    R_m = Exp(e_r) Exp(b) R_cam_obj and t_m = p_cam_obj + D(p_cam_obj) c + e_t with the sum [b, c] of the biases.
    """
    R_wi, p_wi, R_ic, p_ic = _imu_and_camera(x)
    R_wo, p_wo = _object(x, k)
    p_io = R_wi.T @ (p_wo - p_wi)
    p_co = R_ic.T @ (p_io - p_ic)
    R_wc = R_wi @ R_ic
    R_co = R_wc.T @ R_wo
    bias, spread = np.zeros(6), np.ones(6)
    if layout.bias_kinds:
        bias = sum((x[layout.nominal_bias(k, kind)] for kind in range(layout.bias_kinds)), start=bias)
        turning, across, along = x[layout.spread_start + SPREAD_SIZE * k :][:3]
        spread = np.array([turning, turning, turning, across, across, along])
    b, c = np.split(spread * bias, 2)
    aside = np.array([-c[1], c[0], 0.0])  # D(p) c = aside x p + c_z p
    D = np.array([[p_co[2], 0.0, p_co[0]], [0.0, p_co[2], p_co[1]], [-p_co[0], -p_co[1], p_co[2]]])
    residual = np.r_[log(R_m @ (exp(b) @ R_co).T), t_m - p_co - D @ c]

    inverse = so3_right_jacobian_inverse(residual[:3])
    biased, stretch = inverse @ exp(b), (1.0 + c[2]) * np.eye(3) + skew(aside)
    H = np.zeros((6, layout.n_error))
    H[ROTATION_ROWS, ATT] = -biased @ R_ic.T
    H[POSITION_ROWS, ATT] = stretch @ R_ic.T @ skew(p_io)
    H[POSITION_ROWS, POS] = -stretch @ R_wc.T
    if layout.extrinsics:
        at = layout.error_slice("extrinsics").start
        H[ROTATION_ROWS, at : at + 3] = -biased
        H[POSITION_ROWS, at : at + 3] = stretch @ skew(p_co)
        H[POSITION_ROWS, at + 3 : at + 6] = -stretch @ R_ic.T
    if layout.objects:
        at = layout.error_slice("objects", k).start
        H[ROTATION_ROWS, at : at + 3] = biased @ R_co
        H[POSITION_ROWS, at + 3 : at + 6] = stretch @ R_wc.T
    for kind in range(layout.bias_kinds):
        at = layout.error_slice("biases", k, kind).start
        H[ROTATION_ROWS, at : at + 3] = inverse @ so3_left_jacobian(b) * spread[:3]
        H[POSITION_ROWS, at + 3 : at + 6] = D * spread[3:]
    return residual, H


def residual_and_jacobian(
    kind: int, k: int, R_m: Array, t_m: Array, x: Array, rate: Array, nominal_offset: float, layout: StateLayout
) -> tuple[Array, Array]:
    """Return residual (6,) and dense H (6, n) of a measurement, `measurements.residual_and_jacobian` in plain numpy.

    Where the time offset is not the one that the stamp carries, the state moves on at constant velocity and rate.
    """
    if kind == ODOMETRY_STEP:
        return odometry_residual(x, R_m, t_m, layout)
    seconds = x[TIME_OFFSET] - nominal_offset
    R_turn, v = exp(seconds * rate), x[VELOCITY : VELOCITY + 3]
    then = x.copy()
    then[:9] = (x[:9].reshape(3, 3) @ R_turn).ravel()
    then[POSITION : POSITION + 3] += seconds * v
    if kind == CAMERA_POSE:
        residual, H = camera_pose_residual(then, R_m, t_m, layout)
    else:
        residual, H = object_pose_residual(then, k, R_m, t_m, layout)
    if layout.time_offset:
        H[:, layout.error_slice("time_offset")] = (H[:, ATT] @ rate + H[:, POS] @ v)[:, None]
        H[:, VEL] += seconds * H[:, POS]
        H[:, ATT] = H[:, ATT] @ R_turn.T  # Exp(theta) Exp(w s) = Exp(w s) Exp(Exp(-w s) theta)
    return residual, H


def transport(before: Array, after: Array, error: Array, layout: StateLayout) -> Array:
    """Return the dense G (n, n) that carries a covariance from the state before a correction to the one after it.

    Errors are the same in world axes about the world's origin (see `eskf.transport`).
    """
    R_before, R_after = before[:9].reshape(3, 3), after[:9].reshape(3, 3)
    G = np.eye(layout.n_error)
    G[ATT, ATT] = R_after.T @ R_before
    G[POS, ATT] = skew((before - after)[POSITION : POSITION + 3]) @ R_before
    G[VEL, ATT] = skew((before - after)[VELOCITY : VELOCITY + 3]) @ R_before
    for k in range(layout.n_objects if layout.objects else 0):
        at = layout.error_slice("objects", k).start + 3
        G[at : at + 3, ATT] = skew(-error[at : at + 3]) @ R_before
    return G


def transport_clock(before: Array, after: Array, error: Array, rate: Array, force: Array, layout: StateLayout) -> Array:
    """Return the dense G (n, n) that carries a covariance on for the time offset (see `eskf.transport_clock`).

    rate and force (3,) are unbiased, before the correction.
    """
    G = np.eye(layout.n_error)
    if not layout.time_offset:
        return G
    d = layout.error_slice("time_offset").start
    R_before, R_after = before[:9].reshape(3, 3), after[:9].reshape(3, 3)
    w_world, moved = R_before @ rate, after - before
    forces = R_before @ force - R_after @ (force - error[BA])
    G[ATT, d] = R_after.T @ w_world - (rate - error[BG])
    G[POS, d] = np.cross(w_world, moved[POSITION : POSITION + 3]) - moved[VELOCITY : VELOCITY + 3]
    G[VEL, d] = np.cross(w_world, moved[VELOCITY : VELOCITY + 3]) + forces - moved[GRAVITY : GRAVITY + 3]
    return G


def nearest_symmetric(R_m: Array, R_co: Array, axis: Array, order: int) -> Array:
    """Return a measured rotation turned about the object's symmetry axis to where it fits the prediction best."""
    quaternion = Rotation.from_matrix(R_m.T @ R_co).as_quat(canonical=True)
    twist = 2.0 * math.atan2(float(quaternion[:3] @ axis), float(quaternion[3]))
    if order > 1:
        step = 2.0 * math.pi / order
        twist = step * math.floor(twist / step + 0.5)
    return np.asarray(R_m @ exp(twist * axis))


def _imu_and_camera(x: Array) -> tuple[Array, Array, Array, Array]:
    R_ic = x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9].reshape(3, 3)
    p_ic = x[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3]
    return x[:9].reshape(3, 3), x[POSITION : POSITION + 3], R_ic, p_ic


def _object(x: Array, k: int) -> tuple[Array, Array]:
    at = OBJECTS + OBJECT_SIZE * k
    return x[at : at + 9].reshape(3, 3), x[at + 9 : at + 12]
