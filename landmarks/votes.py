"""The votes of a log, frame by frame, and what they are off by."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from landmarks.association import Association
from landmarks.landmark_map import CONTINUOUS, MapArrays
from landmarks.options import VoteNoise
from poet_loc.core.geometry import skew
from poet_loc.core.records import ObjectPoses, Stamps

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

_UNKNOWN_TURN = np.pi / np.sqrt(3.0)  # 1-sigma of an angle about which nothing is known
_LEAST_VARIANCE = 1e-12  # (1 urad, 1 um)^2: keeps a covariance that claims to be exact invertible


@dataclass(frozen=True)
class Votes:
    """F frames with K places each, the votes of a frame in the order of the map: a permutation of rows changes nothing.

    What stands where `valid` is False is a harmless identity.
    """

    stamps_ns: Stamps
    frames: NDArray[np.int64]
    valid: Mask
    """(F, K)"""
    detections: Indices
    """(F, K) row of the object poses."""
    landmarks: Indices
    """(F, K) index into the map."""
    scores: Array
    """(F, K)"""
    R_cam_obj: Array
    t_cam_obj: Array
    R_world_obj: Array
    t_world_obj: Array
    R_world_cam: Array
    """(F, K, 3, 3) T_world_cam = T_world_obj * inv(T_cam_obj), the vote."""
    t_world_cam: Array
    """(F, K, 3) m"""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: slice | Indices | Mask) -> Votes:
        return Votes(*(getattr(self, each.name)[index] for each in fields(self)))


def cast_votes(object_poses: ObjectPoses, arrays: MapArrays, association: Association) -> Votes:
    """Return the votes of the detections that have a landmark; only frames with a vote are there."""
    known = np.flatnonzero(association.landmarks >= 0)
    landmarks = association.landmarks[known]
    stamps_ns, first, frame = np.unique(object_poses.stamps_ns[known], return_index=True, return_inverse=True)
    order = np.lexsort((landmarks, frame))
    count = np.bincount(frame, minlength=len(stamps_ns))
    place = np.empty(len(known), np.intp)
    place[order] = np.arange(len(known)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(stamps_ns), int(count.max(initial=0)))

    detections = np.full(shape, -1, np.intp)
    detections[frame, place] = known
    valid = detections >= 0
    landmark = np.where(valid, association.landmarks[detections], 0) if len(known) else np.zeros(shape, np.intp)
    R_cam_obj, t_cam_obj = np.tile(np.eye(3), (*shape, 1, 1)), np.zeros((*shape, 3))
    R_cam_obj[valid] = association.R_cam_obj[detections[valid]]
    t_cam_obj[valid] = np.reshape(object_poses.T_cam_obj.translation, (-1, 3))[detections[valid]]
    R_world_obj, t_world_obj = arrays.R_world_obj[landmark], arrays.t_world_obj[landmark]
    R_world_cam = R_world_obj @ np.swapaxes(R_cam_obj, -1, -2)
    scores = np.zeros(shape)
    scores[valid] = object_poses.scores[detections[valid]]
    return Votes(
        stamps_ns=stamps_ns,
        frames=object_poses.frames[known][first],
        valid=valid,
        detections=detections,
        landmarks=landmark,
        scores=scores,
        R_cam_obj=R_cam_obj,
        t_cam_obj=t_cam_obj,
        R_world_obj=R_world_obj,
        t_world_obj=t_world_obj,
        R_world_cam=R_world_cam,
        t_world_cam=t_world_obj - np.einsum("fkij,fkj->fki", R_world_cam, t_cam_obj),
    )


def detection_covariances(votes: Votes, object_poses: ObjectPoses, arrays: MapArrays, noise: VoteNoise) -> Array:
    """Return (F, K, 6, 6) of [e_r, e_t] in camera axes, landmark uncertainty and unobservable turns included.

    The detection's own covariance where it is finite, else the ray-aligned law of the options; the identity where
    there is no vote.
    """
    covariances = _ray_aligned(votes.t_cam_obj, noise)
    if noise.use_detections and object_poses.covariances is not None:
        own = object_poses.covariances[votes.detections]
        covariances = np.where(np.isfinite(own).all(axis=(-1, -2), keepdims=True), own, covariances)
    covariances = covariances + _LEAST_VARIANCE * np.eye(6)
    if arrays.covariances.any():
        # the landmark's error xi in object axes shows as R_cam_obj xi in camera axes, rotation and translation alike
        turned = np.zeros((*votes.valid.shape, 6, 6))
        turned[..., :3, :3] = turned[..., 3:, 3:] = votes.R_cam_obj
        covariances = covariances + turned @ arrays.covariances[votes.landmarks] @ np.swapaxes(turned, -1, -2)
    axis = np.einsum("fkij,fkj->fki", votes.R_cam_obj, arrays.axes[votes.landmarks])
    free = votes.valid & (arrays.orders[votes.landmarks] == CONTINUOUS)
    covariances[free, :3, :3] += _UNKNOWN_TURN**2 * axis[free][:, :, None] * axis[free][:, None, :]
    return np.where(votes.valid[..., None, None], covariances, np.eye(6))


def vote_covariances(votes: Votes, covariances: Array) -> Array:
    """Return (F, K, 6, 6) of the votes' [e_r, e_t] with R = R_true Exp(e_r), t = t_true + e_t, lever arm included.

    From R_world_cam = R_world_obj R_cam_obj^T and t_world_cam = t_world_obj - R_world_cam t_cam_obj:
    e_r' = -e_r and e_t' = -R_world_cam (e_t + t_cam_obj x e_r) to first order.
    """
    jacobian = np.zeros_like(covariances)
    jacobian[..., :3, :3] = -np.eye(3)
    jacobian[..., 3:, :3] = -votes.R_world_cam @ skew(votes.t_cam_obj)
    jacobian[..., 3:, 3:] = -votes.R_world_cam
    return jacobian @ covariances @ np.swapaxes(jacobian, -1, -2)


def _ray_aligned(t_cam_obj: Array, noise: VoteNoise) -> Array:
    square = np.sum(t_cam_obj**2, axis=-1)[..., None, None]
    outer = t_cam_obj[..., :, None] * t_cam_obj[..., None, :]
    covariances = np.zeros((*t_cam_obj.shape[:-1], 6, 6))
    covariances[..., :3, :3] = np.radians(noise.rotation_deg) ** 2 * np.eye(3)
    across = noise.across**2 * (square * np.eye(3) - outer)
    covariances[..., 3:, 3:] = across + noise.along**2 * outer + noise.least**2 * np.eye(3)
    return covariances
