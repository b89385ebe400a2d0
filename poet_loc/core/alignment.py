"""Alignment of an estimated trajectory to a reference, where the two worlds are not the same.

Sources: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
IEEE TPAMI 13 (1991) (U); Z. Zhang and D. Scaramuzza, "A tutorial on quantitative trajectory evaluation for
visual(-inertial) odometry", IROS 2018 (ZS).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory

Array = NDArray[np.float64]
AlignmentKind = Literal["none", "origin", "yaw", "se3", "sim3"]

_RANK_TOLERANCE = 1e-12  # of the largest singular value


@dataclass(frozen=True)
class Alignment:
    """A similarity p_reference = scale R p_estimate + t that acts on the world of the estimate."""

    rotation: Rotation
    translation: Array
    """(3,) m"""
    scale: float = 1.0

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory in the reference's world."""
        T = trajectory.T_world_body
        positions = self.scale * self.rotation.apply(T.translation) + self.translation
        return Trajectory(trajectory.stamps_ns, make_pose(self.rotation * T.rotation, positions))


def align(estimate: Trajectory, reference: Trajectory, kind: AlignmentKind) -> Alignment:
    """Return the alignment of an estimate to a reference of the same length, pose by pose.

    none: the worlds are the same; origin: the first poses coincide; yaw: position and heading, for worlds that share
    gravity; se3, sim3: least squares of the positions.  InputError where the positions do not determine it.
    """
    if len(estimate) != len(reference):
        raise ValueError(f"{len(estimate)} estimated poses for {len(reference)} reference poses")
    if kind == "none":
        return Alignment(Rotation.identity(), np.zeros(3))
    if len(reference) == 0:
        raise InputError("there is no pose to align", fix="check that the stamps of the two trajectories overlap")
    T_est, T_ref = estimate.T_world_body, reference.T_world_body
    if kind == "origin":
        T_ref_est = T_ref[0] * T_est[0].inv()
        return Alignment(T_ref_est.rotation, np.asarray(T_ref_est.translation))
    if kind == "yaw":
        return position_yaw(T_est.translation, T_ref.translation)
    return umeyama(T_est.translation, T_ref.translation, with_scale=kind == "sim3")


def umeyama(p_est: Array, p_ref: Array, with_scale: bool = False) -> Alignment:
    """Return R, t and c (1 without scale) that minimise the mean of |p_ref - (c R p_est + t)|^2; points (N, 3) in m.

    Raises InputError for points that lie on a line, which leave the rotation open.
    """
    mean_est, mean_ref = p_est.mean(axis=0), p_ref.mean(axis=0)  # U eq. 34, 35
    centred_est, centred_ref = p_est - mean_est, p_ref - mean_ref
    variance = np.mean(np.sum(centred_est**2, axis=1))  # U eq. 36
    covariance = centred_ref.T @ centred_est / len(p_est)  # U eq. 38
    u, singular, vt = np.linalg.svd(covariance)
    if singular[1] <= _RANK_TOLERANCE * singular[0]:
        raise InputError("the positions lie on a line: any turn about it fits", fix="align with none, origin or yaw")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # U eq. 39, 43
    rotation = u * signs @ vt  # U eq. 40
    scale = float(singular @ signs / variance) if with_scale else 1.0  # U eq. 42
    return Alignment(Rotation.from_matrix(rotation), mean_ref - scale * rotation @ mean_est, scale)  # U eq. 41


def position_yaw(p_est: Array, p_ref: Array) -> Alignment:
    """Return the turn about world z and the translation that minimise the mean of |p_ref - (R p_est + t)|^2.

    points (N, 3) in m.  ZS section III: with gravity seen, only four degrees of freedom are free.
    """
    mean_est, mean_ref = p_est.mean(axis=0), p_ref.mean(axis=0)
    (ex, ey), (rx, ry) = (p_est - mean_est).T[:2], (p_ref - mean_ref).T[:2]
    cosine, sine = ex @ rx + ey @ ry, ex @ ry - ey @ rx
    if np.hypot(cosine, sine) <= _RANK_TOLERANCE * np.sqrt((ex @ ex + ey @ ey) * (rx @ rx + ry @ ry)):
        raise InputError("the positions leave the heading open", fix="align with none or origin")
    rotation = Rotation.from_rotvec([0.0, 0.0, np.arctan2(sine, cosine)])
    return Alignment(rotation, mean_ref - rotation.apply(mean_est))
