"""Whether a filter is as wrong as it says: NEES of its whole state, NIS of its measurements, bounds of their means.

NEES of poses, chi-square quantiles and bounds for independent samples are in `poet_loc.core.consistency`.
Source: Y. Bar-Shalom et al., "Estimation with Applications to Tracking and Navigation" (2001), section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammainc

from fusion.nav_state import CORE, EXTRINSIC_ROTATION, POSITION, POSITION_ERROR
from fusion.result import GateLog
from poet_loc.core.consistency import chi_square_quantile, mean_bounds

Array = NDArray[np.float64]
Part = Literal["pose", "position", "rotation"]
_DEGREES_OF_FREEDOM: dict[Part, int] = {"pose": 6, "position": 3, "rotation": 3}


@dataclass(frozen=True)
class NisSummary:
    """How an object's innovations compare with what the filter expected of them."""

    object_id: int
    """-1 for camera poses."""
    instance: int
    part: Part
    tested: int
    """How many met a started filter."""
    accepted: float
    """Share that was used."""
    mean_accepted: float
    """Mean NIS of what was used, over its expectation: 1 is ideal, although the gate cuts the tail off."""
    median: float
    """Median NIS of all, over the median of chi-square: a variance ratio that gross errors do not move."""
    bounds: tuple[float, float]
    """Within them a mean of so many is no surprise, with the autocorrelation of the NIS taken into account."""


def core_errors(estimated: Array, true: Array) -> Array:
    """Return (N, 15) errors that take estimated cores of the state (N, 21) to the true ones (`nav_state`)."""
    R_est, R_true = (Rotation.from_matrix(core[:, :9].reshape(-1, 3, 3)) for core in (estimated, true))
    errors = np.empty((len(estimated), CORE))
    errors[:, :POSITION_ERROR] = (R_est.inv() * R_true).as_rotvec()
    errors[:, POSITION_ERROR:] = (true - estimated)[:, POSITION:EXTRINSIC_ROTATION]
    return errors


def nees(errors: Array, covariances: Array) -> Array:
    """Return the NEES per degree of freedom, (N,), ideal 1, of errors (N, n) with covariances (N, n, n)."""
    scale = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    correlations = covariances / (scale[:, :, None] * scale[:, None, :])  # units of very different size weigh alike
    unit = errors / scale
    whitened = np.linalg.solve(correlations, unit[..., None])[..., 0]
    return np.asarray(np.sum(whitened * unit, axis=1) / errors.shape[1])


def effective_samples(values: Array) -> float:
    """Return how many independent samples say as much about the mean as this series does.

    n / (1 + 2 sum of autocorrelations), the sum ended where it stops to be positive in pairs.
    Source: C. J. Geyer, "Practical Markov chain Monte Carlo", Statistical Science 7 (1992), section 3.3.
    """
    values = np.asarray(values, dtype=float)
    n, centred = len(values), values - values.mean()
    if n < 4 or not np.any(centred):
        return float(n)
    spectrum = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[:n]
    correlation /= correlation[0]
    pairs = correlation[: n - n % 2].reshape(-1, 2).sum(axis=1)
    positive = len(pairs) if np.all(pairs > 0.0) else int(np.argmax(pairs <= 0.0))
    return float(np.clip(n / max(2.0 * pairs[:positive].sum() - 1.0, 1e-9), 1.0, n))


def series_bounds(values: Array, degrees_of_freedom: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the two-sided bounds of the mean of a correlated series of NEES or NIS per degree of freedom."""
    finite = values[np.isfinite(values)]
    samples = max(1, round(effective_samples(finite))) if len(finite) else 0
    return mean_bounds(degrees_of_freedom, samples, confidence)


def truncated_mean(degrees_of_freedom: int, limit: float) -> float:
    """Return the mean of a chi-square variable that is at most `limit`."""
    k = degrees_of_freedom
    return float(k * gammainc(0.5 * k + 1.0, 0.5 * limit) / gammainc(0.5 * k, 0.5 * limit))


def nis_summaries(gate: GateLog, probability: float = 0.99, confidence: float = 0.95) -> list[NisSummary]:
    """Return, per object and part, how the innovations of a run compare with what the filter expected.

    probability is the gate's. Objects without a tested measurement are left out.
    """
    found = []
    for object_id, instance in np.unique(np.stack([gate.object_ids, gate.instances], axis=1), axis=0):
        own = (gate.object_ids == object_id) & (gate.instances == instance) & np.isfinite(gate.nis)
        if not own.any():
            continue
        columns: dict[Part, tuple[Array, NDArray[np.bool_]]] = {
            "pose": (gate.nis, gate.position_accepted & gate.rotation_accepted),
            "position": (gate.nis_position, gate.position_accepted),
            "rotation": (gate.nis_rotation, gate.rotation_accepted),
        }
        for part, (nis, accepted) in columns.items():
            k = _DEGREES_OF_FREEDOM[part]
            used = nis[own & accepted]
            limit = float(chi_square_quantile(probability, k))
            mean = float(used.mean()) / truncated_mean(k, limit) if len(used) else float("nan")
            found.append(
                NisSummary(
                    int(object_id),
                    int(instance),
                    part,
                    int(np.count_nonzero(own)),
                    float(np.mean(accepted[own])),
                    mean,
                    float(np.median(nis[own]) / chi_square_quantile(0.5, k)),
                    series_bounds(used, k, confidence),
                )
            )
    return found
