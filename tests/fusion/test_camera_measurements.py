"""Camera poses as measurements: errors that last count for as little as they tell, at any frame rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.detection_errors import gauss_markov
from fusion.fuse import fuse
from fusion.online import Estimator
from fusion.options import CameraNoise, FuseOptions
from fusion.prepare import camera_measurements
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.consistency import pose_nees
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
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


def test_camera_poses_of_the_logs_own_whose_errors_last():
    options, lasting_s, found = FuseOptions(measurements="camera"), 2.0, {0.0: [], 2.0: []}
    for seed in range(3):
        log = simulate(SimulationOptions(duration_s=30.0, imu_rate_hz=100.0, camera_poses=True, seed=seed))
        given, rng = log.camera_poses, np.random.default_rng(seed)
        sigma = np.repeat([np.radians(1.0), 0.02], 3)
        error = sigma * gauss_markov(len(given.stamps_ns), (6,), 1.0 / 30.0 / lasting_s, rng)
        true, _ = log.T_world_cam.interpolate(given.stamps_ns)
        T = make_pose(true.rotation * Rotation.from_rotvec(error[:, :3]), true.translation + error[:, 3:])
        log = replace(log, camera_poses=replace(given, T_world_cam=T))
        for said_s, nees in found.items():
            result = fuse(log, replace(options, camera_noise=CameraNoise(correlation_s=said_s)))
            truth, known = log.T_world_imu.interpolate(result.stamps_ns)
            nees.append(pose_nees(result.T_world_imu[known], truth[known], result.pose_covariances[known]).mean())
    assert np.mean(found[0.0]) > 8.0
    assert np.mean(found[2.0]) < 2.0


@pytest.mark.parametrize("estimator", ["eskf", "graph"])
@pytest.mark.parametrize(("sigma", "rate_hz"), [(0.001, 10.0), (0.02, 30.0)])
@pytest.mark.parametrize("rest_s", [0.0, 1.0])
def test_a_start_is_as_near_as_its_sigmas_say_also_in_motion(estimator, sigma, rate_hz, rest_s):
    at_first, worst = [], []
    for seed in range(6):
        wanted = {"duration_s": 6.0, "imu_rate_hz": 100.0, "camera_rate_hz": rate_hz, "rest_s": rest_s, "seed": seed}
        accuracy = {"camera_pose_position_sigma_m": sigma, "camera_pose_rotation_sigma_deg": 50.0 * sigma}
        log = simulate(SimulationOptions(camera_poses=True, **wanted, **accuracy))
        result = fuse(log, FuseOptions(measurements="camera", estimator=estimator))
        truth, known = log.T_world_imu.interpolate(result.stamps_ns)
        at_first.append(pose_nees(result.T_world_imu[known], truth[known], result.pose_covariances[known])[0])
        error = np.linalg.norm(result.T_world_imu.translation - truth.translation, axis=1)[known]
        worst.append(error.max())
        assert result.restarts == 0
    assert np.mean(at_first) < 2.0
    assert np.max(worst) < 0.02 + 5.0 * sigma


def test_online_tells_that_it_does_not_know_the_rate():
    log = simulate(SimulationOptions(duration_s=1.0, camera_poses=True))
    options = FuseOptions(measurements="camera", camera_noise=CameraNoise(correlation_s=2.0))
    with pytest.raises(InputError, match="whole logs"):
        Estimator(log.calibration, None, options)
