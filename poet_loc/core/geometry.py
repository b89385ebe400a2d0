"""What scipy's Rotation and RigidTransform lack: adjoints, Jacobians, and a few averages.

Tangent vectors are [rotation, translation] with the error on the right: T_true = T_estimated Exp(xi).
Every function takes any number of leading batch dimensions.
Sources: J. Sola et al., "A micro Lie theory for state estimation in robotics", arXiv:1812.01537 (SdA);
T. D. Barfoot, "State Estimation for Robotics" (2017) (B).
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-4  # below it series of order four are exact to 1e-16


def skew(v: ArrayLike) -> Array:
    """Return the matrix of the cross product, skew(v) @ w = v x w.  (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def so3_left_jacobian(rotvec: ArrayLike) -> Array:
    """Return J_l with Exp(rotvec + d) = Exp(J_l d) Exp(rotvec).  (..., 3) -> (..., 3, 3), SdA eq. 145."""
    rotvec = np.asarray(rotvec, dtype=float)
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24.0, 2.0 * np.sin(0.5 * safe) ** 2 / safe**2)  # 1 - cos, uncancelled
    second = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    cross = skew(rotvec)
    return np.eye(3) + first * cross + second * cross @ cross


def so3_right_jacobian(rotvec: ArrayLike) -> Array:
    """Return J_r with Exp(rotvec + d) = Exp(rotvec) Exp(J_r d).  (..., 3) -> (..., 3, 3), SdA eq. 143."""
    return so3_left_jacobian(-np.asarray(rotvec, dtype=float))


def so3_left_jacobian_inverse(rotvec: ArrayLike) -> Array:
    """Return the inverse of J_l, finite up to a half turn.  (..., 3) -> (..., 3, 3), SdA eq. 146."""
    rotvec = np.asarray(rotvec, dtype=float)
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    half = 0.5 * safe
    second = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half * np.cos(half) / np.sin(half)) / safe**2)
    cross = skew(rotvec)
    return np.eye(3) - 0.5 * cross + second * cross @ cross


def so3_right_jacobian_inverse(rotvec: ArrayLike) -> Array:
    """Return the inverse of J_r.  (..., 3) -> (..., 3, 3), SdA eq. 144."""
    return so3_left_jacobian_inverse(-np.asarray(rotvec, dtype=float))


def adjoint(T_a_b: RigidTransform) -> Array:
    """Return Ad with T_a_b Exp(xi) = Exp(Ad xi) T_a_b for xi = [rotation, translation].

    One transform gives (6, 6), N of them (N, 6, 6); B eq. 7.45 with the blocks in our order.
    """
    rotation = T_a_b.rotation.as_matrix()
    result = np.zeros((*rotation.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotation
    result[..., 3:, :3] = skew(T_a_b.translation) @ rotation
    return result


def make_pose(rotation: Rotation, translation: ArrayLike) -> RigidTransform:
    """Return the transform(s) of a rotation and a translation (m)."""
    return RigidTransform.from_components(np.asarray(translation, dtype=float), rotation)


def pose_from_quaternion(translation: ArrayLike, q_xyzw: ArrayLike) -> RigidTransform:
    """Return transform(s) of translations (..., 3) in m and Hamilton quaternions (..., 4), scalar last."""
    return make_pose(Rotation.from_quat(np.asarray(q_xyzw, dtype=float)), translation)


def local(T_from: RigidTransform, T_to: RigidTransform) -> Array:
    """Return xi with T_to = T_from Exp(xi), [rotation rad, translation m].  (6,) or (N, 6)."""
    return np.asarray((T_from.inv() * T_to).as_exp_coords())


def retract(T: RigidTransform, xi: ArrayLike) -> RigidTransform:
    """Return T Exp(xi), the inverse of `local`."""
    return T * RigidTransform.from_exp_coords(np.asarray(xi, dtype=float))


def chordal_mean(rotations: ArrayLike, weights: ArrayLike) -> Array:
    """Return the weighted chordal mean of rotation matrices: the rotation nearest their weighted sum.

    rotations (..., K, 3, 3), weights (..., K), zero for what does not count -> (..., 3, 3).
    Source: R. Hartley et al., "Rotation averaging", IJCV 103 (2013), section 5.3.
    """
    total = np.einsum("...k,...kij->...ij", np.asarray(weights, float), np.asarray(rotations, float))
    u, _, vt = np.linalg.svd(total)
    sign = np.sign(np.linalg.det(u @ vt))
    u[..., :, 2] *= np.where(sign == 0, 1.0, sign)[..., None]
    return u @ vt


def yaw_pitch_roll(rotation: Rotation) -> Array:
    """Return intrinsic z-y-x angles (yaw, pitch, roll) in rad, (3,) or (N, 3); pitch in [-pi/2, pi/2]."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock")  # the angles are right there, too, with roll 0
        return np.asarray(rotation.as_euler("ZYX"))
