"""A simulated table-top world: known motion -> IMU samples and object poses with known noise.

Everything comes from the seed; switching one thing on or off leaves the random numbers of the others as they were.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.motion import Motion, hand_held_flight
from fusion.simulated_detections import Mask, Stamps, detect_objects
from fusion.simulation_options import Displacement, SimulationOptions
from fusion.table_top import displaced_map, disturbed_map, table_top
from poet_loc.core.geometry import make_pose, retract
from poet_loc.core.records import (
    Calibration,
    Camera,
    CameraPoses,
    ImuNoise,
    ImuSamples,
    LandmarkMap,
)
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log

__all__ = ["Displacement", "SimulationOptions", "SimulationTruth", "simulate", "simulate_with_truth"]

Array = NDArray[np.float64]

_START_NS = 1_700_000_000_000_000_000
_MARGIN_S = 0.1  # the IMU runs this much longer than the camera at both ends


@dataclass(frozen=True)
class SimulationTruth:
    """What a simulated log does not say: the motion and every error that was put in."""

    motion: Motion
    """The true motion of the imu on the IMU's clock."""
    gyroscope_bias: Array
    """(N, 3) at the IMU stamps, rad/s."""
    accelerometer_bias: Array
    """(N, 3) at the IMU stamps, m/s^2."""
    landmark_map: LandmarkMap
    """The true map."""
    inlier_errors: Array
    """(D, 6) [e_r, e_t] of each detection in camera axes without what is gross or flipped, rad and m."""
    slow_errors: Array
    """(D, 6) the part of them that is not white."""
    gross: Mask
    """(D,) detections that are grossly wrong."""
    flipped: Mask
    """(D,) detections that show a look-alike of a symmetric object."""
    moved_map: LandmarkMap
    """The true map while an object is moved; without one, the true map."""


def simulate(options: SimulationOptions | None = None) -> Log:
    """Return a simulated log, as if read from a folder."""
    return simulate_with_truth(options)[0]


def simulate_with_truth(options: SimulationOptions | None = None) -> tuple[Log, SimulationTruth]:
    """Return a simulated log and what a log does not say."""
    options = options or SimulationOptions()

    def stream(name: str) -> np.random.Generator:
        return np.random.default_rng([options.seed, zlib.crc32(name.encode())])

    calibration = _calibration(options)
    T_cam_imu = calibration.T_cam_imu
    assert T_cam_imu is not None
    motion = hand_held_flight(_START_NS, options.duration_s, options.rest_s, T_cam_imu, stream("flight"))
    imu, gyroscope_bias, accelerometer_bias = _imu(options, motion, stream("imu"))
    true_map = table_top(options.objects, options.symmetric_objects, stream("map"))
    map_errors = options.map_position_sigma_m, options.map_rotation_sigma_deg, stream("map errors")

    exposures_ns = _regular_stamps(options.duration_s, options.camera_rate_hz, _MARGIN_S)
    stamps_ns = exposures_ns + round(options.stamp_delay_s * 1e9) - calibration.timeshift_ns
    at_stamps_ns = stamps_ns + calibration.timeshift_ns
    seen_from = motion.pose(exposures_ns) * T_cam_imu.inv()
    moved_map = displaced_map(true_map, options.moved, stream("moved"))
    seconds = (exposures_ns - _START_NS) * 1e-9
    moved = (seconds >= options.moved.after_s) & (seconds < options.moved.until_s)
    maps = true_map, moved_map, moved
    detections, errors = detect_objects(options, calibration, maps, stamps_ns, seen_from, stream)
    log = Log(
        path=Path("simulated"),
        object_poses={"": detections},
        landmark_map=disturbed_map(true_map, *map_errors),
        camera_poses=_camera_poses(options, stamps_ns, seen_from, stream("camera poses")),
        imu=imu,
        calibration=calibration,
        T_world_cam=Trajectory(stamps_ns, motion.pose(at_stamps_ns) * T_cam_imu.inv()),
        T_world_imu=Trajectory(imu.stamps_ns, motion.pose(imu.stamps_ns)),
        T_odom_cam=_odometry(options, Trajectory(stamps_ns, seen_from), stream("odometry")),
        frames=None,
    )
    return log, SimulationTruth(motion, gyroscope_bias, accelerometer_bias, true_map, moved_map=moved_map, **errors)


def _regular_stamps(duration_s: float, rate_hz: float, margin_s: float) -> Stamps:
    count = int((duration_s - 2.0 * margin_s) * rate_hz) + 1
    return _START_NS + np.round((margin_s + np.arange(count) / rate_hz) * 1e9).astype(np.int64)


def _calibration(options: SimulationOptions) -> Calibration:
    noise = options.imu_noise
    return Calibration(
        T_cam_imu=make_pose(
            Rotation.from_rotvec(options.imu_rotation_in_cam_deg, degrees=True), options.imu_position_in_cam
        ),
        timeshift_cam_imu_s=options.timeshift_cam_imu_s,
        camera=Camera((600.0, 600.0, 319.5, 239.5), resolution=(640, 480)),
        imu=ImuNoise(
            noise.gyroscope_noise_density,
            noise.accelerometer_noise_density,
            noise.gyroscope_random_walk,
            noise.accelerometer_random_walk,
            options.imu_rate_hz,
        ),
    )


def _imu(options: SimulationOptions, motion: Motion, rng: np.random.Generator) -> tuple[ImuSamples, Array, Array]:
    """Return the samples and the biases in them; discrete sigma = density * sqrt(rate), walk * sqrt(interval)."""
    exact = motion.imu_samples(_regular_stamps(options.duration_s, options.imu_rate_hz, 0.0))
    shape = exact.angular_velocity.shape
    if not options.imu_errors:
        return exact, np.zeros(shape), np.zeros(shape)
    noise, rate = options.imu_noise, options.imu_rate_hz

    def wander(first_sigma: float, walk: float) -> Array:
        steps = rng.standard_normal(shape) * walk / np.sqrt(rate)
        steps[0] = rng.standard_normal(3) * first_sigma
        return np.cumsum(steps, axis=0)

    gyroscope_bias = wander(options.gyroscope_bias_sigma, noise.gyroscope_random_walk)
    accelerometer_bias = wander(options.accelerometer_bias_sigma, noise.accelerometer_random_walk)
    white = rng.standard_normal((2, *shape)) * np.sqrt(rate)
    samples = ImuSamples(
        exact.stamps_ns,
        exact.angular_velocity + gyroscope_bias + noise.gyroscope_noise_density * white[0],
        exact.specific_force + accelerometer_bias + noise.accelerometer_noise_density * white[1],
    )
    return samples, gyroscope_bias, accelerometer_bias


def _camera_poses(
    options: SimulationOptions, stamps_ns: Stamps, T_world_cam: RigidTransform, rng: np.random.Generator
) -> CameraPoses | None:
    if not options.camera_poses:
        return None
    sigma = np.repeat([np.radians(options.camera_pose_rotation_sigma_deg), options.camera_pose_position_sigma_m], 3)
    errors = sigma * rng.standard_normal((len(stamps_ns), 6))
    return CameraPoses(
        stamps_ns,
        np.arange(len(stamps_ns), dtype=np.int64),
        make_pose(T_world_cam.rotation * Rotation.from_rotvec(errors[:, :3]), T_world_cam.translation + errors[:, 3:]),
        np.broadcast_to(np.diag((options.stated_share * sigma) ** 2), (len(stamps_ns), 6, 6)).copy(),
    )


def _odometry(options: SimulationOptions, T_world_cam: Trajectory, rng: np.random.Generator) -> Trajectory | None:
    """Return the camera's relative motions chained with an error each; the first pose is the identity."""
    if not options.odometry:
        return None
    sigma = np.repeat([np.radians(options.odometry_rotation_drift_deg), options.odometry_position_drift], 3)
    poses = T_world_cam.T_world_body
    steps = poses[:-1].inv() * poses[1:]
    errors = sigma / np.sqrt(options.camera_rate_hz) * rng.standard_normal((len(steps), 6))
    chain = [np.eye(4)]
    for step in retract(steps, errors).as_matrix():
        chain.append(chain[-1] @ step)
    return Trajectory(T_world_cam.stamps_ns, RigidTransform.from_matrix(np.stack(chain)))
