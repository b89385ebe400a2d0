"""Odometry and constant velocity in the place of an IMU, and what happens without an IMU's samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from fusion import odometry
from fusion.fuse import fuse
from fusion.motion_source import scaled_noise
from fusion.nav_state import StateLayout, local_state, nominal_state, retract_state
from fusion.options import FuseOptions, Imu, Start
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.input_error import InputError
from poet_loc.core.records import ImuSamples
from poet_loc.core.trajectory import Trajectory


def test_the_imu_is_believed_as_far_as_the_options_say(log):
    noise = log.calibration.imu
    scaled = scaled_noise(noise, FuseOptions(imu=Imu(noise_scale=10.0, walk_scale=3.0)))
    assert scaled.gyroscope_noise_density == 10.0 * noise.gyroscope_noise_density
    assert scaled.accelerometer_noise_density == 10.0 * noise.accelerometer_noise_density
    assert scaled.gyroscope_random_walk == 3.0 * noise.gyroscope_random_walk
    assert scaled.accelerometer_random_walk == 3.0 * noise.accelerometer_random_walk
    louder = fuse(log, FuseOptions(imu=Imu(noise_scale=10.0)))
    assert np.median(louder.sigmas[:, 6:9]) > 1.5 * np.median(fuse(log).sigmas[:, 6:9])


def test_odometry_returns_its_own_poses():
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(20_000_000, 50_000_000, size=30)).astype(np.int64)
    steps = RigidTransform.from_exp_coords(0.2 * rng.normal(size=(30, 6)))
    poses = [steps[0]]
    for step in steps[1:]:
        poses.append(poses[-1] * step)
    T_odom_cam = Trajectory(stamps, RigidTransform.concatenate(poses))
    samples = odometry.odometry_samples(T_odom_cam, RigidTransform.identity())
    x = nominal_state(StateLayout(), T_world_imu=poses[0])
    for k, dt in enumerate(np.diff(stamps) * 1e-9):
        for share in (0.3, 0.7):  # in two parts: the twist is constant between two poses
            twist = samples.angular_velocity[k], samples.specific_force[k]
            odometry.move_by_odometry(x, share * dt, *twist, np.zeros(64))
    np.testing.assert_allclose(x[9:12], poses[-1].translation, atol=1e-9)
    np.testing.assert_allclose(x[:9].reshape(3, 3), poses[-1].rotation.as_matrix(), atol=1e-9)


def test_odometry_spreads_covariance_by_its_derivative():
    rng = np.random.default_rng(1)
    layout = StateLayout(n_objects=1, extrinsics=True, bias_kinds=1)
    n, dt = layout.n_error, 0.3
    x = nominal_state(layout, T_world_imu=RigidTransform.from_exp_coords(rng.normal(size=6)))
    rate, velocity, work = rng.normal(size=3), rng.normal(size=3), np.zeros(64)

    def moved(state):
        state = state.copy()
        odometry.move_by_odometry(state, dt, rate, velocity, work)
        return state

    F, after = np.zeros((n, n)), moved(x)
    for j in range(n):
        error = 1e-6 * np.eye(n)[j]
        ahead, behind = moved(retract_state(x, error, layout)), moved(retract_state(x, -error, layout))
        F[:, j] = (local_state(after, ahead, layout) - local_state(after, behind, layout)) / 2e-6
    F[6:9] = np.eye(n)[6:9]  # the velocity is odometry's own and carries no error of the state
    A = rng.normal(size=(n, n))
    P = A @ A.T
    spread = P.copy()
    moved(x)
    odometry.spread_by_odometry(spread, x[:9].copy(), dt, np.zeros(12), np.zeros(9), layout.as_integers(), work)
    np.testing.assert_allclose(spread, F @ P @ F.T, atol=1e-6 * np.abs(P).max())


@pytest.fixture(scope="module")
def log():
    return simulate(SimulationOptions(duration_s=15.0, noise="white", objects=5, odometry=True, seed=2))


def rmse(result, log) -> float:
    truth = log.T_world_imu.between(int(result.stamps_ns[0]), int(result.stamps_ns[-1]))
    estimate, _ = result.trajectory.interpolate(truth.stamps_ns)
    return float(np.sqrt(np.mean(np.sum((estimate.translation - truth.T_world_body.translation) ** 2, axis=1))))


@pytest.mark.parametrize("motion", ["odometry", "constant-velocity"])
def test_a_log_without_imu_is_fused(log, motion):
    without = replace(log, imu=None)
    result = fuse(without, FuseOptions(motion=motion))
    assert result.motion == motion
    assert result.body == "imu"
    assert rmse(result, log) < 0.04


def test_auto_takes_the_best_there_is_and_says_so(log):
    assert fuse(log).motion == "imu+odometry"
    assert fuse(log, FuseOptions(estimator="graph")).motion == "imu+odometry"
    assert fuse(replace(log, T_odom_cam=None)).motion == "imu"
    assert fuse(replace(log, imu=None)).motion == "odometry"
    assert fuse(replace(log, imu=None, T_odom_cam=None)).motion == "constant-velocity"
    with pytest.raises(InputError, match=r"imu\.csv"):
        fuse(replace(log, imu=None), FuseOptions(motion="imu"))


def blinded(log, first_s: float, last_s: float):
    """Return the log without detections in this time."""
    seconds = (log.object_poses[""].stamps_ns - log.imu.stamps_ns[0]) * 1e-9
    return replace(log, object_poses={"": log.object_poses[""][(seconds < first_s) | (seconds > last_s)]})


def test_odometry_beside_the_imu_holds_the_drift_of_a_gap():
    drift, sigma, nees = {}, {}, []
    for seed in range(4):
        log = blinded(simulate(SimulationOptions(duration_s=14.0, noise="white", odometry=True, seed=seed)), 6.0, 12.0)
        at = int(log.imu.stamps_ns[0]) + 12 * 10**9
        for motion in ("imu", "imu+odometry"):
            result = fuse(log, FuseOptions(motion=motion))
            assert result.motion == motion
            assert len(result.gate) == len(log.object_poses[""])
            row = np.searchsorted(result.stamps_ns, at)
            truth, _ = log.T_world_imu.interpolate(result.stamps_ns[[row]])
            error = result.T_world_imu.translation[row] - truth.translation[0]
            drift.setdefault(motion, []).append(np.linalg.norm(error))
            sigma.setdefault(motion, []).append(np.linalg.norm(result.sigmas[row, 3:6]))
            if motion != "imu":
                nees.append(error @ np.linalg.solve(result.pose_covariances[row, 3:, 3:], error) / 3.0)
    assert np.mean(drift["imu+odometry"]) < 0.3 * np.mean(drift["imu"])
    assert np.mean(sigma["imu+odometry"]) < 0.5 * np.mean(sigma["imu"])
    assert np.mean(nees) < 3.0


def test_odometry_beside_the_imu_is_smoothed_and_must_be_there(log):
    options = FuseOptions(motion="imu+odometry")
    gap = blinded(log, 6.0, 10.0)
    assert rmse(fuse(gap, replace(options, smooth=True)), log) < rmse(fuse(gap, options), log)
    with pytest.raises(InputError, match=r"T_odom_cam\.tum"):
        fuse(replace(log, T_odom_cam=None), options)
    with pytest.raises(InputError, match="has one pose"):
        fuse(replace(log, T_odom_cam=log.T_odom_cam[:1]), options)


def test_without_calibration_the_camera_itself_is_followed(log):
    result = fuse(replace(log, imu=None, calibration=None))
    assert result.body == "cam"
    truth = log.T_world_cam.between(int(result.stamps_ns[0]), int(result.stamps_ns[-1]))
    estimate, _ = result.trajectory.interpolate(truth.stamps_ns)
    error = np.linalg.norm(estimate.translation - truth.T_world_body.translation, axis=1)
    assert np.median(error) < 0.03


def test_a_gap_of_the_imu_is_bridged_with_growing_sigma(log):
    keep = (log.imu.stamps_ns < log.imu.stamps_ns[0] + 6_000_000_000) | (
        log.imu.stamps_ns > log.imu.stamps_ns[0] + 7_000_000_000
    )
    samples = ImuSamples(log.imu.stamps_ns[keep], log.imu.angular_velocity[keep], log.imu.specific_force[keep])
    result, whole = fuse(replace(log, imu=samples)), fuse(log)
    end = int(log.imu.stamps_ns[0]) + 7_000_000_000
    at, at_whole = np.searchsorted(result.stamps_ns, end), np.searchsorted(whole.stamps_ns, end)
    assert np.all(np.isfinite(result.sigmas))
    assert result.sigmas[at, 6:9].max() > 2 * whole.sigmas[at_whole, 6:9].max()
    assert rmse(result, log) < 0.1


@pytest.mark.parametrize(("estimator", "given"), [("eskf", False), ("eskf", True), ("graph", False), ("batch", False)])
def test_a_guessed_motion_is_given_up_while_nothing_is_seen_and_starts_again(estimator, given):
    """From votes, also where the log's first pose was given: the camera is elsewhere by then."""
    log = simulate(SimulationOptions(seed=3, objects=4, duration_s=18.0, noise="network", symmetric_objects=0))
    poses = log.object_poses[""]
    since = (poses.stamps_ns - poses.stamps_ns[0]) * 1e-9
    log = replace(log, imu=None, object_poses={"": poses[(since % 8.0) < 3.0]})
    assert log.T_world_imu is not None
    T, _ = log.T_world_imu.interpolate(poses.stamps_ns[:1])
    start = Start(pose=(*T.translation[0], *T.rotation.as_quat()[0])) if given else Start()
    result = fuse(log, FuseOptions(estimator=estimator, motion="constant-velocity", start=start))
    seconds = (result.stamps_ns - poses.stamps_ns[0]) * 1e-9
    assert result.restarts == 2
    assert not ((seconds > 6.5) & (seconds < 8.0)).any()
    assert np.sum(result.sigmas[:, :3] ** 2, axis=1).max() < 1.01 * np.pi**2  # the batch's own, the filter gave up
    seen = (seconds % 8.0 > 0.2) & (seconds % 8.0 < 3.0)
    truth, _ = log.T_world_imu.interpolate(result.stamps_ns)
    off = np.linalg.norm(result.trajectory.T_world_body.translation - truth.translation, axis=1)
    assert off[seen].max() < 0.1
