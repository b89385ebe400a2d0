"""Errors of object poses by the points of the object's model: ADD, ADD-S and the area under their curve.

Sources: S. Hinterstoisser et al., "Model based training, detection and pose estimation of texture-less 3D objects",
ACCV 2012 (ADD, ADI); Y. Xiang et al., "PoseCNN", RSS 2018 (ADD-S, the area under the curve up to 10 cm).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from poet_loc.core.errors import position_error, rotation_angle

Array = NDArray[np.float64]

_POINTS_AT_ONCE = 2_000_000  # bounds the memory of a batch of poses


def add(est: RigidTransform, ref: RigidTransform, points: Array) -> Array:
    """Return the mean distance of corresponding model points, (N,) in m; N poses T_cam_obj, points (P, 3) in m."""
    error = np.empty(len(est))
    for batch in _batches(len(est), len(points)):
        gap = _transformed(est[batch], points) - _transformed(ref[batch], points)
        error[batch] = np.linalg.norm(gap, axis=-1).mean(axis=1)
    return error


def add_s(est: RigidTransform, ref: RigidTransform, points: Array) -> Array:
    """Return the mean distance of each true model point to the nearest estimated one, (N,) in m.

    N poses T_cam_obj, points (P, 3) in m.  The distances are taken in the estimate's object frame, where one tree
    serves all poses.
    """
    tree, error = cKDTree(points), np.empty(len(est))
    T_est_ref = est.inv() * ref
    for batch in _batches(len(est), len(points)):
        distance, _ = tree.query(_transformed(T_est_ref[batch], points))
        error[batch] = np.mean(distance, axis=1)
    return error


def area_under_curve(error: ArrayLike, limit: float = 0.1) -> float:
    """Return the area under accuracy over threshold up to the limit, in percent, integrated exactly; error (N,) in m.

    The accuracy is the share of errors below the threshold; a perfect estimate has 100, no estimate 0.
    """
    error = np.asarray(error, dtype=float)
    return float(100.0 * np.mean(np.clip(1.0 - error / limit, 0.0, 1.0))) if error.size else 0.0


def area_under_curve_published(error: ArrayLike, limit: float = 0.1) -> float:
    """Return the area by the rule behind the published YCB-V tables, in percent: a perfect estimate has 99.858.

    1000 thresholds from 0 and their accuracies, both in float32, and Simpson's rule; their number is even, so it is
    the mean of the rule with a trapezoid at either end (what scipy did before 1.11).
    """
    step = limit / 1000
    thresholds = np.arange(0, limit, step, dtype=np.float32)[:1000]
    error = np.sort(np.asarray(error, dtype=float))
    if error.size == 0:
        return 0.0
    below = np.searchsorted(error, thresholds.astype(float), side="left")
    accuracy = (below / error.size).astype(np.float32).astype(float)
    halves = (_simpson(accuracy[:-1]) + accuracy[-2:].sum() / 2, _simpson(accuracy[1:]) + accuracy[:2].sum() / 2)
    return float(100.0 * np.mean(halves) * step / limit)


def average_translation_error(est: RigidTransform, ref: RigidTransform) -> float:
    """Return the mean Euclidean error of the translations in m; NaN without poses."""
    return float(np.linalg.norm(position_error(est, ref), axis=1).mean()) if len(est) else float("nan")


def average_rotation_error(est: RigidTransform, ref: RigidTransform) -> float:
    """Return the mean angle between the rotations in rad; NaN without poses."""
    return float(rotation_angle(est, ref).mean()) if len(est) else float("nan")


def _simpson(values: Array) -> float:
    """Simpson's rule for an odd number of samples one apart."""
    return float((values[0] + 4.0 * values[1:-1:2].sum() + 2.0 * values[2:-1:2].sum() + values[-1]) / 3.0)


def _transformed(T: RigidTransform, points: Array) -> Array:
    """(B, P, 3) points in the frame that B poses map to."""
    return np.asarray(points @ T.rotation.as_matrix().mT + T.translation[:, None, :])


def _batches(poses: int, points: int) -> list[slice]:
    size = max(1, _POINTS_AT_ONCE // max(points, 1))
    return [slice(start, start + size) for start in range(0, poses, size)]
