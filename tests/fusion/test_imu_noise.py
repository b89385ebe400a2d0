"""The IMU's noise as its samples show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.fuse import fuse
from fusion.imu_noise import ACCEL_SQUARES, GYRO_SQUARES, WEIGHT, follow_noise, imu_rows
from fusion.options import FuseOptions, Imu
from poet_loc.core.consistency import pose_nees
from poet_loc.core.records import ImuSamples
from poet_loc.io.log_folder import read_log

GYRO, ACCEL = 3e-4, 4e-3  # rad/s/sqrt(Hz), m/s^2/sqrt(Hz)


def samples(rate_hz=200.0, seconds=60.0, motion=0.0, seed=0):
    """Return white noise of known density on a sinusoid of 4 Hz (rad/s and ten times as many m/s^2)."""
    rng, count = np.random.default_rng(seed), round(rate_hz * seconds)
    t = np.arange(count) / rate_hz
    wave = motion * np.sin(2.0 * np.pi * 4.0 * t)[:, None]
    gyro, accel = (rng.normal(0.0, density * np.sqrt(rate_hz), (count, 3)) for density in (GYRO, ACCEL))
    return ImuSamples(np.round(t * 1e9).astype(np.int64), wave + gyro, 10.0 * wave + accel + [0.0, 0.0, 9.81])


def densities(rows):
    return np.sqrt(rows[:, [GYRO_SQUARES, ACCEL_SQUARES]] / rows[:, [WEIGHT]])


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 1000.0])
def test_the_density_of_white_noise_is_found_whatever_the_rate(rate_hz):
    np.testing.assert_allclose(densities(imu_rows(samples(rate_hz))[-1:])[0], [GYRO, ACCEL], rtol=0.1)


def test_motion_is_no_noise():
    at_rest, moving = (densities(imu_rows(samples(motion=motion))[-1:])[0] for motion in (0.0, 1.0))
    np.testing.assert_allclose(moving, at_rest, rtol=0.05)


def test_it_is_the_weighted_mean_of_squared_fourth_differences():
    imu = samples(seconds=3.0)
    values = np.hstack([imu.angular_velocity, imu.specific_force])
    squares = np.diff(values, 4, axis=0) ** 2 / 70.0 * 0.005
    weights = np.exp(-np.arange(len(squares))[::-1] * 0.005 / 5.0)
    mean = weights @ squares / weights.sum()
    np.testing.assert_allclose(densities(imu_rows(imu)[-1:])[0] ** 2, [mean[:3].mean(), mean[3:].mean()], rtol=1e-6)


def test_nothing_is_learnt_across_a_hole():
    imu = samples(seconds=10.0, motion=1.0)
    kept = (imu.stamps_ns < 4_000_000_000) | (imu.stamps_ns > 4_300_000_000)
    whole, holed = imu_rows(imu), imu_rows(imu[kept])
    np.testing.assert_allclose(densities(holed[-1:]), densities(whole[-1:]), rtol=0.05)


def test_rows_can_be_followed_piece_by_piece():
    imu = samples(seconds=2.0)
    whole = imu_rows(imu)
    rows = whole.copy()
    rows[100:, GYRO_SQUARES:] = 0.0
    for k in range(100, len(rows)):
        follow_noise(imu.stamps_ns, rows, k, k + 1)
    np.testing.assert_array_equal(rows, whole)


@pytest.mark.parametrize("estimator", ["eskf", "graph"])
def test_a_shaken_imu_makes_a_real_log_no_surer_than_it_is(shared_data, estimator):
    """EuRoC's stated densities are a tenth and less of what its IMU shows in flight: believed, NEES/dof is about 11."""
    log = read_log(shared_data / "euroc_v101")

    def nees(options):
        result = fuse(log, replace(options, estimator=estimator))
        reference, inside = log.T_world_imu.interpolate(result.stamps_ns)
        return np.mean(pose_nees(result.T_world_imu, reference, result.pose_covariances)[inside])

    assert nees(FuseOptions(imu=Imu(measured=False))) > 5.0
    assert 0.5 < nees(FuseOptions()) < 2.0
