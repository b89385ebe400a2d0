"""Does a covariance say how large the errors are?  Shares inside its ellipsoids, and the factor that mends them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

Array = NDArray[np.float64]

LEVELS = tuple(np.round(np.arange(0.05, 1.0, 0.05), 2).tolist())
"""Probabilities of the ellipsoids that `reliability` looks at."""


def squared_mahalanobis(error: ArrayLike, covariance: ArrayLike) -> Array:
    """Return e^T C^-1 e of errors (N, n) with covariances (N, n, n), (N,)."""
    error = np.asarray(error, float)
    return np.asarray(np.sum(error * np.linalg.solve(np.asarray(covariance, float), error[..., None])[..., 0], axis=-1))


def reliability(squared: ArrayLike, degrees: int, levels: ArrayLike = LEVELS) -> Array:
    """Return the share of squared Mahalanobis distances inside the ellipsoid of each probability.

    For honest covariances and Gaussian errors the share is the probability (A. Kuleshov et al., "Accurate
    uncertainties for deep learning using calibrated regression", 2018, section 3).
    """
    limits = chi2.ppf(np.asarray(levels, float), degrees)
    return np.asarray((np.asarray(squared, float)[None] <= limits[:, None]).mean(axis=1))


def variance_factor(squared: ArrayLike, degrees: int, robust: bool = True) -> float:
    """Return what to multiply covariances with.

    robust: half of the errors lie inside the ellipsoid of one half, so gross errors do not count; else the mean of the
    squared distances becomes its expectation, which maximises the likelihood.  Raises ValueError without an error.
    """
    squared = np.asarray(squared, float)
    if squared.size == 0:
        raise ValueError("no error to calibrate with")
    if robust:
        return float(np.median(squared) / chi2.median(degrees))
    return float(squared.mean() / degrees)
