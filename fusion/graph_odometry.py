"""Odometry beside the IMU: a factor between the keyframes at the ends of each of its steps.

Every odometry stamp is a keyframe, so that no step ends between two, none is cut, and each counts once. A step shares
the camera's images with the detections in its time; that correlation is not modelled, in the filter neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.eskf import ACCEPTED, POSITION_ONLY, ROTATION_ONLY
from fusion.graph_factors import Model
from fusion.graph_variables import EXTRINSICS, pose3, pose_key
from fusion.graph_walk import Keyframe, Walk
from fusion.measurements import ODOMETRY_STEP
from fusion.nav_state import EXTRINSIC_ROTATION

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OdometryStep:
    """The camera's motion between two keyframes: rows first..first+size of [rotation, translation]."""

    measurement: int
    first: int
    size: int
    """0: it was refused, or there was nothing to measure it against."""
    T_then_now: gtsam.Pose3
    covariance: Array
    """(6, 6) of [e_r, e_t]: R_measured = R_then_now Exp(e_r), t_measured = t_then_now + e_t."""


def odometry_at(walk: Walk, keyframe: Keyframe, passed: int | None = None) -> OdometryStep | None:
    """Return the odometry that ends at a keyframe; passed: its rows, None: those that passed the walk's gate."""
    c = walk.columns
    for i in keyframe.at:
        if c.kinds[i] == ODOMETRY_STEP:
            rows = int(c.decisions[i]) & ACCEPTED if passed is None else passed
            first, end = 0 if rows & ROTATION_ONLY else 3, 6 if rows & POSITION_ONLY else 3
            moved = gtsam.Pose3(gtsam.Rot3(c.rotations[i].reshape(3, 3)), c.translations[i])
            return OdometryStep(i, first, end - first, moved, c.covariances[i].copy())
    return None


def odometry_factor(step: OdometryStep, then: int, now: int, model: Model) -> gtsam.NonlinearFactor:
    """Return the factor of a step between two keyframes, and the extrinsics where they are estimated."""
    first, second, known = pose_key(then), pose_key(now), pose3(model.x, EXTRINSIC_ROTATION)
    keys = [first, second, EXTRINSICS] if model.layout.extrinsics else [first, second]
    rows = slice(step.first, step.first + step.size)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        T_imu_cam = values.atPose3(EXTRINSICS) if model.layout.extrinsics else known
        e, J = odometry_error(step, values.atPose3(first), values.atPose3(second), T_imu_cam)
        if H is not None:
            for i in range(len(keys)):
                H[i] = np.asfortranarray(J[rows, 6 * i : 6 * i + 6])
        return e[rows]

    return gtsam.CustomFactor(model.noise(step.covariance[rows, rows]), keys, error)


def odometry_error_at(step: OdometryStep, x_then: Array, x_now: Array) -> Array:
    """Return predicted minus measured (6,) between two nominal arrays."""
    return odometry_error(step, pose3(x_then, 0), pose3(x_now, 0), pose3(x_now, EXTRINSIC_ROTATION))[0]


def odometry_error(
    step: OdometryStep, T_world_then: gtsam.Pose3, T_world_now: gtsam.Pose3, T_imu_cam: gtsam.Pose3
) -> tuple[Array, Array]:
    """Return predicted minus measured [rotation, translation] of the camera and its Jacobian (6, 18).

    With the camera's motion h = (A E)^-1 (B E), a step of A, B or E on the right turns into one of h by
    -Ad(h^-1) Ad(E^-1), Ad(E^-1) and 1 - Ad(h^-1).
    """
    h = T_world_then.compose(T_imu_cam).between(T_world_now.compose(T_imu_cam))
    back, to_camera = h.inverse().AdjointMap(), T_imu_cam.inverse().AdjointMap()
    turn = gtsam.Rot3.Logmap(step.T_then_now.rotation().between(h.rotation()))
    rows = np.zeros((6, 6))
    rows[:3, :3] = gtsam.Rot3.LogmapDerivative(turn)
    rows[3:, 3:] = h.rotation().matrix()
    J = rows @ np.hstack([-back @ to_camera, to_camera, np.eye(6) - back])
    return np.concatenate([turn, h.translation() - step.T_then_now.translation()]), J
