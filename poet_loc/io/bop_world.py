"""What a BOP scene's ground truth says about its world: where the objects stand, and whether the cameras agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import adjoint, chordal_mean, local, make_pose, retract

Array = NDArray[np.float64]

_MEAN_ROUNDS = 30
_FIT_ROUNDS = 50
_LEAST_TURN = 1e-3  # mean square of the weakest direction's lever: about two degrees of turning


@dataclass(frozen=True)
class Sightings:
    """Ground-truth sightings of one scene: N rows, each a camera pose and an object pose in that camera."""

    keys: tuple[tuple[int, int], ...]
    """(object_id, instance) of each landmark."""
    landmark_indices: NDArray[np.intp]
    """(N,) which of the keys a row shows."""
    T_world_cam: RigidTransform
    T_cam_obj: RigidTransform

    def moved(self, T_cam_other: RigidTransform) -> Sightings:
        """Return the sightings with the camera trajectory of another frame fixed to the camera."""
        return Sightings(self.keys, self.landmark_indices, self.T_world_cam * T_cam_other, self.T_cam_obj)


@dataclass(frozen=True)
class Placement:
    """Where an object stands, and how well the frames agree on it."""

    key: tuple[int, int]
    T_world_obj: RigidTransform
    frames: int
    distance_p90_m: float
    """Nine frames of ten put the object within this distance of the mean."""
    angle_p90_rad: float


def place_objects(sightings: Sightings) -> tuple[Placement, ...]:
    """Return each landmark's robust mean pose over the frames and the spread about it."""
    T_world_obj = sightings.T_world_cam * sightings.T_cam_obj
    placements = []
    for index, key in enumerate(sightings.keys):
        votes = T_world_obj[sightings.landmark_indices == index]
        mean = robust_mean_pose(votes)
        distances = np.linalg.norm(votes.translation - mean.translation, axis=1)
        angles = (mean.rotation.inv() * votes.rotation).magnitude()
        p90 = [float(np.quantile(values, 0.9)) for values in (distances, angles)]
        placements.append(Placement(key, mean, len(votes), *p90))
    return tuple(placements)


def robust_mean_pose(T: RigidTransform) -> RigidTransform:
    """Return the pose with the least sum of distances, and of chordal distances, to N poses.

    Up to half of the poses may be wrong. Source: Weiszfeld's iteration; for rotations R. Hartley et al.,
    "L1 rotation averaging using the Weiszfeld algorithm", CVPR 2011, with the chordal in place of the geodesic mean.
    """
    points, matrices = T.translation, T.rotation.as_matrix()
    point, matrix = np.median(points, axis=0), chordal_mean(matrices, np.ones(len(points)))
    for _ in range(_MEAN_ROUNDS):
        weights = 1.0 / np.maximum(np.linalg.norm(points - point, axis=1), 1e-6)
        point = weights @ points / weights.sum()
        weights = 1.0 / np.maximum(np.linalg.norm(matrices - matrix, axis=(1, 2)), 1e-6)
        matrix = chordal_mean(matrices, weights)
    return make_pose(Rotation.from_matrix(matrix), point)


def fit_camera_offset(scenes: Sequence[Sightings]) -> RigidTransform | None:
    """Return X that makes T_world_cam X T_cam_obj one pose per landmark, jointly over scenes; None where it is loose.

    It is the pose of the camera that saw the objects in the camera that the trajectory belongs to. Gauss-Newton on
    r = Log(Z^-1 T_world_cam X T_cam_obj) with dr = Ad(T_cam_obj^-1) dX - dZ (first order in r), the landmark poses Z
    eliminated by taking each landmark's mean off; Huber weights. Loose: the camera turns about less than two axes.
    """
    X = RigidTransform.identity()
    jacobians = [adjoint(scene.T_cam_obj.inv()) for scene in scenes]
    for _ in range(_FIT_ROUNDS):
        rows = [_centred_rows(scene.moved(X), jacobian) for scene, jacobian in zip(scenes, jacobians, strict=True)]
        residual = np.concatenate([row for row, _ in rows])
        jacobian = np.concatenate([row for _, row in rows])
        if np.linalg.eigvalsh(np.einsum("nki,nkj->ij", jacobian, jacobian) / len(jacobian))[0] < _LEAST_TURN:
            return None
        weights = _weights(residual)
        information = np.einsum("nki,nk,nkj->ij", jacobian, weights, jacobian)
        step = -np.linalg.solve(information, np.einsum("nki,nk,nk->i", jacobian, weights, residual))
        X = retract(X, step)
        if np.abs(step).max() < 1e-12:
            break
    return X


def _centred_rows(sightings: Sightings, jacobian: Array) -> tuple[Array, Array]:
    """Return residuals (N, 6) and Jacobians (N, 6, 6), each less its landmark's mean."""
    T_world_obj = sightings.T_world_cam * sightings.T_cam_obj
    residual, centred = np.empty((len(T_world_obj), 6)), np.empty_like(jacobian)
    for index in range(len(sightings.keys)):
        rows = sightings.landmark_indices == index
        residual[rows] = local(robust_mean_pose(T_world_obj[rows]), T_world_obj[rows])
        weights = _weights(residual[rows])
        weights /= weights.sum(axis=0)
        residual[rows] -= np.einsum("nk,nk->k", weights, residual[rows])
        centred[rows] = jacobian[rows] - np.einsum("nk,nki->ki", weights, jacobian[rows])
    return residual, centred


def _weights(residual: Array) -> Array:
    """Return Huber weights over the squared scale, (N, 6): one scale for rotation, one for translation."""
    weights = np.empty_like(residual)
    for part in (slice(0, 3), slice(3, 6)):
        length = np.linalg.norm(residual[:, part], axis=1)
        scale = max(float(np.median(length)), 1e-9)
        weights[:, part] = (1.0 / (scale**2 * np.maximum(length / (1.5 * scale), 1.0)))[:, None]
    return weights
