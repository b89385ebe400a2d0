"""The time offset between turn rates from poses and a gyroscope: how late one stream of stamps is against the other.

A cross-correlation over the lag, under the best rotation at each, finds the tenth of a second; least squares over
rotation, bias and offset, with weights that let go of gross errors, finds the millisecond. The idea: E. Mair et al.,
"Spatio-temporal initialization for IMU to camera registration", ROBIO 2011; Kalibr begins with the same correlation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial.transform import Rotation

from poet_loc.core.geometry import skew
from poet_loc.core.turn_rates import GyroscopeIntegral, TurnRates

Array = NDArray[np.float64]

SEARCH_S = 2.0
"""Offsets are looked for so far either way."""
_BEYOND_S = 1.0  # an offset further off, whose correlation reaches inside, is seen for so far
_GRID_S = 0.02
_APART_S = 0.3  # an offset so far off is a rival
_FURTHEST_S, _SETTLED_S = 0.1, 1e-4
_STRETCH_S = 2.0  # errors of turn rates last less long
_LEAST_STRETCHES = 4
_STIFFNESS = 1e-3  # of the rotation: motion about one axis does not tell the turn about it
_CLEAR, _CLEAR_SIGMA_S = 3.5, 0.1
_ABOVE_CHANCE, _NO_CHANCE = 0.1, 0.5  # of correlations
LEAST_SAMPLES = 25


@dataclass(frozen=True)
class TurnOffset:
    """The offset at which turn rates fit the gyroscope best."""

    offset_s: float
    """The pose of stamp t belongs to the IMU at t + offset."""
    sigma_s: float
    """Its 1-sigma, from how stretches of the log scatter."""
    correlation: float
    """-1 .. 1 there, under the best rotation."""
    lead: float
    """By how many of its standard errors it fits better than the best offset further than 0.3 s away."""
    background: float
    """Correlation that offsets more than a second away reach by chance."""

    @property
    def distinct(self) -> bool:
        """Whether it stands out: a log that barely turns, or turns in a rhythm, says nothing."""
        by_chance = min(self.background + _ABOVE_CHANCE, _NO_CHANCE)
        return self.lead > _CLEAR and self.sigma_s < _CLEAR_SIGMA_S and self.correlation > by_chance


def find_offset(gyroscope: GyroscopeIntegral, rates: TurnRates) -> TurnOffset | None:
    """Return the offset within two seconds either way at which turn rates fit the gyroscope best.

    None where the two streams hardly overlap.
    """
    lags, scores = _correlations(gyroscope, rates)
    if scores.max() < 0.0:
        return None
    coarse = float(lags[np.argmax(scores)])
    away = np.abs(lags - coarse)
    found = _Fit.at(gyroscope, rates, coarse)
    offset, sigma = found.offset_s, found.sigma_s
    if abs(offset - coarse) >= _FURTHEST_S or abs(offset) > SEARCH_S:
        offset, sigma = coarse, float("inf")
    rivals = np.where(away > _APART_S, scores, -1.0)
    rival = _Fit.at(gyroscope, rates, float(lags[np.argmax(rivals)]), 4) if rivals.max() > -1.0 else found
    background = float(scores[away > 1.0].max(initial=0.0))
    return TurnOffset(offset, sigma, float(scores.max()), _lead(rates, found, rival), background)


def _lead(rates: TurnRates, found: _Fit, rival: _Fit) -> float:
    """Return by how many of its standard errors one fit is better than another, over stretches of the log."""
    both = found.used & rival.used
    gain = np.log1p(rival.squares / found.scale**2) - np.log1p(found.squares / found.scale**2)
    stretch = _stretches(rates[both])
    means = np.bincount(stretch, gain[both])[np.bincount(stretch) > 0]
    if len(means) < _LEAST_STRETCHES:
        return 0.0
    return float(means.mean() / max(means.std(ddof=1) / np.sqrt(len(means)), 1e-12))


def _stretches(rates: TurnRates) -> NDArray[np.int64]:
    """Return which stretch of the log each turn belongs to."""
    seconds = (rates.start_ns - rates.start_ns[0]) / 1e9 if len(rates) else np.zeros(0)
    return np.asarray(seconds // _STRETCH_S, dtype=np.int64)


@dataclass(frozen=True)
class _Fit:
    """R w_pose + b = k w_gyroscope at t + offset, by weighted least squares over R, b, k and the offset."""

    offset_s: float
    sigma_s: float
    squares: Array
    """(N,) squared residuals."""
    used: NDArray[np.bool_]
    """(N,) the gyroscope was there."""
    scale: float
    """The size of residuals that count half."""

    @classmethod
    def at(cls, gyroscope: GyroscopeIntegral, rates: TurnRates, offset_s: float, steps: int = 12) -> _Fit:
        """Begin at an offset and go where it leads, within a tenth of a second."""
        R, bias, gain, coarse = None, np.zeros(3), 1.0, offset_s
        for _ in range(steps):
            measured, slopes = gyroscope.mean_rate_and_slope(rates, offset_s)
            used = np.asarray(~np.isnan(measured[:, 0]))
            w, w_pose, slope = measured[used], rates.rates[used], slopes[used]
            if R is None:
                R, bias, gain = _similarity(w, w_pose)
            residual = w_pose @ R.T + bias - gain * w
            squares = np.sum(residual**2, axis=1)
            scale = 1.5 * float(np.sqrt(np.median(squares))) + 1e-9
            # noise is in the poses: the Jacobian takes the rate from the gyroscope
            eye = np.broadcast_to(np.eye(3), (len(w), 3, 3))
            J = np.concatenate([-skew(gain * w - bias), eye, -w[:, :, None], -gain * slope[:, :, None]], axis=2)
            weighted = J / (1.0 + squares / scale**2)[:, None, None]
            information = np.einsum("nij,nik->jk", weighted, J) + 1e-9 * np.eye(8)
            information[:3, :3] += _STIFFNESS * np.trace(information[:3, :3]) * np.eye(3)
            step = -np.linalg.solve(information, np.einsum("nij,ni->j", weighted, residual))
            R, bias, gain = Rotation.from_rotvec(step[:3]).as_matrix() @ R, bias + step[3:6], gain + step[6]
            before = offset_s
            offset_s = float(np.clip(offset_s + step[7], coarse - _FURTHEST_S, coarse + _FURTHEST_S))
            if abs(offset_s - before) < _SETTLED_S:
                break
        every = np.zeros(len(rates))
        every[used] = squares
        return cls(offset_s, _sigma(J, residual, scale, _stretches(rates[used])), every, used, scale)


def _sigma(J: Array, residual: Array, scale: float, stretch: NDArray[np.int64]) -> float:
    """Return the offset's 1-sigma, from how it moves when one stretch is left out at a time (jackknife).

    Within a stretch errors last. The second derivative is that of the weighted loss, whose weights fall with the
    residuals; with few stretches the variance itself is uncertain, as in Student's t distribution.
    """
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    if len(first) < _LEAST_STRETCHES:
        return float("inf")
    weight = 1.0 / (1.0 + np.sum(residual**2, axis=1) / scale**2)
    scores = weight[:, None] * np.einsum("nij,ni->nj", J, residual)
    second = weight[:, None, None] * np.einsum("nij,nik->njk", J, J)
    second -= 2.0 / scale**2 * scores[:, :, None] * scores[:, None, :]
    each, pull = np.add.reduceat(second, first), np.add.reduceat(scores, first)
    others = each.sum(axis=0) - each + 1e-9 * np.eye(8)
    if np.linalg.eigvalsh(others)[:, 0].min() <= 0.0:
        return float("inf")
    moved = np.linalg.solve(others, pull[:, :, None])[:, 7, 0]
    freedom = len(first) - 1
    return float(np.sqrt(np.sum(moved**2) * freedom / len(first) * freedom / (freedom - 2)))


def _similarity(w: Array, w_pose: Array) -> tuple[Array, Array, float]:
    """Return R, b and k of R w_pose + b = k w, the noise in w_pose."""
    a, b = w - w.mean(axis=0), w_pose - w_pose.mean(axis=0)
    (product,), (R,) = best_rotation((a.T @ b)[None])
    gain = float(product / max(np.sum(a**2), 1e-12))
    return R, gain * w.mean(axis=0) - R @ w_pose.mean(axis=0), gain


def best_rotation(cross: Array) -> tuple[Array, Array]:
    """Return trace(R^T C) at its largest over rotations, (K,), and those rotations, for C (K, 3, 3).

    Source: S. Umeyama, PAMI 1991, eq. 40-43.
    """
    u, singular, vt = np.linalg.svd(cross)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    signs = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    return np.sum(singular * signs, axis=-1), (u * signs[:, None, :]) @ vt


def _correlations(gyroscope: GyroscopeIntegral, rates: TurnRates) -> tuple[Array, Array]:
    """Return lags (K,) s and the correlation at each (K,), all at once by FFT; -1 where too few turns overlap."""
    length = float(np.median(rates.end_ns - rates.start_ns)) / 1e9
    margin = round((SEARCH_S + _BEYOND_S) / _GRID_S)
    lags = np.arange(-margin, margin + 1)
    count = max(int((gyroscope.seconds[-1] - length) / _GRID_S) + 1, 1)
    begin = np.asarray(_GRID_S * np.arange(count), dtype=np.float64)
    w = (gyroscope.at(begin + length)[0] - gyroscope.at(begin)[0]) / length
    w -= w.mean(axis=0)
    middle = 0.5 * ((rates.start_ns - gyroscope.start_ns) + (rates.end_ns - gyroscope.start_ns)) / 1e9
    place = np.rint((middle - 0.5 * length) / _GRID_S).astype(np.int64) + margin
    inside = (place >= 0) & (place < count + 2 * margin)
    w_pose = rates.rates[inside]
    of_pose = np.column_stack([w_pose, np.sum(w_pose**2, axis=1), np.ones(len(w_pose))]).T
    binned = np.array([np.bincount(place[inside], row, count + 2 * margin) for row in of_pose])
    of_gyroscope = np.vstack([w.T, np.sum(w**2, axis=1), np.ones(count)])
    size = fft.next_fast_len(count + 2 * margin, real=True)
    there, here = fft.rfft(of_gyroscope, size), np.conj(fft.rfft(binned, size))
    at = (lags - margin) % size

    def sums(a: int | slice, b: int | slice) -> Array:
        """(.., K) sums over the turns of products with the gyroscope at each lag."""
        return np.asarray(fft.irfft(there[a] * here[b], size)[..., at])

    turns = sums(4, 4)
    n = np.maximum(turns, 1.0)
    a, b = sums(slice(0, 3), 4) / n, sums(4, slice(0, 3)) / n
    cross = np.array([sums(i, slice(0, 3)) / n - a[i] * b for i in range(3)])
    scale = (sums(3, 4) / n - np.sum(a**2, axis=0)) * (sums(4, 3) / n - np.sum(b**2, axis=0))
    scores = best_rotation(np.moveaxis(cross, -1, 0))[0] / np.sqrt(np.maximum(scale, 1e-18))
    return np.asarray(lags * _GRID_S), np.where(turns < max(LEAST_SAMPLES, 0.3 * len(rates)), -1.0, scores)
