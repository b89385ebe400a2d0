"""Camera poses as measurements: errors that last count for as little as they tell, at any frame rate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.spatial.transform import RigidTransform

from fusion.options import FuseOptions
from fusion.prepare import camera_measurements
from poet_loc.core.records import Calibration, CameraPoses


def poses(stamps_ns: np.ndarray) -> CameraPoses:
    count = len(stamps_ns)
    covariances = np.tile(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), (count, 1, 1))
    T_world_cam = RigidTransform.concatenate([RigidTransform.identity()] * count)
    return CameraPoses(stamps_ns, np.arange(count), T_world_cam, covariances)


@pytest.mark.parametrize("rate_hz", [1.0, 7.0, 30.0])
def test_the_mean_of_many_is_as_sure_as_that_of_correlated_ones(rate_hz):
    lasting_s, count = 2.4, 4000
    stamps = np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    scaled = camera_measurements(poses(stamps), Calibration(), FuseOptions(), lasting_s).covariances
    correlation = toeplitz(np.exp(-np.arange(count) / rate_hz / lasting_s))
    of_mean = correlation.mean()  # the variance of the mean of errors of variance 1
    np.testing.assert_allclose(scaled[0], count * of_mean * np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), rtol=0.03)


def test_white_ones_and_repeated_stamps_stay_as_they_are():
    stamps = np.array([0, 0, 0, 0, 10**9], dtype=np.int64)
    white = camera_measurements(poses(stamps), Calibration(), FuseOptions())
    np.testing.assert_array_equal(white.covariances, poses(stamps).covariances)
    lasting = camera_measurements(poses(stamps), Calibration(), FuseOptions(), 2.4).covariances
    assert np.isfinite(lasting).all()
    one = camera_measurements(poses(stamps[:1]), Calibration(), FuseOptions(), 2.4)
    np.testing.assert_array_equal(one.covariances, poses(stamps[:1]).covariances)
