"""Whether errors are as large as the covariances say: NEES of poses and chi-square bounds.

Source: Y. Bar-Shalom et al., "Estimation with Applications to Tracking and Navigation" (2001), section 5.4 (BS).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform
from scipy.special import gammaincinv

Array = NDArray[np.float64]


def chi_square_quantile(probability: ArrayLike, degrees_of_freedom: ArrayLike) -> Array:
    """Return what a chi-square variable exceeds with 1 - probability (without the slow import of scipy.stats)."""
    return np.asarray(
        2.0 * gammaincinv(np.asarray(degrees_of_freedom) / 2.0, np.asarray(probability, dtype=float)), dtype=float
    )


def mean_bounds(degrees_of_freedom: int, samples: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the two-sided bounds of a mean NEES or NIS per degree of freedom over so many samples (BS eq. 5.4.2-8).

    They hold for Gaussian errors that are independent from sample to sample. The errors of a filter are correlated
    over time, so over one log the bounds are narrower than chance: a mean outside them by little proves nothing.
    """
    if samples == 0:
        return float("nan"), float("nan")
    total = degrees_of_freedom * samples
    low, high = chi_square_quantile([(1 - confidence) / 2, (1 + confidence) / 2], total) / total
    return float(low), float(high)


def pose_nees(est: RigidTransform, ref: RigidTransform, covariances: Array) -> Array:
    """Return the NEES per degree of freedom of N poses, (N,), ideal 1 (BS eq. 5.4.2-1).

    covariances (N, 6, 6) of [e_r, e_t], R_ref = R_est Exp(e_r) and t_ref = t_est + e_t (both signs turned give the
    same).  NaN where a covariance is NaN or not positive definite.
    """
    rotation = (est.rotation.inv() * ref.rotation).as_rotvec()
    error = np.concatenate([rotation, ref.translation - est.translation], axis=-1)
    covariances = np.asarray(covariances, dtype=float)
    usable: NDArray[np.bool_] = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    scale = np.sqrt(np.where(usable[:, None], np.diagonal(covariances, axis1=1, axis2=2), 1.0).clip(min=0.0))
    usable &= (scale > 0.0).all(axis=1)
    scale = np.where(usable[:, None], scale, 1.0)  # to correlations: rad and m then weigh alike
    correlation = np.where(usable[:, None, None], covariances, np.eye(6)) / (scale[:, :, None] * scale[:, None, :])
    usable &= np.linalg.eigvalsh(correlation)[:, 0] > 1e-12
    correlation = np.where(usable[:, None, None], correlation, np.eye(6))
    whitened = np.linalg.solve(correlation, (error / scale)[..., None])[..., 0]
    return np.where(usable, np.sum(whitened * error / scale, axis=1) / 6.0, np.nan)
