"""Errors of object poses up to the symmetries of the object: rotations, and BOP's MSSD, MSPD and VSD.

Source: T. Hodan et al., "BOP challenge 2020 on 6D object localization" (2020), section 2.2 (H).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Symmetry

Array = NDArray[np.float64]
AxisAndPoint = tuple[tuple[float, float, float], tuple[float, float, float]]

RECALL_SHARES = tuple(np.round(np.arange(0.05, 0.51, 0.05), 2).tolist())
"""Thresholds of MSSD and tolerances of VSD in shares of the diameter, and thresholds of VSD (H, section 2.3)."""
RECALL_PIXELS = tuple(range(5, 51, 5))
"""Thresholds of MSPD, in pixels of an image 640 px wide (H, section 2.3)."""


def rotation_angle_up_to_symmetry(est: Rotation, ref: Rotation, symmetry: Symmetry | None) -> Array:
    """Return the least angle between estimates and the rotations that look like the true ones, (N,) rad."""
    relative = ref.inv() * est
    if symmetry is None:
        return np.asarray(relative.magnitude())
    axis = np.asarray(symmetry.axis, float) / np.linalg.norm(symmetry.axis)
    if symmetry.order == "continuous":
        return axis_tilt(est, ref, axis)
    turns = Rotation.from_rotvec(np.arange(symmetry.order)[:, None] * (2 * np.pi / symmetry.order) * axis)
    return np.asarray(np.min([(relative * turn.inv()).magnitude() for turn in turns], axis=0))


def axis_tilt(est: Rotation, ref: Rotation, axis: ArrayLike) -> Array:
    """Return the angle between where the object's axis is estimated and where it is, (N,) rad."""
    vector = np.asarray(axis, float)
    a, b = est.apply(vector), ref.apply(vector)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def turn_about_axis(est: Rotation, ref: Rotation, axis: ArrayLike) -> Array:
    """Return how far estimates are turned about the object's axis, (N,) rad in [0, pi].

    The twist of R_ref^T R_est = swing twist; the rest of the error, the swing, is `axis_tilt`.
    Source: P. Dobrowolski, "Swing-twist decomposition in Clifford algebra" (2015), section 3.
    """
    quaternion = np.atleast_2d((ref.inv() * est).as_quat())
    along = quaternion[:, :3] @ np.asarray(axis, float)
    return np.asarray(2.0 * np.arctan2(np.abs(along), np.abs(quaternion[:, 3])))


def symmetry_transforms(
    discrete: RigidTransform | None, continuous: Sequence[AxisAndPoint] = (), step: float = 0.01
) -> RigidTransform:
    """Return the K poses T_obj_obj that leave the looks unchanged, the identity first.

    Each continuous symmetry (axis, point in m) is cut into turns of at most `step` half circles, and joined with each
    discrete one (H, section 2.2).
    """
    transforms = [RigidTransform.identity()]
    if discrete is not None:
        transforms += [discrete[i] for i in range(len(discrete))] if not discrete.single else [discrete]
    count = int(np.ceil(np.pi / step))
    for axis, point in continuous:
        unit = np.asarray(axis, float) / np.linalg.norm(axis)
        turns = Rotation.from_rotvec(np.arange(count)[:, None] * (2 * np.pi / count) * unit)
        about = make_pose(turns, np.asarray(point) - turns.apply(point))
        transforms = [turn * fixed for fixed in transforms for turn in about]
    return RigidTransform.concatenate(transforms)


def mssd(est: RigidTransform, ref: RigidTransform, points: Array, symmetries: RigidTransform) -> Array:
    """Return the maximum symmetry-aware surface distance, (N,) in m; points (P, 3) in m (H, eq. 2)."""
    return _least_of_symmetries(est, ref, points, symmetries, lambda moved: moved)


def mspd(est: RigidTransform, ref: RigidTransform, points: Array, symmetries: RigidTransform, camera: Array) -> Array:
    """Return the maximum symmetry-aware projection distance, (N,) in px; camera matrix (3, 3) (H, eq. 3)."""

    def project(moved: Array) -> Array:
        rays = moved @ np.asarray(camera).T
        return np.asarray(rays[..., :2] / rays[..., 2:])

    return _least_of_symmetries(est, ref, points, symmetries, project)


def _least_of_symmetries(
    est: RigidTransform, ref: RigidTransform, points: Array, symmetries: RigidTransform, shown: Callable[[Array], Array]
) -> Array:
    alike = np.stack([points @ s.rotation.as_matrix().T + s.translation for s in symmetries])  # (K, P, 3)
    errors = np.empty(len(est))
    for i in range(len(est)):
        found = shown(points @ est[i].rotation.as_matrix().T + est[i].translation)
        true = shown(alike @ ref[i].rotation.as_matrix().T + ref[i].translation)
        errors[i] = np.linalg.norm(true - found, axis=-1).max(axis=1).min()
    return errors


def average_recall(errors: ArrayLike, thresholds: Sequence[float], total: int) -> float:
    """Return the mean over the thresholds of the share of `total` objects whose error is below it, in percent."""
    errors = np.asarray(errors, float)
    if total == 0:
        return float("nan")
    return float(100.0 * np.mean([np.count_nonzero(errors < threshold) / total for threshold in thresholds]))


def vsd(distance_est: Array, distance_ref: Array, distance_scene: Array, tau: ArrayLike, delta: float = 0.015) -> Array:
    """Return the visible surface discrepancy of one pose from distance images (h, w), for each tolerance (T,) -> (T,).

    Distances from the camera's centre in m, 0 where nothing is: the model alone in both poses, and what the camera saw.
    tau: tolerances of the distance, m; delta: how far behind the scene's surface a point still counts as visible, m
    (H, eq. 1; where the scene's distance is unknown the model counts as visible, as in the benchmark since 2019).
    """
    scene = np.where(distance_scene > 0, distance_scene, np.inf)
    visible_ref = (distance_ref > 0) & (distance_ref - scene <= delta)
    visible_est = (distance_est > 0) & ((distance_est - scene <= delta) | visible_ref)
    union = np.count_nonzero(visible_ref | visible_est)
    if union == 0:
        return np.ones(np.shape(tau))
    both = visible_ref & visible_est
    gap = np.abs(distance_est[both] - distance_ref[both])
    close = np.count_nonzero(gap[:, None] < np.reshape(tau, -1), axis=0).reshape(np.shape(tau))
    return np.asarray(1.0 - close / union)
