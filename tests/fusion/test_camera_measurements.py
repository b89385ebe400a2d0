"""Camera poses as measurements: errors that last count for as little as they tell, at any frame rate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.detection_errors import gauss_markov
from fusion.fuse import fuse
from fusion.guessed_motion import shown_motion
from fusion.online import Estimator
from fusion.options import CameraNoise, ConstantVelocity, FuseOptions
from fusion.prepare import camera_measurements
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.consistency import pose_nees
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, CameraPoses, ImuNoise, ImuSamples
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log


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


def in_motion(seed: int, speed: float, rate_hz: float, sigma: float = 0.02) -> Log:
    """Return a log whose camera, at the IMU, moves from the first pose on; covariances are right."""
    rng, seconds = np.random.default_rng(seed), np.arange(0.0, 12.0, 0.01)
    rates, phases = np.array([0.9, 1.3, 0.7]), rng.uniform(0.0, 6.28, 3)
    angles = rates * seconds[:, None] + phases
    turns = Rotation.from_rotvec(0.3 * np.sin(angles[:, ::-1]))
    T_world_imu = make_pose(turns, speed * np.sin(angles) / rates)
    force = turns.inv().apply(-speed * rates * np.sin(angles) + [0.0, 0.0, 9.81])
    rate = (turns[:-2].inv() * turns[2:]).as_rotvec() / 0.02
    stamps = 10**18 + np.round(seconds * 1e9).astype(np.int64)
    seen = np.arange(0, len(seconds), round(100.0 / rate_hz))
    R = np.diag(np.repeat([np.radians(50.0 * sigma), sigma], 3) ** 2)
    drawn = rng.multivariate_normal(np.zeros(6), R, len(seen))
    T = T_world_imu[seen]
    T = make_pose(T.rotation * Rotation.from_rotvec(drawn[:, :3]), T.translation + drawn[:, 3:])
    return Log(
        path=Path("in motion"),
        imu=ImuSamples(stamps, np.vstack([rate[:1], rate, rate[-1:]]), force),
        calibration=Calibration(T_cam_imu=RigidTransform.identity(), imu=ImuNoise(1e-3, 1e-2, 1e-4, 1e-3, 100.0)),
        camera_poses=CameraPoses(stamps[seen], np.arange(len(seen)), T, np.tile(R, (len(seen), 1, 1))),
        T_world_imu=Trajectory(stamps, T_world_imu),
    )


CAMERA = FuseOptions(measurements="camera")


@pytest.mark.parametrize(("speed", "rate_hz"), [(0.8, 2.0), (1.5, 10.0)])
def test_camera_poses_in_brisk_motion_start_the_filter(speed, rate_hz):
    for seed in range(4):
        log = in_motion(seed, speed, rate_hz)
        result = fuse(log, CAMERA)
        truth, _ = log.T_world_imu.interpolate(result.stamps_ns)
        away = np.linalg.norm(result.T_world_imu.translation - truth.translation, axis=1)
        assert (result.stamps_ns[0] - log.imu.stamps_ns[0]) * 1e-9 < 6.0
        assert away.max() < 0.25
        assert result.restarts == 0


def test_what_hinders_a_start_from_camera_poses_is_named():
    with pytest.raises(InputError, match=r"1-sigma.*--start\.max-distance 1\.04 --start\.max-angle-deg 52"):
        fuse(in_motion(0, 0.5, 10.0, sigma=0.3), CAMERA)
    with pytest.raises(InputError, match=r"never started.*they move at \d\.\d m/s: --start\.max-camera-speed \d\.\d"):
        fuse(in_motion(0, 8.0, 2.0), CAMERA)


def test_without_imu_the_motion_is_as_lively_as_camera_poses_show():
    """A body of white acceleration: second differences over a lag tell its density, errors of the poses taken off."""
    rng, dt, density, sigma = np.random.default_rng(4), 0.02, np.array([2.0, 3.0]), np.array([0.02, 0.01])
    walks = [np.cumsum(np.cumsum(q * rng.standard_normal((6000, 3)) * np.sqrt(dt), 0) * dt, 0) for q in density]
    stamps = np.round(np.arange(6000) * dt * 1e9).astype(np.int64)
    place, angle = walks[0], 1e-3 * walks[1]  # angles small enough to add up
    R = np.diag(np.repeat([1e-3, 1.0] * sigma, 3) ** 2)
    drawn = rng.multivariate_normal(np.zeros(6), R, len(stamps))
    T = make_pose(Rotation.from_rotvec(angle + drawn[:, :3]), place + drawn[:, 3:])
    seen = CameraPoses(stamps, np.arange(len(stamps)), T, np.tile(R, (len(stamps), 1, 1)))
    model = ConstantVelocity(acceleration=1e-6, angular_acceleration=1e-6)
    found = shown_motion(camera_measurements(seen, Calibration(), CAMERA), model)
    assert found == pytest.approx(density * [1.0, 1e-3], rel=0.15)
    assert shown_motion(camera_measurements(seen, Calibration(), CAMERA), ConstantVelocity()) == (found[0], 0.6)
    assert shown_motion(camera_measurements(seen[:9], Calibration(), CAMERA), model) == (1e-6, 1e-6)


def test_without_imu_camera_poses_in_brisk_motion_are_followed():
    log = in_motion(1, 1.5, 30.0)
    result = fuse(replace(log, imu=None), CAMERA)
    truth, _ = log.T_world_imu.interpolate(result.stamps_ns)
    away = np.linalg.norm(result.T_world_imu.translation - truth.translation, axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.035  # that of the poses
    assert result.restarts == 0
