"""The fixed-lag smoother: gtsam's incremental one, and its newest state handed back to the filter."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fusion.eskf import POSITION_ONLY, ROTATION_ONLY
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import (
    EXTRINSICS,
    Detection,
    core_to_filter,
    imu_bias,
    imu_bias_key,
    object_key,
    pose_key,
    pose_to_filter,
    put_core,
    put_pose3,
    velocity_key,
)
from fusion.graph_keyframes import Keyframe, Walk
from fusion.graph_steps import move_on
from fusion.memory import Memory
from fusion.nav_state import CORE, EXTRINSIC_ROTATION, OBJECT_SIZE, OBJECTS
from fusion.options import Graph
from fusion.prepare import Problem

Array = NDArray[np.float64]

_LOOSE = 3  # keyframes at the end of the window that an ordinary update may order anew


def isam_parameters(options: Graph) -> gtsam.ISAM2Params:
    """Return parameters under which the IMU's small noise leaves no indeterminate system: QR, not Cholesky."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.setRelinearizeThreshold(options.relinearize)
    params.relinearizeSkip = 1_000_000_000
    params.findUnusedFactorSlots = True
    return params


def detections(walk: Walk, problem: Problem, which: range, keyframe_ns: int, biases: Array) -> Iterator[Detection]:
    """Yield the measurements that passed the gate, with the motion since a keyframe integrated at the IMU's biases."""
    measured = problem.measurements
    for i in which:
        decision = int(walk.decisions[i])
        if decision == 0:
            continue
        first = 0 if decision & ROTATION_ONLY else 3
        size = (3 if decision & POSITION_ONLY else 0) + 3 - first
        yield Detection(
            int(measured.kinds[i]),
            int(measured.objects[i]),
            first,
            size,
            walk.rotations[i],
            measured.translations[i],
            walk.covariances[i],
            move_on(walk.imu_stamps, walk.imu_values, keyframe_ns, int(measured.stamps_ns[i]), biases),
        )


class FixedLagSmoother:
    """Keyframes of the last seconds as variables, older ones marginalised; cost per keyframe is constant."""

    def __init__(self, builder: GraphBuilder, options: Graph) -> None:
        self.builder = builder
        self._window = max(2, round(options.lag_s * options.keyframe_rate_hz))
        self._relinearize_every = options.relinearize_every
        self._smoother = gtsam.ISAM2(isam_parameters(options))
        self._passing: dict[int, int] = {}
        self._lasting: set[int] = set()
        self._updates = 0

    def start(self, keyframe: Keyframe, walk: Walk) -> None:
        """Begin at a keyframe with the filter's state as prior."""
        m = walk.memory
        self.builder.start(keyframe.stamp_ns, m.x, m.P)
        self._first = self.builder.keyframe
        self._update()
        self._bias = imu_bias(m.x)
        self._x = m.x.copy()

    def extend(self, keyframe: Keyframe, walk: Walk, problem: Problem) -> None:
        """Add a keyframe and what was measured since the last one; correct the filter's state with the result."""
        builder, x = self.builder, walk.memory.x
        gyro_accel = np.concatenate([self._bias.gyroscope(), self._bias.accelerometer()])
        between = detections(walk, problem, keyframe.between, builder.stamp_ns, gyro_accel)
        builder.add_keyframe(keyframe.stamp_ns, x, self._x, between, self._bias)
        for i, half in np.argwhere(keyframe.forgotten):
            kind, k = divmod(int(i), builder.layout.n_objects)
            builder.forget(k, kind, int(half))
        for detection in detections(walk, problem, keyframe.at, keyframe.stamp_ns, gyro_accel):
            builder.add_detection(detection)
        self._update()
        self.write_back(walk.memory)

    def _update(self) -> None:
        """Take in what is new, eliminated in order of time with the lasting variables last; let the oldest go.

        In that order a new keyframe touches the end of the window only, and the oldest variables are leaves.
        """
        builder, newest = self.builder, self.builder.keyframe
        graph, values, keyframes = builder.take()
        self._passing |= keyframes
        lasting = set(builder.lasting_keys)
        for key in self._lasting - lasting:
            self._passing[key] = newest - 1  # until now it was eliminated behind all keyframes before this one
        self._lasting = lasting
        self._updates += 1
        whole = self._relinearize_every > 0 and self._updates % self._relinearize_every == 0
        oldest = max(self._first, newest - (self._window if whole else _LOOSE))
        groups, again = gtsam.KeyGroupMap(), gtsam.KeyList()
        for key, keyframe in self._passing.items():
            if key in lasting:
                groups.insert2(key, newest - oldest + 1)
            else:
                groups.insert2(key, max(0, keyframe - oldest))
            if whole and key not in keyframes:
                again.push_back(key)
        self._smoother.update(graph, values, [], groups, None, again, whole)
        self._let_go(newest - self._window)

    def _let_go(self, until: int) -> None:
        leaving = sorted((k, key) for key, k in self._passing.items() if k <= until and key not in self._lasting)
        if leaving:
            keys = gtsam.KeyList()
            for _, key in leaving:
                keys.push_back(key)
                del self._passing[key]
            self._smoother.marginalizeLeaves(keys)

    def write_back(self, m: Memory) -> None:
        """Give the filter's memory the newest state and the joint covariance of all that it holds."""
        builder, smoother, layout = self.builder, self._smoother, self.builder.layout
        k = builder.keyframe
        self._bias = smoother.calculateEstimateConstantBias(imu_bias_key(k))
        T_world_imu = smoother.calculateEstimatePose3(pose_key(k))
        put_core(m.x, T_world_imu, smoother.calculateEstimateVector(velocity_key(k)), self._bias)
        keys = [pose_key(k), velocity_key(k), imu_bias_key(k)]
        blocks, indices, added = [core_to_filter(m.x[:9].reshape(3, 3))], list(range(CORE)), [np.zeros(CORE)]

        def include(key: int, block: Array, noise: Array, part: slice) -> None:
            keys.append(key)
            blocks.append(block)
            added.append(noise)
            indices.extend(range(part.start, part.stop))

        statics = [(EXTRINSICS, EXTRINSIC_ROTATION, layout.error_slice("extrinsics"))] if layout.extrinsics else []
        if layout.objects:
            for j in range(layout.n_objects):
                statics.append((object_key(j), OBJECTS + OBJECT_SIZE * j, layout.error_slice("objects", j)))
        for key, at, part in statics:
            put_pose3(m.x, at, smoother.calculateEstimatePose3(key))
            include(key, pose_to_filter(m.x[at : at + 9].reshape(3, 3)), np.zeros(6), part)
        for (j, kind), chain in builder.chains.items():
            if chain.key is not None:
                chain.mean = smoother.calculateEstimateVector(chain.key)
                phi, sigma = builder._step(chain)
                m.x[layout.nominal_bias(j, kind)] = phi * chain.mean
                include(chain.key, np.diag(phi), sigma**2, layout.error_slice("biases", j, kind))
        J = block_diag(*blocks)
        joint = smoother.jointMarginalCovariance(keys).fullMatrix()
        P = J @ joint @ J.T + np.diag(np.concatenate(added))
        m.P[np.ix_(indices, indices)] = 0.5 * (P + P.T)
        self._x = m.x.copy()
