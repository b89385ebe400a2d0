"""The simulated world against gtsam, against its own truth, and against the statistics that its options state."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.detection_errors import NetworkErrors, gauss_markov, ray_axes, run_numbers, runs
from fusion.monte_carlo import simulate_runs
from fusion.motion import Motion
from fusion.simulate import SimulationOptions, simulate, simulate_with_truth
from poet_loc.core.geometry import local
from poet_loc.core.records import ImuNoise
from poet_loc.core.trajectory import Trajectory

SHORT = SimulationOptions(duration_s=12.0, seed=3)
EXACT = replace(SHORT, noise="none", imu_errors=False)


def detections_truth(log, detections):
    """True T_cam_obj of each detection, from the log's own ground truth and map."""
    poses = log.T_world_cam.T_world_body[np.searchsorted(log.T_world_cam.stamps_ns, detections.stamps_ns)]
    return poses.inv() * log.landmark_map.T_world_obj[detections.object_ids - 1]


@pytest.mark.parametrize(("rate_hz", "tolerance"), [(200.0, 3e-4), (800.0, 2e-5)])
def test_gtsam_preintegration_of_exact_samples_returns_the_motion(rate_hz, tolerance):
    log, truth = simulate_with_truth(replace(EXACT, imu_rate_hz=rate_hz))
    imu = log.imu
    parameters = gtsam.PreintegrationParams.MakeSharedU(9.81)
    for set_covariance in (
        parameters.setAccelerometerCovariance,
        parameters.setGyroscopeCovariance,
        parameters.setIntegrationCovariance,
    ):
        set_covariance(np.eye(3))
    zero = gtsam.imuBias.ConstantBias()
    integrated = gtsam.PreintegratedImuMeasurements(parameters, zero)
    steps = np.diff(imu.stamps_ns) * 1e-9
    middle_w = 0.5 * (imu.angular_velocity[1:] + imu.angular_velocity[:-1])
    middle_a = 0.5 * (imu.specific_force[1:] + imu.specific_force[:-1])
    ends = imu.stamps_ns[[0, -1]]
    pose, velocity = truth.motion.pose(ends), truth.motion.velocity(ends)
    end = gtsam.NavState(gtsam.Pose3(pose[0].as_matrix()), velocity[0])
    for a, w, dt in zip(Rotation.from_rotvec(middle_w * steps[:, None] / 2).apply(middle_a), middle_w, steps):
        integrated.resetIntegration()
        integrated.integrateMeasurement(a, w, dt)
        end = integrated.predict(end, zero)
    assert np.linalg.norm(end.position() - pose[1].translation) < tolerance
    assert np.linalg.norm(end.velocity() - velocity[1]) < tolerance
    assert (Rotation.from_matrix(end.attitude().matrix()).inv() * pose[1].rotation).magnitude() < tolerance


def test_starts_level_with_gravity_at_rest():
    log, truth = simulate_with_truth(EXACT)
    still = log.imu.stamps_ns < log.imu.stamps_ns[0] + 900_000_000
    assert np.abs(log.imu.angular_velocity[still]).max() < 1e-4
    up = truth.motion.pose(log.imu.stamps_ns[still]).rotation.apply(log.imu.specific_force[still])
    np.testing.assert_allclose(up, np.tile([0.0, 0.0, 9.81], (still.sum(), 1)), atol=1e-3)


def test_a_motion_through_a_given_trajectory_passes_through_it():
    log = simulate(EXACT)
    sparse = log.T_world_imu[::20]
    motion = Motion.through(Trajectory(sparse.stamps_ns, sparse.T_world_body))
    assert np.abs(local(sparse.T_world_body, motion.pose(sparse.stamps_ns))).max() < 1e-9


def test_noise_free_detections_are_exact_and_in_view():
    log = simulate(EXACT)
    detections = log.object_poses[""]
    assert np.abs(local(detections_truth(log, detections), detections.T_cam_obj)).max() < 1e-9
    fx, _, cx, _ = log.calibration.camera.intrinsics
    x, _, z = detections.T_cam_obj.translation.T
    assert z.min() > 0.1
    assert (fx * x / z + cx).min() > 0
    assert (fx * x / z + cx).max() < 640
    assert np.all(np.diff(detections.stamps_ns) >= 0)
    frames = np.bincount(detections.frames)
    assert frames.max() == 8
    assert frames.min() < 8, "objects leave the view now and then"


def test_white_errors_match_their_written_covariance():
    log = simulate(replace(SHORT, noise="white", duration_s=40.0))
    detections = log.object_poses[""]
    truth = detections_truth(log, detections)
    errors = np.hstack(
        [
            (detections.T_cam_obj.rotation * truth.rotation.inv()).as_rotvec(),
            detections.T_cam_obj.translation - truth.translation,
        ]
    )
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(detections.covariances), errors)
    assert abs(squares.mean() / 6.0 - 1.0) < 5.0 * np.sqrt(2.0 / (6.0 * len(errors)))
    along = np.einsum("ni,ni->n", errors[:, 3:], truth.translation) / np.linalg.norm(truth.translation, axis=1)
    assert along.std() == pytest.approx(0.02 * np.linalg.norm(truth.translation, axis=1).mean(), rel=0.1)


def test_network_errors_have_the_stated_structure():
    options = replace(SimulationOptions(seed=5), duration_s=120.0)
    log, truth = simulate_with_truth(options)
    detections = log.object_poses[""]
    measured, exact = detections.T_cam_obj, detections_truth(log, detections)
    offset = np.linalg.norm(measured.translation - exact.translation, axis=1)
    angle = np.degrees((measured.rotation * exact.rotation.inv()).magnitude())
    wrong = (offset > 0.1) | (angle > 20.0)
    assert np.mean(wrong[truth.gross]) > 0.9
    assert np.mean(wrong[~truth.gross & ~truth.flipped]) < 0.02
    assert 0.03 < truth.gross.mean() < 0.10
    assert set(detections.object_ids[truth.flipped]) == {7, 8}
    rays = ray_axes(exact.translation)
    in_ray = np.einsum("nij,ni->nj", rays, truth.inlier_errors[:, 3:])
    assert in_ray[:, 2].std() > 2.5 * in_ray[:, :2].std(), "depth dominates"
    white = truth.inlier_errors - truth.slow_errors
    share = (white[:, :3] ** 2).mean() / (truth.inlier_errors[:, :3] ** 2).mean()
    assert 0.15 < share < 0.35
    assert detections.covariances is None
    assert simulate(replace(SHORT, covariances=True)).object_poses[""].covariances is not None


def test_markov_chains_keep_their_share_length_and_correlation():
    rng = np.random.default_rng(0)
    mask = runs(20_000, 20, 0.1, 15.0, rng)
    assert mask.mean() == pytest.approx(0.1, abs=0.01)
    numbers = run_numbers(mask)
    assert mask.sum() / (numbers.max() + 1) == pytest.approx(15.0, rel=0.1)
    assert np.all(numbers[~mask] == -1)
    assert not runs(10, 2, 0.0, 5.0, rng).any()
    values = gauss_markov(20_000, (20,), 1.0 / 100.0, rng)
    assert values.var() == pytest.approx(1.0, rel=0.1)
    assert (values[100:] * values[:-100]).mean() == pytest.approx(np.exp(-1.0), abs=0.05)


def test_flips_are_symmetries_of_the_object():
    quiet = NetworkErrors(across_m=0, along_of_depth=0, rotation_deg=0, gross_share=0, flip_share=0.5)
    log, truth = simulate_with_truth(replace(SHORT, network=quiet))
    detections = log.object_poses[""]
    turned = detections_truth(log, detections).inv() * detections.T_cam_obj
    assert np.abs(turned.translation).max() < 1e-9
    rotvec = turned.rotation.as_rotvec()
    assert np.abs(rotvec[~truth.flipped]).max() < 1e-9
    flipped = rotvec[truth.flipped]
    assert len(flipped) > 100
    assert np.abs(flipped[:, :2]).max() < 1e-6, "about z"
    orders = {landmark.object_id: landmark.symmetry.order for landmark in log.landmark_map if landmark.symmetry}
    halves = detections.object_ids[truth.flipped] == next(key for key, order in orders.items() if order == 2)
    np.testing.assert_allclose(np.abs(flipped[halves, 2]), np.pi, atol=1e-6)
    assert np.abs(flipped[~halves, 2]).std() > 0.1


def test_imu_errors_have_kalibrs_densities():
    noise = ImuNoise(1e-3, 1e-2, 1e-3, 1e-2, 0.0)
    options = replace(SHORT, duration_s=100.0, imu_noise=noise)
    log, truth = simulate_with_truth(options)
    exact = truth.motion.imu_samples(log.imu.stamps_ns)
    white = log.imu.specific_force - exact.specific_force - truth.accelerometer_bias
    assert white.std() == pytest.approx(1e-2 * np.sqrt(200.0), rel=0.02)
    steps = np.diff(truth.gyroscope_bias, axis=0)
    assert steps.std() == pytest.approx(1e-3 * np.sqrt(1 / 200.0), rel=0.02)
    assert log.calibration.imu.update_rate == 200.0


def test_time_shift_and_delay_move_the_camera_stamps_as_their_signs_say():
    log, truth = simulate_with_truth(replace(EXACT, timeshift_cam_imu_s=0.02, stamp_delay_s=0.05))
    detections = log.object_poses[""]
    on_imu_clock = detections.stamps_ns + 20_000_000
    exposure = on_imu_clock - 50_000_000
    T_cam_imu = log.calibration.T_cam_imu
    seen = T_cam_imu * truth.motion.pose(exposure).inv() * log.landmark_map.T_world_obj[detections.object_ids - 1]
    assert np.abs(local(seen, detections.T_cam_obj)).max() < 1e-9
    camera = truth.motion.pose(log.T_world_cam.stamps_ns + 20_000_000) * T_cam_imu.inv()
    assert np.abs(local(camera, log.T_world_cam.T_world_body)).max() < 1e-9


def test_camera_poses_odometry_and_disturbed_map():
    options = replace(
        SHORT, camera_poses=True, odometry=True, map_position_sigma_m=0.05, map_rotation_sigma_deg=3.0, objects=40
    )
    log, truth = simulate_with_truth(options)
    poses = log.camera_poses
    exact = log.T_world_cam.T_world_body
    errors = np.hstack(
        [
            (exact.rotation.inv() * poses.T_world_cam.rotation).as_rotvec(),
            poses.T_world_cam.translation - exact.translation,
        ]
    )
    np.testing.assert_allclose(errors.std(axis=0), np.sqrt(poses.covariances[0].diagonal()), rtol=0.2)
    odometry = log.T_odom_cam.T_world_body
    assert np.abs(local(odometry[0], odometry[0] * odometry[0].inv())).max() < 1e-12
    drift = local(exact[:-1].inv() * exact[1:], odometry[:-1].inv() * odometry[1:]) * np.sqrt(30.0)
    assert drift[:, 3:].std() == pytest.approx(0.004, rel=0.15)
    assert np.degrees(drift[:, :3].std()) == pytest.approx(0.12, rel=0.15)
    off = local(log.landmark_map.T_world_obj, truth.landmark_map.T_world_obj)
    np.testing.assert_allclose(
        off.std(axis=0) / np.sqrt(log.landmark_map.landmarks[0].covariance.diagonal()), 1, atol=0.4
    )


def test_one_seed_is_one_world_and_switches_do_not_touch_each_other():
    first, again, other = simulate(SHORT), simulate(SHORT), simulate(replace(SHORT, seed=4))
    np.testing.assert_array_equal(first.imu.specific_force, again.imu.specific_force)
    np.testing.assert_array_equal(
        first.object_poses[""].T_cam_obj.as_matrix(), again.object_poses[""].T_cam_obj.as_matrix()
    )
    assert not np.array_equal(first.imu.specific_force, other.imu.specific_force)
    more = simulate(replace(SHORT, odometry=True, camera_poses=True, noise="white"))
    np.testing.assert_array_equal(first.imu.specific_force, more.imu.specific_force)


def final_position(seed: int) -> list[float]:
    options = SimulationOptions(duration_s=3.0, seed=seed, noise="none")
    return [float(x) for x in simulate(options).imu.specific_force[-1]]


def test_results_do_not_depend_on_the_number_of_workers():
    seeds = [5, 1, 3, 2]
    alone = simulate_runs(final_position, seeds)
    assert alone == [final_position(seed) for seed in seeds]
    assert simulate_runs(final_position, seeds, workers=2) == alone


def test_a_local_cluster_gives_the_same_results():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        assert simulate_runs(final_position, [4, 2], client=client) == simulate_runs(final_position, [4, 2])
