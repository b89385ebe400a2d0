"""What carries the state between measurements: the IMU, odometry, or nothing but a smooth motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.odometry import odometry_samples
from fusion.options import FuseOptions
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, ImuNoise, ImuSamples
from poet_loc.io.log_folder import Log

Kind = Literal["imu", "odometry", "constant-velocity"]


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


def motion_source(
    log: Log, calibration: Calibration, options: FuseOptions, stamps_ns: NDArray[np.int64]
) -> MotionSource:
    """Return the source that the options ask for, or the best that the log has.

    stamps_ns are those of the measurements. Raises InputError where the source or its calibration is missing.
    """
    kind = options.motion
    if kind == "auto":
        kind = "imu" if log.imu is not None else "odometry" if log.T_odom_cam is not None else "constant-velocity"
    if kind == "imu":
        return _imu(log, calibration, options)
    body: Literal["imu", "cam"] = "cam" if calibration.T_cam_imu is None else "imu"
    if kind == "odometry":
        if log.T_odom_cam is None or len(log.T_odom_cam) < 2:
            raise InputError("the log has no T_odom_cam.tum", path=log.path, fix="choose another --motion")
        T_cam_body = RigidTransform.identity() if calibration.T_cam_imu is None else calibration.T_cam_imu
        samples = odometry_samples(log.T_odom_cam, T_cam_body)
        return MotionSource("odometry", samples, ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0), body)
    return MotionSource("constant-velocity", _nothing_measured(stamps_ns, options), _smooth(options), body)


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


def _smooth(options: FuseOptions) -> ImuNoise:
    model = options.constant_velocity
    return ImuNoise(0.0, model.acceleration, model.angular_acceleration, 0.0, model.rate_hz)
