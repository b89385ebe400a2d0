"""The columns that files share: a pose as tx..qw, a covariance as the upper triangle cov_00..cov_55."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.input_error import InputError
from poet_loc.io.number_table import NumberTable

Array = NDArray[np.float64]

TRANSLATION_COLUMNS = ("tx", "ty", "tz")
QUATERNION_COLUMNS = ("qx", "qy", "qz", "qw")
POSE_COLUMNS = TRANSLATION_COLUMNS + QUATERNION_COLUMNS
_UPPER = np.triu_indices(6)
COVARIANCE_COLUMNS = tuple(f"cov_{i}{j}" for i, j in zip(*_UPPER, strict=True))

_QUATERNION_NORM_TOLERANCE = 0.01


def poses_of(table: NumberTable) -> RigidTransform:
    """Return the poses of a table's rows, quaternions normalised.

    Raises InputError for a number that is not finite and for a quaternion whose norm is off by more than 1 %.
    """
    table.refuse_not_finite(POSE_COLUMNS)
    q_xyzw = table.stack(QUATERNION_COLUMNS)
    norm = np.linalg.norm(q_xyzw, axis=1)
    table.refuse(norm == 0, "the quaternion is zero", "leave out rows without a pose")
    off = np.abs(norm - 1) > _QUATERNION_NORM_TOLERANCE
    if off.any():
        fix = "normalise it, scalar last"
        table.refuse(off, f"the quaternion has norm {norm[np.argmax(off)]:.4g} instead of 1", fix)
    return pose_from_quaternion(table.stack(TRANSLATION_COLUMNS), q_xyzw)


def covariances_of(table: NumberTable) -> Array | None:
    """Return (N, 6, 6) covariances, or None where the table has none; a row of 21 NaN stays NaN.

    Raises InputError for a covariance that is not finite or not positive definite.
    """
    if COVARIANCE_COLUMNS[0] not in table:
        return None
    upper = table.stack(COVARIANCE_COLUMNS)
    absent = np.isnan(upper).all(axis=1)
    table.refuse(
        ~absent & ~np.isfinite(upper).all(axis=1),
        "the covariance is NaN or infinite in part",
        "give all 21 numbers, or nan in all of them where there is no covariance",
    )
    covariances = np.empty((len(table), 6, 6))
    covariances[:, _UPPER[0], _UPPER[1]] = covariances[:, _UPPER[1], _UPPER[0]] = upper
    fix = "give the upper triangle of [rotation, translation], rad^2 and m^2"
    table.refuse(not_positive_definite(covariances) & ~absent, "the covariance is not positive definite", fix)
    return covariances


def covariance_cells(covariances: Array) -> list[Array]:
    """Return the 21 columns of (N, 6, 6) covariances."""
    return list(np.asarray(covariances)[:, _UPPER[0], _UPPER[1]].T)


def pose_cells(T: RigidTransform) -> list[Array]:
    """Return the seven columns of N poses."""
    return [*np.asarray(T.translation).T, *T.rotation.as_quat(canonical=True).T]


def not_positive_definite(covariances: Array) -> NDArray[np.bool_]:
    """Return which of (N, 6, 6) matrices are no covariance, (N,); rounding to a few digits is forgiven."""
    try:
        if np.isfinite(np.linalg.cholesky(covariances)).all():
            return np.zeros(len(covariances), bool)
    except np.linalg.LinAlgError:
        pass
    variances = np.einsum("nii->ni", covariances)
    bad = ~np.isfinite(covariances).all(axis=(1, 2)) | ~(variances > 0).all(axis=1)
    sigmas = np.sqrt(np.where(bad[:, None], 1.0, variances))
    correlations = np.where(bad[:, None, None], np.eye(6), covariances) / (sigmas[:, :, None] * sigmas[:, None, :])
    return bad | (np.linalg.eigvalsh(correlations)[:, 0] < -1e-6)


def refuse_millimetres(path: object, T: RigidTransform, limit_m: float) -> None:
    """Raise InputError where the median distance of N poses from their origin exceeds limit_m (m)."""
    distance = float(np.median(np.linalg.norm(T.translation, axis=-1)))
    if distance > limit_m:
        what = f"translations look like millimetres (median length {distance:.0f})"
        raise InputError(what, path=str(path), fix="divide tx, ty, tz by 1000: metres belong here")
