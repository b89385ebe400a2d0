"""What ties one keyframe to the next: the IMU (CombinedImuFactor) or odometry (a factor between two poses)."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.graph_link import INTEGRATION, SMALLEST_DENSITY
from fusion.graph_model import MOTION_SIZE, SHIFT, TURN, imu_between, motion_between, move, rate_at
from fusion.graph_variables import GRAVITY_KEY, imu_bias, imu_bias_key, pose_key, velocity_key
from fusion.imu_noise import ACCEL_SQUARES, GYRO_SQUARES, density_squared
from fusion.nav_state import ACCEL_BIAS, GRAVITY, GYRO_BIAS
from fusion.odometry import ROTATION_DOUBT, ROTATION_WALK, TRANSLATION_DOUBT, TRANSLATION_WALK
from fusion.options import FuseOptions
from fusion.prepare import Problem, motion_noise
from poet_loc.core.records import ImuNoise

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_STILL = np.zeros(6)
_IDENTITY = np.eye(3)


@dataclass(frozen=True)
class MotionChain:
    """The samples of a log's motion between stamps."""

    stamps_ns: Ints
    values: Array
    """(N, 9) angular velocity and specific force, or odometry's twists, and their noise (`prepare.Problem.rows`)."""
    noise: ImuNoise
    densities: Array
    """The filter's (`prepare.motion_noise`)."""
    options: FuseOptions
    with_imu: bool
    """False: odometry, which knows no velocity and no biases."""
    estimates_gravity: bool

    @classmethod
    def of(cls, problem: Problem, options: FuseOptions) -> MotionChain:
        """Return the chain of a problem."""
        imu, with_imu, gravity = problem.imu, problem.motion != "odometry", problem.layout.gravity
        noise = problem.imu_noise, motion_noise(problem, options)
        return cls(imu.stamps_ns, problem.rows, *noise, options, with_imu, gravity)

    def motion(self, start: int, end: int, x: Array) -> Array:
        """Return the motion (MOTION_SIZE,) between two stamps at the biases in a nominal array."""
        biases = x[GYRO_BIAS : ACCEL_BIAS + 3] if self.with_imu else _STILL
        if start == end:
            return _NO_MOTION
        return np.asarray(motion_between(self.stamps_ns, self.values, start, end, biases, not self.with_imu))

    def rate(self, stamp: int, x: Array) -> Array:
        """Return the angular velocity (3,) at a stamp."""
        bias = x[GYRO_BIAS : GYRO_BIAS + 3] if self.with_imu else _STILL[:3]
        return np.asarray(rate_at(self.stamps_ns, self.values, stamp, bias))

    def link(self, k: int, start: int, end: int, x: Array) -> tuple[gtsam.NonlinearFactor, Array]:
        """Return the factor from keyframe k to the next and the nominal array that it predicts there from x."""
        predicted = x.copy()
        if not self.with_imu:
            motion = self.motion(start, end, x)
            move(predicted, motion)
            return self._odometry_factor(k, motion, start, end), predicted
        summed = self.preintegrate(start, end, imu_bias(x), x[GRAVITY : GRAVITY + 3])
        move(predicted, self.motion(start, end, x))
        keys = pose_key(k), velocity_key(k), pose_key(k + 1), velocity_key(k + 1), imu_bias_key(k), imu_bias_key(k + 1)
        if self.estimates_gravity:
            return gtsam.CombinedImuFactorWithGravityVector(*keys, GRAVITY_KEY, summed), predicted
        return gtsam.CombinedImuFactor(*keys, summed), predicted

    def _odometry_factor(self, k: int, motion: Array, start: int, end: int) -> gtsam.NonlinearFactor:
        first, last = self.stamps_ns.searchsorted(start, side="right") - 1, self.stamps_ns.searchsorted(end)
        seconds = np.diff(self.stamps_ns[first : last + 1].clip(start, end)) * 1e-9
        doubts = self.values[first:last, ROTATION_DOUBT : TRANSLATION_DOUBT + 1]
        walk = self.densities[[ROTATION_WALK, TRANSLATION_WALK]]
        sigma = np.repeat(np.sqrt(seconds @ (walk**2 + doubts)), 3)
        measured = gtsam.Pose3(gtsam.Rot3(motion[TURN : TURN + 9].reshape(3, 3)), motion[SHIFT : SHIFT + 3])
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
        return gtsam.BetweenFactorPose3(pose_key(k), pose_key(k + 1), measured, noise)

    def preintegrate(
        self, start: int, end: int, bias: gtsam.imuBias.ConstantBias, gravity: Array
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Return the IMU between two stamps, integrated at a bias.

        A gap inside raises the densities of the whole stretch so far that it explains what the gap may have held.
        """
        last = int(self.stamps_ns.searchsorted(end))
        steps = np.empty((last - int(self.stamps_ns.searchsorted(start)) + 2, 7))
        biases = np.concatenate([bias.gyroscope(), bias.accelerometer()])
        longest = self.options.gap.longest_s
        count, gaps = imu_between(self.stamps_ns, self.values, start, end, biases, longest, steps)
        params = self._parameters(gaps / ((end - start) * 1e-9), self.values[last], gravity)
        summed = gtsam.PreintegratedCombinedMeasurements(params, bias)
        for seconds, rate, force in zip(steps[:count, 0].tolist(), steps[:, 1:4], steps[:, 4:7], strict=False):
            summed.integrateMeasurement(force, rate, seconds)
        return summed

    def _parameters(self, gap_s: float, row: Array, gravity: Array) -> gtsam.PreintegrationCombinedParams:
        """Every covariance is set: gtsam takes the identity for those that are not."""
        params, gap = gtsam.PreintegrationCombinedParams(gravity), self.options.gap
        measured = float(self.options.imu.measured)
        gyro = density_squared(self.noise.gyroscope_noise_density, row, GYRO_SQUARES, measured)
        accel = density_squared(self.noise.accelerometer_noise_density, row, ACCEL_SQUARES, measured)
        gyro, accel = gyro + gap_s * gap.angular_rate**2, accel + gap_s * gap.acceleration**2
        floor = SMALLEST_DENSITY**2
        params.setGyroscopeCovariance((gyro + floor) * _IDENTITY)
        params.setAccelerometerCovariance((accel + floor) * _IDENTITY)
        params.setBiasOmegaCovariance((self.noise.gyroscope_random_walk**2 + floor) * _IDENTITY)
        params.setBiasAccCovariance((self.noise.accelerometer_random_walk**2 + floor) * _IDENTITY)
        params.setIntegrationCovariance(INTEGRATION**2 * _IDENTITY)
        return params


_NO_MOTION = np.zeros(MOTION_SIZE)
_NO_MOTION[[TURN, TURN + 4, TURN + 8]] = 1.0
