"""What carries the state between measurements: the IMU, odometry, both, or nothing but a smooth motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.guessed_motion import shown_motion
from fusion.measurements import BEFORE_POSES, ODOMETRY_STEP, Measurements
from fusion.odometry import believed_samples, odometry_samples
from fusion.options import FuseOptions
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, ImuNoise, ImuSamples
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log

Kind = Literal["imu", "odometry", "imu+odometry", "constant-velocity"]


@dataclass(frozen=True)
class MotionSource:
    """Samples of the motion in the place of an IMU's, and whose motion it is."""

    kind: Kind
    samples: ImuSamples
    """imu: as measured; odometry: the body's angular velocity and velocity (`odometry.odometry_samples`);
    constant-velocity: zeros, so that the gyroscope bias becomes minus the angular velocity."""
    noise: ImuNoise
    body: Literal["imu", "cam"]
    """Whose trajectory is estimated: the camera's where nothing says where an IMU would sit."""
    doubts: NDArray[np.float64] | None = None
    """odometry: what is not known of each sample (`odometry.believed_samples`)."""


def motion_source(log: Log, calibration: Calibration, options: FuseOptions, measured: Measurements) -> MotionSource:
    """Return the source that the options ask for, or the best that the log has, for these measurements.

    Raises InputError where the source or its calibration is missing.
    """
    kind, stamps_ns = motion_of(log, options), measured.stamps_ns
    if kind == "imu+odometry":
        _odometry_of(log)
        return replace(_imu(log, calibration, options), kind=kind)
    if kind == "imu":
        return _imu(log, calibration, options)
    body: Literal["imu", "cam"] = "cam" if calibration.T_cam_imu is None else "imu"
    if kind == "odometry":
        T_odom_cam = _on_imu_clock(_odometry_of(log), calibration)
        T_cam_body = RigidTransform.identity() if calibration.T_cam_imu is None else calibration.T_cam_imu
        samples, doubts = believed_samples(odometry_samples(T_odom_cam, T_cam_body), stamps_ns, options)
        return MotionSource("odometry", samples, ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0), body, doubts)
    return MotionSource("constant-velocity", _nothing_measured(stamps_ns, options), _smooth(measured, options), body)


def motion_of(log: Log, options: FuseOptions) -> Kind:
    """Return what the options ask to carry the state, or the best that the log has."""
    if options.motion != "auto":
        return options.motion
    odometry = log.T_odom_cam is not None and len(log.T_odom_cam) > 1
    if log.imu is not None:
        return "imu+odometry" if odometry else "imu"
    return "odometry" if odometry else "constant-velocity"


def odometry_steps(log: Log, calibration: Calibration, options: FuseOptions) -> Measurements:
    """Return the camera's motion from each odometry pose to one at least `odometry.step_s` later, as measurements.

    The first has nothing to be measured against and only says where the second begins.
    """
    T_odom_cam, walk = _on_imu_clock(_odometry_of(log), calibration), options.odometry
    seconds, kept = (T_odom_cam.stamps_ns - T_odom_cam.stamps_ns[0]) * 1e-9, [0]
    for k, at in enumerate(seconds):
        if at - seconds[kept[-1]] >= walk.step_s - 1e-6:
            kept.append(k)
    poses, count = T_odom_cam.T_world_body[kept], len(kept)
    moved = RigidTransform.concatenate([RigidTransform.identity(), poses[:-1].inv() * poses[1:]])
    return Measurements(
        T_odom_cam.stamps_ns[kept],
        np.full(count, ODOMETRY_STEP, dtype=np.int64),
        np.full(count, BEFORE_POSES, dtype=np.int64),
        moved.rotation.as_matrix().reshape(-1, 9),
        np.ascontiguousarray(moved.translation),
        np.diff(seconds[kept], prepend=-1.0)[:, None, None] * odometry_spread(options),
    )


def odometry_spread(options: FuseOptions) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of [e_r, e_t] that a second of odometry gathers."""
    walk = options.odometry
    return np.diag(np.repeat([np.radians(walk.rotation_walk_deg), walk.translation_walk], 3) ** 2)


def _odometry_of(log: Log) -> Trajectory:
    if log.T_odom_cam is None:
        raise InputError("the log has no T_odom_cam.tum", path=log.path, fix="choose another --motion")
    if len(log.T_odom_cam) < 2:
        file = log.path / "T_odom_cam.tum"
        raise InputError(
            "has one pose, which tells no motion", path=file, fix="give two or more, or choose another --motion"
        )
    return log.T_odom_cam


def _on_imu_clock(T_odom_cam: Trajectory, calibration: Calibration) -> Trajectory:
    return T_odom_cam.later(calibration.timeshift_ns)


def _imu(log: Log, calibration: Calibration, options: FuseOptions) -> MotionSource:
    if log.imu is None:
        raise InputError("the log has no imu.csv", path=log.path, fix="choose another --motion")
    if calibration.imu is None or calibration.T_cam_imu is None:
        raise InputError(
            "fusion needs T_cam_imu and the IMU's noise densities", path=log.path / "calibration.yaml", fix="add them"
        )
    return MotionSource("imu", log.imu, scaled_noise(calibration.imu, options), "imu")


def scaled_noise(noise: ImuNoise, options: FuseOptions) -> ImuNoise:
    """Return the calibration's noise of the IMU as far as the options believe it."""
    density, walk = options.imu.noise_scale, options.imu.walk_scale
    return ImuNoise(
        density * noise.gyroscope_noise_density,
        density * noise.accelerometer_noise_density,
        walk * noise.gyroscope_random_walk,
        walk * noise.accelerometer_random_walk,
        noise.update_rate,
    )


def _nothing_measured(stamps_ns: NDArray[np.int64], options: FuseOptions) -> ImuSamples:
    step = round(1e9 / options.constant_velocity.rate_hz)
    stamps = np.arange(stamps_ns[0], stamps_ns[-1] + step, step, dtype=np.int64) if len(stamps_ns) else stamps_ns
    return ImuSamples(stamps, np.zeros((len(stamps), 3)), np.zeros((len(stamps), 3)))


def _smooth(measured: Measurements, options: FuseOptions) -> ImuNoise:
    acceleration, angular_acceleration = shown_motion(measured, options.constant_velocity)
    return ImuNoise(0.0, acceleration, angular_acceleration, 0.0, options.constant_velocity.rate_hz)
