"""What the graph is made of: IMU, measurements, wandering biases and priors as gtsam factors.

Keys: x pose T_world_imu, v velocity, b IMU bias (gtsam's order: accelerometer, gyroscope) per keyframe; e T_imu_cam;
o T_world_obj per object; c one object's bias over a stretch of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fusion.graph_steps import SECONDS, detection_error, imu_between
from fusion.measurements import CAMERA_POSE, OBJECT_POSE
from fusion.nav_state import (
    ACCEL_BIAS,
    CORE,
    EXTRINSIC_ROTATION,
    GYRO_BIAS,
    OBJECT_SIZE,
    OBJECTS,
    VELOCITY,
    StateLayout,
)
from fusion.options import Gap, Graph
from poet_loc.core.records import ImuNoise, ImuSamples

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

EXTRINSICS = gtsam.symbol("e", 0)
_SMALLEST_DENSITY = 1e-8  # a noise density of zero has no information matrix
_SMALLEST_VARIANCE = 1e-14  # nor has an exact prior


def pose_key(k: int) -> int:
    """Return the key of keyframe k's pose."""
    return int(gtsam.symbol("x", k))


def velocity_key(k: int) -> int:
    """Return the key of keyframe k's velocity."""
    return int(gtsam.symbol("v", k))


def imu_bias_key(k: int) -> int:
    """Return the key of keyframe k's IMU bias."""
    return int(gtsam.symbol("b", k))


def object_key(k: int) -> int:
    """Return the key of an object's pose."""
    return int(gtsam.symbol("o", k))


def object_bias_key(count: int) -> int:
    """Return the key of one stretch of an object's bias."""
    return int(gtsam.symbol("c", count))


def pose3(x: Array, at: int) -> gtsam.Pose3:
    """Return the pose that stands in the nominal array."""
    return gtsam.Pose3(gtsam.Rot3(x[at : at + 9].reshape(3, 3)), x[at + 9 : at + 12])


def put_pose3(x: Array, at: int, T: gtsam.Pose3) -> None:
    """Write a pose into the nominal array."""
    x[at : at + 9] = T.rotation().matrix().ravel()
    x[at + 9 : at + 12] = T.translation()


def imu_bias(x: Array) -> gtsam.imuBias.ConstantBias:
    """Return the IMU bias that stands in the nominal array."""
    return gtsam.imuBias.ConstantBias(x[ACCEL_BIAS : ACCEL_BIAS + 3], x[GYRO_BIAS : GYRO_BIAS + 3])


def put_core(x: Array, T: gtsam.Pose3, velocity: Array, bias: gtsam.imuBias.ConstantBias) -> None:
    """Write pose, velocity and IMU bias into the nominal array."""
    put_pose3(x, 0, T)
    x[VELOCITY : VELOCITY + 3] = velocity
    x[GYRO_BIAS : GYRO_BIAS + 3] = bias.gyroscope()
    x[ACCEL_BIAS : ACCEL_BIAS + 3] = bias.accelerometer()


def core_to_filter(R_world_imu: Array) -> Array:
    """Return the (15, 15) matrix that turns gtsam's [pose 6, velocity 3, bias 6] tangent into the filter's error state.

    Pose3 measures its translation in body axes, the filter in world axes; gtsam's bias is [accelerometer, gyroscope].
    """
    J = np.zeros((CORE, CORE))
    J[:3, :3] = J[6:9, 6:9] = np.eye(3)
    J[3:6, 3:6] = R_world_imu
    J[9:12, 12:15] = J[12:15, 9:12] = np.eye(3)
    return J


def pose_to_filter(R: Array) -> Array:
    """Return the (6, 6) matrix from a Pose3's tangent to [rotation, translation in the axes around it]."""
    return block_diag(np.eye(3), R)


@dataclass(frozen=True)
class ImuChain:
    """Makes the factor between two keyframes."""

    stamps_ns: Ints
    values: Array
    """(N, 6) angular velocity and specific force."""
    noise: ImuNoise
    gap: Gap

    @classmethod
    def of(cls, imu: ImuSamples, noise: ImuNoise, gap: Gap) -> ImuChain:
        """Return the chain of a log's IMU."""
        return cls(imu.stamps_ns, np.hstack([imu.angular_velocity, imu.specific_force]), noise, gap)

    def preintegrate(
        self, start: int, end: int, bias: gtsam.imuBias.ConstantBias
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Return the IMU between two stamps, integrated at a bias.

        A gap inside raises the densities of the whole stretch so far that it explains what the gap may have held.
        """
        size = np.searchsorted(self.stamps_ns, [start, end]) @ [-1, 1] + 2
        steps = np.empty((size, 7))
        biases = np.concatenate([bias.gyroscope(), bias.accelerometer()])
        count = imu_between(self.stamps_ns, self.values, start, end, biases, steps)
        gaps = steps[:count, 0][steps[:count, 0] > self.gap.longest_s]
        spread = float(gaps @ gaps) / ((end - start) * 1e-9) if len(gaps) else 0.0
        summed = gtsam.PreintegratedCombinedMeasurements(self._parameters(spread), bias)
        for step in steps[:count]:
            summed.integrateMeasurement(step[4:7], step[1:4], step[0])
        return summed

    def _parameters(self, gap_s: float) -> gtsam.PreintegrationCombinedParams:
        """Every covariance is set: gtsam takes the identity for those that are not."""
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
        gyro = self.noise.gyroscope_noise_density**2 + gap_s * self.gap.angular_rate**2
        accel = self.noise.accelerometer_noise_density**2 + gap_s * self.gap.acceleration**2
        floor, identity = _SMALLEST_DENSITY**2, np.eye(3)
        params.setGyroscopeCovariance((gyro + floor) * identity)
        params.setAccelerometerCovariance((accel + floor) * identity)
        params.setBiasOmegaCovariance((self.noise.gyroscope_random_walk**2 + floor) * identity)
        params.setBiasAccCovariance((self.noise.accelerometer_random_walk**2 + floor) * identity)
        params.setIntegrationCovariance(1e-10 * identity)
        return params


def imu_factor(first: int, second: int, summed: gtsam.PreintegratedCombinedMeasurements) -> gtsam.CombinedImuFactor:
    """Return the factor between two keyframes."""
    return gtsam.CombinedImuFactor(
        pose_key(first),
        velocity_key(first),
        pose_key(second),
        velocity_key(second),
        imu_bias_key(first),
        imu_bias_key(second),
        summed,
    )


def joint_prior(
    keys: Sequence[int], sizes: Sequence[int], values: gtsam.Values, covariance: Array
) -> gtsam.NonlinearFactor:
    """Return a Gaussian on several variables at their values; covariance in the order of keys, in gtsam's tangents."""
    covariance = covariance + _SMALLEST_VARIANCE * np.eye(len(covariance))
    scale = 1.0 / np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance * np.outer(scale, scale))
    whitener = np.split(np.linalg.solve(root, np.diag(scale)), np.cumsum(sizes)[:-1], axis=1)
    unit = gtsam.noiseModel.Diagonal.Sigmas(np.ones(len(covariance)))
    terms = list(zip(keys, whitener, strict=True))
    together = gtsam.GaussianFactorGraph()
    together.add(gtsam.GaussianConditional(terms, 1, np.zeros(len(covariance)), unit))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(together), values.extract(list(keys)))


def bias_factor(first: int, second: int, phi: Array, sigma: Array) -> gtsam.NonlinearFactor:
    """Return the Gauss-Markov step b_second = phi b_first + w, w ~ sigma, between two object biases; all (6,)."""
    unit = gtsam.noiseModel.Unit.Create(6)
    linear = gtsam.JacobianFactor(first, np.diag(-phi / sigma), second, np.diag(1.0 / sigma), np.zeros(6), unit)
    zeros = gtsam.Values()
    zeros.insert(first, np.zeros(6))
    zeros.insert(second, np.zeros(6))
    return gtsam.LinearContainerFactor(linear, zeros)


def robust(options: Graph, covariance: Array) -> gtsam.noiseModel.Base:
    """Return the noise of a measurement with the options' kernel around it."""
    gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if options.kernel == "none":
        return gaussian
    kernels: Any = gtsam.noiseModel.mEstimator
    kernel = {"huber": kernels.Huber, "cauchy": kernels.Cauchy}[options.kernel]
    return gtsam.noiseModel.Robust.Create(kernel.Create(options.kernel_width), gaussian)


@dataclass(frozen=True)
class Detection:
    """One measurement as the graph takes it: rows first..first+size of [rotation, translation], after a keyframe."""

    kind: int
    object: int
    first: int
    size: int
    rotation: Array
    translation: Array
    covariance: Array
    motion: Array
    """(MOTION_SIZE,) from the keyframe to the measurement's stamp."""


@dataclass(frozen=True)
class Model:
    """What every measurement's factor reads: layout, the map and extrinsics as they are known, the kernel."""

    layout: StateLayout
    x: Array
    """A nominal array; scratch but for what is known."""
    options: Graph


def measurement_factor(
    detection: Detection, keyframe: int, biases: Sequence[int], model: Model
) -> gtsam.NonlinearFactor:
    """Return a measurement's factor: gtsam's own for a camera pose, one on the filter's compiled model for the rest.

    biases are the keys of the object's biases.
    """
    native = detection.kind == CAMERA_POSE and detection.size == 6 and not model.layout.extrinsics
    if native and detection.motion[SECONDS] == 0.0:
        return _camera_pose_prior(detection, keyframe, model)
    return _compiled_factor(detection, keyframe, biases, model)


def _camera_pose_prior(detection: Detection, keyframe: int, model: Model) -> gtsam.NonlinearFactor:
    """T_world_imu = T_world_cam T_cam_imu; the error [e_r, e_t] of T_world_cam moves to the imu by the adjoint."""
    R_m = detection.rotation.reshape(3, 3)
    T_imu_cam = pose3(model.x, EXTRINSIC_ROTATION)
    T_world_imu = gtsam.Pose3(gtsam.Rot3(R_m), detection.translation).compose(T_imu_cam.inverse())
    A = T_imu_cam.AdjointMap() @ block_diag(np.eye(3), R_m.T)
    return gtsam.PriorFactorPose3(
        pose_key(keyframe), T_world_imu, robust(model.options, A @ detection.covariance @ A.T)
    )


def _compiled_factor(detection: Detection, keyframe: int, biases: Sequence[int], model: Model) -> gtsam.NonlinearFactor:
    """Return a factor on residual and Jacobian of `fusion.measurements`."""
    d, layout, x = detection, model.layout, model.x
    integers = layout.as_integers()
    moved, free_object = d.motion[SECONDS] > 0.0, layout.objects and d.kind == OBJECT_POSE
    pose, velocity, landmark = pose_key(keyframe), velocity_key(keyframe), object_key(d.object)
    at = OBJECTS + OBJECT_SIZE * d.object
    known_object = pose3(x, at).matrix() if d.kind == OBJECT_POSE else np.eye(4)
    known_extrinsics, still = pose3(x, EXTRINSIC_ROTATION).matrix(), np.zeros(3)
    bias = np.zeros((len(biases), 6))
    columns = [(pose, slice(0, 6), True), (velocity, slice(6, 9), moved), (EXTRINSICS, slice(9, 15), layout.extrinsics)]
    columns += [(landmark, slice(15, 21), free_object)]
    columns += [(key, slice(21 + 6 * i, 27 + 6 * i), True) for i, key in enumerate(biases)]
    keys, blocks = [key for key, _, used in columns if used], [part for _, part, used in columns if used]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        for i, key in enumerate(biases):
            bias[i] = values.atVector(key)
        e, J = detection_error(
            d.kind,
            d.object,
            d.first,
            d.size,
            d.rotation,
            d.translation,
            d.motion,
            values.atPose3(pose).matrix(),
            values.atVector(velocity) if moved else still,
            values.atPose3(EXTRINSICS).matrix() if layout.extrinsics else known_extrinsics,
            values.atPose3(landmark).matrix() if free_object else known_object,
            bias,
            x,
            integers,
        )
        if H is not None:
            for i, part in enumerate(blocks):
                H[i] = J[:, part]
        return np.asarray(e)

    rows = slice(d.first, d.first + d.size)
    return gtsam.CustomFactor(robust(model.options, d.covariance[rows, rows]), keys, error)
