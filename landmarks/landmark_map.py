"""The map as arrays, and the turns that a symmetric object cannot tell apart."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from poet_loc.core.geometry import skew
from poet_loc.core.records import LandmarkMap, Symmetry

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

CONTINUOUS = 0
"""The order that `MapArrays` gives an object which every turn about its axis leaves unchanged."""


@dataclass(frozen=True)
class MapArrays:
    """The L landmarks of a map as columns, in the order of the map."""

    object_ids: NDArray[np.int64]
    instances: NDArray[np.int64]
    R_world_obj: Array
    """(L, 3, 3)"""
    t_world_obj: Array
    """(L, 3) m"""
    covariances: Array
    """(L, 6, 6) of xi with T_true = T_world_obj Exp(xi); zero where the landmark is exact."""
    axes: Array
    """(L, 3) unit axis of symmetry in object axes; z where there is none."""
    orders: NDArray[np.int64]
    """(L,) 1: no symmetry, n: turns by 2 pi / n, CONTINUOUS: every turn."""

    def __len__(self) -> int:
        return len(self.object_ids)

    def nearest_symmetry(self, landmarks: Indices, R_cam_obj: Array, R_expected: Array) -> Array:
        """Return R_cam_obj turned by that symmetry of its landmark which brings it nearest to R_expected.

        landmarks (...,), rotations (..., 3, 3) -> (..., 3, 3); what has no symmetry comes back as it is.
        """
        orders, axes = self.orders[landmarks], self.axes[landmarks]
        relative = np.swapaxes(R_expected, -1, -2) @ R_cam_obj
        # trace(relative Rot(axis, x)) = a + b cos(x - x_best) with b >= 0: nearer in angle is nearer in rotation
        along = np.einsum("...i,...ij,...j->...", axes, relative, axes)
        cosine = np.trace(relative, axis1=-2, axis2=-1) - along
        sine = -np.einsum("...i,...i->...", axes, _vee(relative))
        best = np.arctan2(sine, cosine)
        step = 2.0 * np.pi / np.maximum(orders, 1)
        turn = np.where(orders == CONTINUOUS, best, np.round(best / step) * step)
        return np.where((orders == 1)[..., None, None], R_cam_obj, R_cam_obj @ turn_about(axes, turn))


def map_arrays(landmark_map: LandmarkMap) -> MapArrays:
    """Return the map as columns."""
    landmarks = landmark_map.landmarks
    symmetries = [landmark.symmetry for landmark in landmarks]
    T_world_obj = [landmark.T_world_obj for landmark in landmarks]
    covariances = [np.zeros((6, 6)) if each.covariance is None else each.covariance for each in landmarks]
    return MapArrays(
        object_ids=np.array([landmark.object_id for landmark in landmarks], np.int64),
        instances=np.array([landmark.instance for landmark in landmarks], np.int64),
        R_world_obj=np.reshape([T.rotation.as_matrix() for T in T_world_obj], (-1, 3, 3)).astype(float),
        t_world_obj=np.reshape([T.translation for T in T_world_obj], (-1, 3)).astype(float),
        covariances=np.reshape(covariances, (-1, 6, 6)).astype(float),
        axes=np.reshape([(0.0, 0.0, 1.0) if each is None else each.axis for each in symmetries], (-1, 3)).astype(float),
        orders=np.array([_order(each) for each in symmetries], np.int64),
    )


def symmetry_rotations(symmetry: Symmetry | None) -> Array:
    """Return the rotations that leave an object's looks unchanged, (n, 3, 3), the identity first.

    Raises ValueError for a continuous symmetry, which `MapArrays.nearest_symmetry` treats in closed form.
    """
    if symmetry is None:
        return np.eye(3)[None]
    if symmetry.order == "continuous":
        raise ValueError("a continuous symmetry has no list of rotations")
    turns = 2.0 * np.pi * np.arange(symmetry.order) / symmetry.order
    return turn_about(np.broadcast_to(symmetry.axis, (symmetry.order, 3)), turns)


def landmark_names(keys: Iterable[tuple[int, int]]) -> str:
    """Return "2:0 3:0" for the (object_id, instance) pairs of landmarks or detections."""
    return " ".join(f"{object_id}:{instance}" for object_id, instance in keys)


def _order(symmetry: Symmetry | None) -> int:
    if symmetry is None:
        return 1
    return CONTINUOUS if symmetry.order == "continuous" else int(symmetry.order)


def _vee(matrix: Array) -> Array:
    """Return v with skew(v) = M - M^T."""
    return np.stack(
        [
            matrix[..., 2, 1] - matrix[..., 1, 2],
            matrix[..., 0, 2] - matrix[..., 2, 0],
            matrix[..., 1, 0] - matrix[..., 0, 1],
        ],
        axis=-1,
    )


def turn_about(axes: ArrayLike, angles: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) about unit axes (..., 3) by angles (...,) rad (Rodrigues' formula)."""
    cross, angles = skew(axes), np.asarray(angles, float)
    sine, cosine = np.sin(angles)[..., None, None], np.cos(angles)[..., None, None]
    return np.eye(3) + sine * cross + (1.0 - cosine) * cross @ cross
