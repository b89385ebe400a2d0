"""How a camera moves of which nothing but its poses is known: at least as lively as these show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.measurements import CAMERA_POSE, Measurements
from fusion.options import ConstantVelocity

Array = NDArray[np.float64]

LAG_S = 0.5
"""Motion is looked at over so long on either side of a pose, or from one pose to the next of a slower sensor."""
_LEAST_POSES = 10
_MEDIAN_OF_THREE = 2.365_974
"""Of a chi-square of three degrees of freedom: gross errors move it little."""


def shown_motion(measured: Measurements, model: ConstantVelocity) -> tuple[float, float]:
    """Return acceleration (m/s^2) and angular acceleration (rad/s^2) per square root of Hz, no less than the model's.

    Of white acceleration of density q second differences over a lag have the variance 2/3 q^2 lag^3 per axis, beside
    six times that of a pose. Object poses show nothing: theirs may be the network's.
    """
    rows = np.flatnonzero(measured.kinds == CAMERA_POSE)
    rows = rows[np.unique(measured.stamps_ns[rows], return_index=True)[1]]
    if len(rows) < _LEAST_POSES:
        return model.acceleration, model.angular_acceleration
    seconds = (measured.stamps_ns[rows] - measured.stamps_ns[rows[0]]) * 1e-9
    lag = max(LAG_S, 1.5 * float(np.median(np.diff(seconds))))
    middle, before, after = _thrice(seconds, lag)
    if len(middle) < _LEAST_POSES:
        return model.acceleration, model.angular_acceleration
    p = measured.translations[rows]
    R = Rotation.from_matrix(measured.rotations[rows].reshape(-1, 3, 3))
    turns = [(R[i].inv() * R[j]).as_rotvec() for i, j in ((before, middle), (middle, after))]
    variances = np.diagonal(measured.covariances[rows], axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
    of_turn, of_place = np.median(variances, axis=0)
    found = [
        _density(p[after] - 2.0 * p[middle] + p[before], of_place, lag),
        _density(turns[1] - turns[0], of_turn, lag),
    ]
    return max(found[0], model.acceleration), max(found[1], model.angular_acceleration)


def _thrice(seconds: Array, lag: float) -> tuple[NDArray[np.int64], ...]:
    """Return places of poses, and of those about a lag before and after each."""
    middle = np.arange(len(seconds))
    before, after = (np.searchsorted(seconds, seconds + side * lag).clip(max=len(seconds) - 1) for side in (-1, 1))
    there = [np.abs(np.abs(seconds[side] - seconds) - lag) < 0.5 * lag for side in (before, after)]
    known = there[0] & there[1] & (before < middle) & (middle < after)
    return middle[known], before[known], after[known]


def _density(differences: Array, variance: float, lag: float) -> float:
    per_axis = float(np.median(np.sum(differences**2, axis=1))) / _MEDIAN_OF_THREE
    return float(np.sqrt(max(per_axis - 6.0 * variance, 0.0) * 1.5 / lag**3))
