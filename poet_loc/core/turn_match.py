"""How well turn rates from poses and those of a gyroscope belong together.

Two streams w_imu = R w_pose + b belong together as well as the correlation of R w_pose with w_imu over R in SO(3)
says, found from the singular values of their cross covariance (Umeyama 1991, eq. 40-43).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from poet_loc.core.records import ImuSamples
from poet_loc.core.turn_offset import LEAST_SAMPLES, SEARCH_S, TurnOffset, best_rotation, find_offset
from poet_loc.core.turn_rates import GyroscopeIntegral, TurnRates, around, believable

Array = NDArray[np.float64]

_FLOOR_S, _NOISE_S, _MOST_NOISE_S = 0.005, 0.07, 0.1


@dataclass(frozen=True)
class Match:
    """How turn rates fit the gyroscope at one offset."""

    offset: TurnOffset
    correlation: float
    """-1 .. 1 under the best rotation."""
    R_imu_body: Rotation
    """That rotation."""
    mirrored: float
    """Correlation under the best reflection."""
    reflection: Array
    """(3, 3) that reflection."""
    gyroscope_scale: float
    """Gyroscope over poses: 1 where both are in rad/s."""
    gyroscope_mean: Array
    """(3,) its mean rate over those turns .."""
    poses_mean: Array
    """.. and theirs in its axes, rad/s: the difference is its bias."""
    samples: int

    @property
    def offset_error_s(self) -> float:
        """How far the offset may be off, s: 3 sigma, and what poses hide that turn late, measured on real networks."""
        c = min(max(self.correlation, 0.1), 1.0)
        return _FLOOR_S + min(_NOISE_S * math.sqrt(1.0 - c**2) / c, _MOST_NOISE_S) + 3.0 * self.offset.sigma_s

    def contradicts(self, stated_s: float) -> bool:
        """Whether the offset stands out, and is another than the one stated."""
        return self.offset.distinct and abs(self.offset.offset_s - stated_s) > self.offset_error_s


def match_turns(imu: ImuSamples, rates: TurnRates) -> Match | None:
    """Return the offset, up to two seconds either way, at which turn rates fit the gyroscope best, and how well.

    None where there is too little of them.
    """
    rates = believable(imu, rates)
    if len(rates) < LEAST_SAMPLES:
        return None
    gyroscope = GyroscopeIntegral.of(around(imu, rates, 1.5 * SEARCH_S))
    offset = find_offset(gyroscope, rates)
    if offset is None:
        return None
    cross, scale = _cross_covariance(gyroscope, rates, offset.offset_s)
    turned = gyroscope.mean_rate(rates, offset.offset_s)
    (score,), (rotation,) = best_rotation(cross[None])
    u, _, vt = np.linalg.svd(cross)
    reflection = u @ np.diag([1.0, 1.0, -np.sign(np.linalg.det(u @ vt))]) @ vt
    return Match(
        offset=offset,
        correlation=float(score / scale),
        R_imu_body=Rotation.from_matrix(rotation),
        mirrored=float(np.trace(reflection.T @ cross) / scale),
        reflection=reflection,
        gyroscope_scale=_scale(gyroscope, rates, offset.offset_s, rotation),
        gyroscope_mean=np.nanmean(turned, axis=0),
        poses_mean=np.mean(rates.rates[~np.isnan(turned[:, 0])] @ rotation.T, axis=0),
        samples=len(rates),
    )


def correlation_under(imu: ImuSamples, rates: TurnRates, offset_s: float, R_imu_body: Rotation) -> float:
    """Return the correlation of the gyroscope with turn rates under a given rotation."""
    rates = believable(imu, rates)
    if len(rates) < LEAST_SAMPLES:
        return 0.0
    cross, scale = _cross_covariance(GyroscopeIntegral.of(around(imu, rates, 1.5 * SEARCH_S)), rates, offset_s)
    return float(np.sum(R_imu_body.as_matrix() * cross) / scale)


def _cross_covariance(gyroscope: GyroscopeIntegral, rates: TurnRates, offset_s: float) -> tuple[Array, float]:
    """Return C (3, 3) = cov(w_imu, w_pose) and sqrt(var w_imu var w_pose); infinite where too little overlaps."""
    w = gyroscope.mean_rate(rates, offset_s)
    there = ~np.isnan(w[:, 0])
    if there.sum() < max(LEAST_SAMPLES, 0.3 * len(there)):
        return np.zeros((3, 3)), float("inf")
    a, b = w[there], rates.rates[there]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    return a.T @ b / len(a), max(float(np.sqrt(np.sum(a**2) * np.sum(b**2))) / len(a), 1e-12)


def _scale(gyroscope: GyroscopeIntegral, rates: TurnRates, offset_s: float, R_imu_body: Array) -> float:
    """Return the gyroscope over the turn rates; the regression on the gyroscope is not shrunk by the poses' noise."""
    w = gyroscope.mean_rate(rates, offset_s)
    there = ~np.isnan(w[:, 0])
    a, b = w[there], rates.rates[there] @ R_imu_body.T
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    slope = float(np.sum(a * b) / max(np.sum(a * a), 1e-12))
    return 1.0 / slope if slope > 1e-6 else float("inf")
