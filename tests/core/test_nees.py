"""NEES and its bounds against scipy.stats, filterpy and a Monte Carlo of the stated error model."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.stats import NEES
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from poet_loc.core.consistency import chi_square_quantile, mean_bounds, pose_nees
from poet_loc.core.geometry import make_pose


@pytest.mark.parametrize("dof", [1, 3, 6, 12000])
def test_quantiles_are_scipys(dof: int) -> None:
    probability = np.array([0.001, 0.025, 0.5, 0.99])
    np.testing.assert_allclose(chi_square_quantile(probability, dof), chi2.ppf(probability, dof), rtol=1e-10)


def test_bounds_hold_as_often_as_they_say() -> None:
    samples = np.random.default_rng(1).chisquare(6, (4000, 25)).mean(axis=1) / 6
    low, high = mean_bounds(6, 25, confidence=0.9)
    assert np.mean((samples > low) & (samples < high)) == pytest.approx(0.9, abs=0.02)
    assert np.isnan(mean_bounds(6, 0)).all()


def drawn(rng: np.random.Generator, poses: int, scale: float) -> tuple[RigidTransform, RigidTransform, np.ndarray]:
    """Estimates whose error is drawn from the covariance that they state."""
    mix = rng.normal(0.0, scale, (poses, 6, 6)) * np.array([0.01] * 3 + [0.1] * 3)[:, None]
    covariances = mix @ mix.mT + 1e-9 * np.eye(6)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.normal(size=(poses, 6)))
    est = make_pose(Rotation.random(poses, random_state=3), rng.normal(size=(poses, 3)))
    ref = make_pose(est.rotation * Rotation.from_rotvec(error[:, :3]), est.translation + error[:, 3:])
    return est, ref, covariances


def test_nees_of_true_covariances_is_one_and_is_filterpys() -> None:
    est, ref, covariances = drawn(np.random.default_rng(2), 3000, 1.0)
    nees = pose_nees(est, ref, covariances)
    low, high = mean_bounds(6, 3000, confidence=0.999)
    assert low < nees.mean() < high
    error = np.hstack([(est.rotation.inv() * ref.rotation).as_rotvec(), ref.translation - est.translation])
    oracle = NEES(error[:50], np.zeros((50, 6)), covariances[:50])
    np.testing.assert_allclose(nees[:50], np.ravel(oracle) / 6, rtol=1e-6)
    np.testing.assert_allclose(pose_nees(est, ref, covariances / 4), 4 * nees, rtol=1e-9)


def test_camera_pose_covariances_give_the_same_nees_either_way() -> None:
    """[e_r, e_t] of the estimate about the truth, or of the truth about the estimate: the signs cancel."""
    est, ref, covariances = drawn(np.random.default_rng(4), 40, 3.0)
    np.testing.assert_allclose(pose_nees(est, ref, covariances), pose_nees(ref, est, covariances), rtol=1e-9)


def test_unusable_covariances_have_no_nees() -> None:
    est, ref, covariances = drawn(np.random.default_rng(5), 5, 1.0)
    covariances[0], covariances[1], covariances[2, 0, 0] = np.nan, 0.0, -1.0
    covariances[3] = np.ones((6, 6))
    assert np.isnan(pose_nees(est, ref, covariances)).tolist() == [True, True, True, True, False]
    assert len(pose_nees(est[:0], ref[:0], covariances[:0])) == 0
