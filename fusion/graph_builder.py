"""From keyframes to variables and factors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fusion import eskf
from fusion.graph_factors import (
    EXTRINSICS,
    Detection,
    ImuChain,
    Model,
    bias_factor,
    core_to_filter,
    imu_bias,
    imu_bias_key,
    imu_factor,
    joint_prior,
    measurement_factor,
    object_bias_key,
    object_key,
    pose3,
    pose_key,
    pose_to_filter,
    put_core,
    velocity_key,
)
from fusion.measurements import OBJECT_POSE
from fusion.nav_state import CORE, EXTRINSIC_ROTATION, OBJECT_SIZE, OBJECTS, VELOCITY, StateLayout
from fusion.options import Graph

Array = NDArray[np.float64]


@dataclass
class BiasChain:
    """One bias of one object over time: its newest variable, or what is known before there is one."""

    kind: int
    mean: Array
    sigma: Array
    stamp_ns: int
    key: int | None = None


@dataclass(frozen=True)
class BiasModel:
    """The Gauss-Markov model of the object biases, read from the filter's memory."""

    values: Array

    def stationary(self, kind: int) -> Array:
        """Return the stationary 1-sigma (6,) of a kind of bias."""
        return np.array([eskf.bias_sigma(self.values, kind, i) for i in range(6)])

    def jumped(self, kind: int) -> Array:
        """Return the 1-sigma (6,) after a jump."""
        return float(self.values[eskf.BIAS_JUMP]) * self.stationary(kind)

    def decay(self, kind: int, seconds: float) -> float:
        """Return how much of a bias is left after some seconds."""
        return float(np.exp(-seconds / self.values[kind * eskf.BIAS_MODEL_SIZE + eskf.BIAS_TAU]))


class GraphBuilder:
    """Collects what a new keyframe adds: factors, initial values and the time of every variable.

    A keyframe is pose, velocity and IMU bias. Extrinsics and object poses are one variable each where they are
    estimated. An object's bias has a variable per keyframe that sees the object.
    """

    def __init__(self, layout: StateLayout, x: Array, bias_model: Array, chain: ImuChain, options: Graph) -> None:
        self.layout, self.bias_model, self.imu = layout, BiasModel(bias_model.copy()), chain
        self.model = Model(layout, x.copy(), options)
        self.keyframe, self.stamp_ns = -1, 0
        self._bias_count = 0
        self.chains: dict[tuple[int, int], BiasChain] = {}
        self._clear()

    def _clear(self) -> None:
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.keyframes: dict[int, int] = {}

    def take(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, int]]:
        """Return what was added since the last call: factors, initial values, each variable's keyframe."""
        added = self.graph, self.values, self.keyframes
        self._clear()
        return added

    @property
    def static_keys(self) -> list[int]:
        """Keys of extrinsics and object poses where they are estimated."""
        objects = [object_key(k) for k in range(self.layout.n_objects)] if self.layout.objects else []
        return [EXTRINSICS] * self.layout.extrinsics + objects

    @property
    def lasting_keys(self) -> list[int]:
        """Keys that must not fall out of a smoother's window."""
        return self.static_keys + [chain.key for chain in self.chains.values() if chain.key is not None]

    def start(self, stamp_ns: int, x: Array, P: Array) -> None:
        """Begin a graph with the filter's state as prior; object biases begin at their stationary sigma."""
        self._clear()
        self._add_variables(stamp_ns, x)
        keys = [pose_key(self.keyframe), velocity_key(self.keyframe), imu_bias_key(self.keyframe)]
        blocks, indices = [core_to_filter(x[:9].reshape(3, 3))], list(range(CORE))
        if self.layout.extrinsics:
            keys.append(EXTRINSICS)
            self._add_pose(EXTRINSICS, x, EXTRINSIC_ROTATION, "extrinsics", 0, blocks, indices)
        for k in range(self.layout.n_objects if self.layout.objects else 0):
            keys.append(object_key(k))
            self._add_pose(object_key(k), x, OBJECTS + OBJECT_SIZE * k, "objects", k, blocks, indices)
        to_gtsam = np.linalg.inv(block_diag(*blocks))
        covariance = to_gtsam @ P[np.ix_(indices, indices)] @ to_gtsam.T
        sizes = [6, 3, 6] + [6] * (len(keys) - 3)
        self.graph.add(joint_prior(keys, sizes, self.values, 0.5 * (covariance + covariance.T)))
        self.chains = {
            (k, kind): BiasChain(kind, np.zeros(6), self.bias_model.stationary(kind), stamp_ns)
            for k in range(self.layout.n_objects)
            for kind in range(self.layout.bias_kinds)
        }

    def _add_pose(
        self, key: int, x: Array, at: int, name: str, index: int, blocks: list[Array], indices: list[int]
    ) -> None:
        self.values.insert(key, pose3(x, at))
        self.keyframes[key] = self.keyframe
        blocks.append(pose_to_filter(x[at : at + 9].reshape(3, 3)))
        part = self.layout.error_slice(name, index)
        indices.extend(range(part.start, part.stop))

    def _add_variables(self, stamp_ns: int, x: Array) -> None:
        self.keyframe, self.stamp_ns = self.keyframe + 1, stamp_ns
        k = self.keyframe
        self.values.insert(pose_key(k), pose3(x, 0))
        self.values.insert(velocity_key(k), x[VELOCITY : VELOCITY + 3])
        self.values.insert(imu_bias_key(k), imu_bias(x))
        for key in (pose_key(k), velocity_key(k), imu_bias_key(k)):
            self.keyframes[key] = k

    def add_keyframe(
        self, stamp_ns: int, x: Array, before: Array, between: Iterable[Detection], bias: gtsam.imuBias.ConstantBias
    ) -> None:
        """Add a keyframe that starts from x, the IMU up to it (summed at a bias) and the detections on the way."""
        for detection in between:
            self.add_detection(detection)
        summed = self.imu.preintegrate(self.stamp_ns, stamp_ns, bias)
        self.graph.add(imu_factor(self.keyframe, self.keyframe + 1, summed))
        predicted = x.copy()
        state = summed.predict(gtsam.NavState(pose3(before, 0), before[VELOCITY : VELOCITY + 3]), bias)
        put_core(predicted, state.pose(), state.velocity(), bias)
        self._add_variables(stamp_ns, predicted)

    def add_detection(self, detection: Detection) -> None:
        """Add a detection to the newest keyframe."""
        kinds = self.layout.bias_kinds if detection.kind == OBJECT_POSE else 0
        biases = [self._bias_here(detection.object, kind) for kind in range(kinds)]
        self.graph.add(measurement_factor(detection, self.keyframe, biases, self.model))

    def forget(self, k: int, kind: int, half: int) -> None:
        """Let an object's bias of rotation (half 0) or translation (1) be another from the newest keyframe on."""
        chain, part = self.chains[k, kind], slice(3 * half, 3 * half + 3)
        jumped = self.bias_model.jumped(kind)
        if chain.key is None:
            self._age(chain)
            chain.mean[part], chain.sigma[part] = 0.0, jumped[part]
            return
        phi, sigma = self._step(chain)
        phi[part], sigma[part] = 0.0, jumped[part]
        self._add_bias(chain, phi, np.maximum(sigma, 1e-9))

    def _bias_here(self, k: int, kind: int) -> int:
        """Return the key of an object's bias at the newest keyframe."""
        chain = self.chains[k, kind]
        if chain.key is None:
            self._age(chain)
            self._add_bias(chain, None, chain.sigma)
        elif chain.stamp_ns < self.stamp_ns:
            phi, sigma = self._step(chain)
            if phi[0] < 1.0:
                self._add_bias(chain, phi, sigma)
        assert chain.key is not None
        return chain.key

    def _step(self, chain: BiasChain) -> tuple[Array, Array]:
        phi = self.bias_model.decay(chain.kind, (self.stamp_ns - chain.stamp_ns) * 1e-9)
        return np.full(6, phi), np.sqrt(1.0 - phi * phi) * self.bias_model.stationary(chain.kind)

    def _age(self, chain: BiasChain) -> None:
        phi, sigma = self._step(chain)
        chain.mean, chain.sigma, chain.stamp_ns = phi * chain.mean, np.hypot(phi * chain.sigma, sigma), self.stamp_ns

    def _add_bias(self, chain: BiasChain, phi: Array | None, sigma: Array) -> None:
        """Add a bias variable at the newest keyframe: with a prior, or a step from the one before."""
        key = object_bias_key(self._bias_count)
        self._bias_count += 1
        if phi is None:
            self.graph.addPriorVector(key, chain.mean, gtsam.noiseModel.Diagonal.Sigmas(sigma))
        else:
            assert chain.key is not None
            self.graph.add(bias_factor(chain.key, key, phi, sigma))
            chain.mean = phi * chain.mean
        self.values.insert(key, chain.mean)
        self.keyframes[key] = self.keyframe
        chain.key, chain.stamp_ns = key, self.stamp_ns

    def set_bias_means(self, means: Mapping[tuple[int, int], Array]) -> None:
        """Take the newest estimates of the biases as starting values of the next variables."""
        for which, mean in means.items():
            self.chains[which].mean = mean
