"""Measurements and object biases as gtsam factors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fusion.graph_gnc import Truncation
from fusion.graph_model import (
    BIAS_COLUMNS,
    EXTRINSIC_COLUMNS,
    OBJECT_COLUMNS,
    OFFSET_COLUMN,
    VELOCITY_COLUMNS,
    detection_error,
)
from fusion.graph_variables import EXTRINSICS, OFFSET, object_key, pose3, pose_key, velocity_key
from fusion.measurements import CAMERA_POSE, OBJECT_POSE
from fusion.nav_state import EXTRINSIC_ROTATION, OBJECT_SIZE, OBJECTS, TIME_OFFSET, VELOCITY, StateLayout
from fusion.options import Graph

Array = NDArray[np.float64]
Error = Callable[[gtsam.CustomFactor, gtsam.Values, "list[Array] | None"], Array]


_NOWHERE = np.eye(4, order="F")  # as gtsam gives matrices: another order would be compiled once more


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
    """(6, 6) of both."""
    motion: Array
    """(MOTION_SIZE,) from the keyframe to the measurement's stamp."""
    rate: Array
    """(3,) angular velocity at its stamp, rad/s."""
    moved: bool
    """Its stamp is not the keyframe's."""
    place: Array
    """(3,) p_cam_obj where its object's biases act; of an object pose."""


@dataclass(frozen=True)
class Model:
    """What every measurement's factor reads: layout, the map and extrinsics as they are known, the kernel."""

    layout: StateLayout
    x: Array
    """A nominal array; scratch but for what is known."""
    with_imu: bool
    options: Graph
    truncation: Truncation | None = None
    """In the place of the kernel."""

    def noise(self, covariance: Array) -> gtsam.noiseModel.Base:
        """Return the noise of a measurement's rows."""
        return robust(self.options, covariance) if self.truncation is None else self.truncation.noise(covariance)

    @cached_property
    def integers(self) -> NDArray[np.int64]:
        """The layout as the compiled model reads it."""
        return self.layout.as_integers()

    @cached_property
    def extrinsics(self) -> Array:
        """(4, 4) T_imu_cam as it is known."""
        return np.asarray(pose3(self.x, EXTRINSIC_ROTATION).matrix())

    @cached_property
    def objects(self) -> list[Array]:
        """(4, 4) T_world_obj as they are known."""
        places = (OBJECTS + OBJECT_SIZE * k for k in range(self.layout.n_objects))
        return [np.asarray(pose3(self.x, at).matrix()) for at in places]


def bias_factor(first: int, second: int, phi: Array, sigma: Array) -> gtsam.NonlinearFactor:
    """Return the Gauss-Markov step b_second = phi b_first + w, w ~ sigma, between two object biases; all (6,)."""
    unit, zeros = gtsam.noiseModel.Unit.Create(6), gtsam.Values()
    linear = gtsam.JacobianFactor(first, np.diag(-phi / sigma), second, np.diag(1.0 / sigma), np.zeros(6), unit)
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


def measurement_factor(
    detection: Detection, keyframe: int, biases: Sequence[int], model: Model
) -> gtsam.NonlinearFactor:
    """Return a measurement's factor: gtsam's own for a camera pose, one on the filter's compiled model for the rest.

    biases are the keys of the object's biases.
    """
    layout, whole = model.layout, detection.size == 6 and not detection.moved
    if detection.kind == CAMERA_POSE and whole and not layout.extrinsics and not layout.time_offset:
        return _camera_pose_prior(detection, keyframe, model)
    keys, error = _compiled_error(detection, keyframe, biases, model)
    rows = slice(detection.first, detection.first + detection.size)
    return gtsam.CustomFactor(model.noise(detection.covariance[rows, rows]), keys, error)


def _camera_pose_prior(detection: Detection, keyframe: int, model: Model) -> gtsam.NonlinearFactor:
    """T_world_imu = T_world_cam T_cam_imu; the error [e_r, e_t] of T_world_cam moves to the imu by the adjoint."""
    R_m = detection.rotation.reshape(3, 3)
    T_imu_cam = pose3(model.x, EXTRINSIC_ROTATION)
    T_world_imu = gtsam.Pose3(gtsam.Rot3(R_m), detection.translation).compose(T_imu_cam.inverse())
    A = T_imu_cam.AdjointMap() @ block_diag(np.eye(3), R_m.T)
    noise = model.noise(A @ detection.covariance @ A.T)
    return gtsam.PriorFactorPose3(pose_key(keyframe), T_world_imu, noise)


def error_at(d: Detection, x: Array, layout: StateLayout) -> tuple[Array, Array]:
    """Return a measurement's error (predicted minus measured) and Jacobian at a keyframe's nominal array."""
    T_world_obj = pose3(x, OBJECTS + OBJECT_SIZE * d.object).matrix() if d.kind == OBJECT_POSE else _NOWHERE
    kinds = range(layout.bias_kinds if d.kind == OBJECT_POSE else 0)
    e, J = detection_error(
        d.kind,
        d.object,
        d.first,
        d.size,
        d.rotation,
        d.translation,
        d.rate,
        d.motion,
        pose3(x, 0).matrix(),
        x[VELOCITY : VELOCITY + 3],
        pose3(x, EXTRINSIC_ROTATION).matrix(),
        T_world_obj,
        float(x[TIME_OFFSET]),
        np.array([x[layout.nominal_bias(d.object, kind)] for kind in kinds]).reshape(-1, 6),
        d.place,
        x.copy(),
        layout.as_integers(),
    )
    return np.asarray(e), np.asarray(J)


def _compiled_error(d: Detection, keyframe: int, biases: Sequence[int], model: Model) -> tuple[list[int], Error]:
    """Return the keys of a measurement, and its residual and Jacobian as gtsam calls them."""
    layout, x = model.layout, model.x
    integers = model.integers
    pose, velocity, landmark = pose_key(keyframe), velocity_key(keyframe), object_key(max(d.object, 0))
    with_velocity = model.with_imu and (d.moved or layout.time_offset)
    free_object = layout.objects and d.kind == OBJECT_POSE
    known_object = model.objects[d.object] if d.kind == OBJECT_POSE else _NOWHERE
    known_extrinsics, known_offset, still = model.extrinsics, float(x[TIME_OFFSET]), np.zeros(3)
    bias = np.zeros((len(biases), 6))
    columns = {pose: 0}
    columns |= {velocity: VELOCITY_COLUMNS} if with_velocity else {}
    columns |= {EXTRINSICS: EXTRINSIC_COLUMNS} if layout.extrinsics else {}
    columns |= {landmark: OBJECT_COLUMNS} if free_object else {}
    columns |= {OFFSET: OFFSET_COLUMN} if layout.time_offset else {}
    columns |= {key: BIAS_COLUMNS + 6 * i for i, key in enumerate(biases)}
    sizes = {velocity: 3, OFFSET: 1}
    parts = [slice(first, first + sizes.get(key, 6)) for key, first in columns.items()]

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
            d.rate,
            d.motion,
            values.atPose3(pose).matrix(),
            values.atVector(velocity) if with_velocity else still,
            values.atPose3(EXTRINSICS).matrix() if layout.extrinsics else known_extrinsics,
            values.atPose3(landmark).matrix() if free_object else known_object,
            values.atVector(OFFSET)[0] if layout.time_offset else known_offset,
            bias,
            d.place,
            x,
            integers,
        )
        if H is not None:
            for i, part in enumerate(parts):
                H[i] = J[:, part]
        return np.asarray(e)

    return list(columns), error
