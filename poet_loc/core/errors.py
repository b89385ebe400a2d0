"""Errors of poses: functions (estimate, reference) -> array, one value or row a pose.

Sources: R. Kümmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27 (2009) (K);
J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012 (S).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.geometry import yaw_pitch_roll

Array = NDArray[np.float64]
Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]

POSITION_AXES = ("x", "y", "z")
ATTITUDE_AXES = ("yaw", "pitch", "roll")
"""The columns of `attitude_error`."""

Relation = Literal[
    "translation_part",
    "rotation_part",
    "full_transformation",
    "rotation_angle_rad",
    "rotation_angle_deg",
    "point_distance",
    "point_distance_error_ratio",
]
"""What of an error pose E is measured: |t|; |R - I|; |E - I| (Frobenius); the angle in rad or in degrees; the
difference of two distances in m; the same in percent of the reference's distance (relative errors only)."""


@dataclass(frozen=True)
class Statistics:
    """Of the absolute error, in the error's unit; NaN where there is no error to speak of."""

    mean: float
    std: float
    """Of the absolute error about its mean (population)."""
    median: float
    p95: float
    """95th percentile, interpolated linearly."""
    rmse: float

    def scaled(self, factor: float) -> Statistics:
        """Return the statistics in another unit."""
        return Statistics(**{name: factor * value for name, value in asdict(self).items()})


def statistics(error: ArrayLike) -> Statistics:
    """Return mean, std, median, 95th percentile and RMSE of |error|, (N,)."""
    magnitude = np.abs(np.asarray(error, dtype=float))
    if magnitude.size == 0:
        return Statistics(*[np.nan] * 5)
    median, p95 = np.percentile(magnitude, [50.0, 95.0])
    rmse = np.sqrt(np.mean(magnitude**2))
    return Statistics(float(magnitude.mean()), float(magnitude.std()), float(median), float(p95), float(rmse))


def position_error(est: RigidTransform, ref: RigidTransform) -> Array:
    """Return the differences of the positions in world axes, estimate minus reference, (N, 3) in m."""
    return np.asarray(est.translation - ref.translation)


def attitude_error(est: RigidTransform, ref: RigidTransform) -> Array:
    """Return R_err = R_ref^T R_est as intrinsic z-y-x angles, (N, 3) yaw, pitch, roll in rad."""
    return yaw_pitch_roll(ref.rotation.inv() * est.rotation)


def rotation_angle(est: RigidTransform, ref: RigidTransform) -> Array:
    """Return the angle of R_ref^T R_est, (N,) in [0, pi] rad."""
    return np.asarray((ref.rotation.inv() * est.rotation).magnitude())


def absolute_pose_error(est: RigidTransform, ref: RigidTransform, relation: Relation) -> Array:
    """Return the APE of each pose, (N,), from E = T_est^-1 T_ref (K eq. 2; the inverse of E gives the same values)."""
    if relation == "point_distance_error_ratio":
        raise ValueError("the ratio of distances needs pairs of poses: use relative_pose_error")
    if relation == "point_distance":
        relation = "translation_part"
    return _measure(est.inv() * ref, relation)


def relative_pose_error(est: RigidTransform, ref: RigidTransform, pairs: Pairs, relation: Relation) -> Array:
    """Return the RPE of pairs of poses (i, j), (M,), from E = (T_ref_i^-1 T_ref_j)^-1 (T_est_i^-1 T_est_j) (S eq. 1).

    For the ratio of distances, pairs between which the reference stands still are left out.
    """
    i, j = pairs
    if relation in ("point_distance", "point_distance_error_ratio"):
        distance_ref = np.linalg.norm(ref.translation[i] - ref.translation[j], axis=1)
        error = np.abs(distance_ref - np.linalg.norm(est.translation[i] - est.translation[j], axis=1))
        moved = distance_ref > 0.0
        return error if relation == "point_distance" else 100.0 * error[moved] / distance_ref[moved]
    relative_ref, relative_est = ref[i].inv() * ref[j], est[i].inv() * est[j]
    return _measure(relative_ref.inv() * relative_est, relation)


def pairs_by_frames(poses: int, delta: int, all_pairs: bool = False) -> Pairs:
    """Return pairs of indices delta apart: one after the other, or from every pose with all_pairs."""
    if delta < 1:
        raise ValueError(f"a pair spans at least one frame, not {delta}")
    first = np.arange(0, max(poses - delta, 0), 1 if all_pairs else delta)
    return first, first + delta


def pairs_by_metres(positions: Array, delta: float, all_pairs: bool = False, relative_tolerance: float = 0.1) -> Pairs:
    """Return pairs of indices between which a path of delta metres lies; positions (N, 3) in m.

    One after the other, each as soon as delta is reached; with all_pairs from every pose to the one whose distance
    along the path is nearest delta, if it misses by at most delta * relative_tolerance.
    """
    if delta <= 0.0:
        raise ValueError(f"a pair spans a positive path, not {delta} m")
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    if all_pairs:
        return _nearest_along_path(np.concatenate([[0.0], np.cumsum(steps)]), delta, delta * relative_tolerance)
    ends, path = [0], 0.0
    for index, step in enumerate(steps.tolist(), start=1):
        path += step
        if path >= delta:
            ends.append(index)
            path = 0.0
    return np.array(ends[:-1], dtype=np.intp), np.array(ends[1:], dtype=np.intp)


def _nearest_along_path(distances: Array, delta: float, tolerance: float) -> Pairs:
    last = len(distances) - 1
    first = np.arange(last)
    above = np.clip(np.searchsorted(distances, distances[:-1] + delta), first + 1, last)
    # where the body stands still, several poses are equally near: the first of them counts
    below = np.maximum(np.searchsorted(distances, distances[above - 1]), first + 1)
    miss_above = np.abs(distances[above] - distances[:-1] - delta)
    miss_below = np.abs(distances[below] - distances[:-1] - delta)
    second = np.where(miss_below <= miss_above, below, above)
    keep = np.minimum(miss_below, miss_above) <= tolerance
    return first[keep], second[keep]


def _measure(E: RigidTransform, relation: Relation) -> Array:
    if relation == "translation_part":
        return np.linalg.norm(E.translation, axis=-1)
    if relation == "rotation_part":
        return np.linalg.norm(E.rotation.as_matrix() - np.eye(3), axis=(-2, -1))
    if relation == "full_transformation":
        return np.linalg.norm(E.as_matrix() - np.eye(4), axis=(-2, -1))
    if relation == "rotation_angle_rad":
        return np.asarray(E.rotation.magnitude())
    if relation == "rotation_angle_deg":
        return np.degrees(E.rotation.magnitude())
    raise ValueError(f"unknown relation {relation!r}")
