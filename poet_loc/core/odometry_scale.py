"""The scale of odometry, by the way that detected objects pass by; no map is needed.

An object that stands still is seen at p, and a second later at p': the camera went p - R p', R being its turn, which is
what odometry knows best. Noise in that way or in the odometry's shortens their product beside its own square: so both
squares are asked, and what speaks less for another scale counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.records import ObjectPoses
from poet_loc.core.trajectory import Trajectory

SPANS_NS = (10**9, 1_500_000_000)  # ways of this length in time
GAP_NS = 200_000_000  # odometry is interpolated over no more
LEAST_WAYS = 20
LARGEST = 0.06  # of the logarithm: networks see all objects some percent too near or too far
SIGMAS = 4.0


@dataclass(frozen=True)
class OdometryScale:
    """How much too long odometry's ways are."""

    factor: float
    """Of the odometry's way to the one by which the objects pass."""
    error: float
    """1-sigma of its logarithm."""
    ways: int

    @property
    def contradicts(self) -> bool:
        """Whether the odometry's unit cannot be the detections'."""
        return self.ways >= LEAST_WAYS and abs(math.log(self.factor)) > LARGEST + SIGMAS * self.error


def odometry_scale(odometry: Trajectory | None, detections: Iterable[ObjectPoses]) -> OdometryScale | None:
    """Return the scale that the surest set of detections shows, None where none does."""
    if odometry is None or len(odometry) < 2:
        return None
    found = (_scale(np.array(list(_ways(odometry, each))).reshape(-1, 3)) for each in detections)
    return min((each for each in found if each is not None), key=lambda each: each.error, default=None)


def _ways(odometry: Trajectory, poses: ObjectPoses) -> Iterator[tuple[float, float, float]]:
    """Yield, for each object and about each second, the way seen times the odometry's, and the square of either."""
    T_odom_cam, valid = odometry.interpolate(poses.stamps_ns, GAP_NS)
    R, p, seen = T_odom_cam.rotation.as_matrix(), T_odom_cam.translation, poses.T_cam_obj.translation
    for key in set(zip(poses.object_ids.tolist(), poses.instances.tolist(), strict=True)):
        mine = np.flatnonzero((poses.object_ids == key[0]) & (poses.instances == key[1]) & valid)
        stamps, first = poses.stamps_ns[mine], 0
        while (last := int(np.searchsorted(stamps, stamps[first] + SPANS_NS[0])) if len(mine) else 0) < len(mine):
            i, j = mine[first], mine[last]
            if stamps[last] - stamps[first] <= SPANS_NS[1]:
                way, passed = R[i].T @ (p[j] - p[i]), seen[i] - R[i].T @ R[j] @ seen[j]
                yield float(passed @ way), float(passed @ passed), float(way @ way)
            first = last


def _scale(ways: NDArray[np.float64]) -> OdometryScale | None:
    ways = ways[(ways[:, 1:] > 0.0).all(axis=1)]
    if len(ways) < 2:
        return None
    (longer, error), (shorter, _) = _ratio(ways[:, 0], ways[:, 2]), _ratio(ways[:, 0], ways[:, 1])
    if longer <= 0.0 or shorter <= 0.0:
        return None
    factors = 1.0 / longer, shorter
    nearest = min(factors, key=lambda each: abs(math.log(each)))
    return OdometryScale(1.0 if min(factors) < 1.0 < max(factors) else nearest, error / longer, len(ways))


def _ratio(product: NDArray[np.float64], square: NDArray[np.float64]) -> tuple[float, float]:
    """Return the median of product / square, each counted by its square, and its 1-sigma by the quartiles."""
    ratio = product / square
    order = np.argsort(ratio)
    shares = np.cumsum(square[order]) / square.sum()
    low, middle, high = ratio[order][np.searchsorted(shares, [0.25, 0.5, 0.75]).clip(max=len(ratio) - 1)]
    spread = (high - low) / 1.349  # of a Gaussian's quartiles; a median is 1.25 times as unsure as a mean
    return float(middle), 1.25 * float(spread * np.linalg.norm(square) / square.sum())
