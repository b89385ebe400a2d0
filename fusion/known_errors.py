"""What is known of a network's errors beforehand: each object's mean error, taken off its detections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.options import DetectionBias
from poet_loc.core.records import LandmarkMap

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class KnownErrors:
    """What undoes the mean errors of the L landmarks of a map."""

    turns: Rotation
    """(L,) from the left, in camera axes."""
    shears: Array
    """(L, 3, 3) of positions in camera axes."""

    def taken_off(self, landmarks: Indices, rotations: Rotation, positions: Array) -> tuple[Rotation, Array]:
        """Return rotations (N,) and positions (N, 3) m of T_cam_obj without the mean errors of landmarks (N,)."""
        return self.turns[landmarks] * rotations, np.einsum("nij,nj->ni", self.shears[landmarks], positions)


def known_errors(bias: DetectionBias, landmark_map: LandmarkMap | None) -> KnownErrors | None:
    """Return what the options know of the errors of a map's objects; None where that is nothing.

    A mean error acts as the biases do (`fusion/measurements.py`): R_measured = Exp(rotation) R and
    t_measured = p + (x p_z, y p_z, -x p_x - y p_y) + stretch p, which is linear in p.
    """
    means = {row[0]: np.array(row[1:]) for row in bias.means}
    if not bias.use or landmark_map is None or not any(thing.object_id in means for thing in landmark_map):
        return None
    errors = np.array([means.get(thing.object_id, np.zeros(6)) for thing in landmark_map])
    shears = (1.0 + errors[:, 5, None, None]) * np.eye(3)
    shears[:, :2, 2] += errors[:, 3:5]
    shears[:, 2, :2] -= errors[:, 3:5]
    return KnownErrors(
        Rotation.from_rotvec(np.radians(errors[:, :3])).inv(), np.asarray(np.linalg.inv(shears), dtype=np.float64)
    )
