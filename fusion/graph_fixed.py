"""From keyframes to linear factors: everything linearised once, where its variables start.

What is never linearised again needs no model that can be called again, and gtsam no types of its own: each factor is
white rows of numbers from a compiled model.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.columns import Columns, Fitted
from fusion.eskf import ACCEPTED
from fusion.graph_builder import GraphBuilder
from fusion.graph_linear import bias_rows, linearise
from fusion.graph_link import LINK_SIZES, link_keyframes
from fusion.graph_motion import MotionChain
from fusion.graph_variables import (
    EXTRINSICS,
    GRAVITY_KEY,
    OFFSET,
    Variable,
    imu_bias_key,
    keyframe_variables,
    object_key,
    pose_key,
    velocity_key,
)
from fusion.measurements import OBJECT_POSE
from fusion.memory import Memory
from fusion.nav_state import StateLayout
from fusion.options import Graph

Array = NDArray[np.float64]


def linear_factor(rows: Array, keys: Sequence[int], sizes: Sequence[int]) -> gtsam.NonlinearFactor:
    """Return white rows [A, b] as a factor on these variables, each linearised where it starts."""
    blocks = gtsam.VerticalBlockMatrix(sizes, rows, True)
    return gtsam.LinearContainerFactor(gtsam.GaussianConditional(keys, 1, blocks))


class FixedBuilder(GraphBuilder):
    """A builder whose factors stay linearised where they were."""

    def _keyframe_variables(self) -> list[Variable]:
        return keyframe_variables(self.keyframe, self.chain.with_imu, plain=True)

    def add_keyframe(self, stamp_ns: int, x: Array | None = None) -> None:
        """Add a keyframe where the motion predicts it, and the motion up to it."""
        chain, k = self.chain, self.keyframe
        if not chain.with_imu:
            super().add_keyframe(stamp_ns, x)
            return
        gravity, span = chain.estimates_gravity, (self.stamp_ns, stamp_ns)
        rows = link_keyframes(chain.stamps_ns, chain.values, *span, chain.densities, gravity, self.origin, self.x)
        keys = [key(n) for n in (k, k + 1) for key in (pose_key, velocity_key, imu_bias_key)]
        keys += [GRAVITY_KEY] if gravity else []
        self.graph.add(linear_factor(rows, keys, LINK_SIZES[: len(keys)]))
        self._add_keyframe(stamp_ns)

    def _bias_factor(
        self, before: int, variable: Variable, phi: Array, sigma: Array, began: Array
    ) -> gtsam.NonlinearFactor:
        rows = bias_rows(phi, sigma, began, self.x[variable.place])
        return linear_factor(rows, (before, variable.key), (6, 6))

    def add_linearised(self, log: Columns, fitted: Fitted, which: range) -> None:
        """Add measurements that passed the gate to the newest keyframe, as the filter used them."""
        parts = (column[which.start : which.stop].tolist() for column in (log.kinds, log.objects, log.decisions))
        seen = sorted({k for kind, k, rows in zip(*parts, strict=True) if kind == OBJECT_POSE and rows & ACCEPTED})
        private = [self._private_keys(k) for k in seen]
        motion, where = (self.stamp_ns, not self.chain.with_imu), (self.x, self.origin, self.model.integers)
        rows, begins = linearise(log, fitted, which.start, which.stop, *motion, *where)
        keys, sizes = self._common(int(log.stamps[which.start]) != self.stamp_ns)
        first = [int(begins[k]) for k in seen]
        for own, begin, end in zip(private, first, [*first, len(rows)][1:], strict=True):  # what all share is behind
            self.graph.add(linear_factor(rows[begin:end], own + keys, [6] * len(own) + sizes))
        if len(rows) and not seen:
            self.graph.add(linear_factor(rows[:, -1 - sum(sizes) :], keys, sizes))

    def _private_keys(self, k: int) -> list[int]:
        """Return the keys of what an object's measurements alone see; add what there is not yet."""
        biases = [self._bias_here(k, kind) for kind in range(self.layout.bias_kinds)]
        if self.layout.objects:
            self._meet(k)
            biases.append(object_key(k))
        return biases

    def _common(self, moved: bool) -> tuple[list[int], list[int]]:
        """Return keys and sizes of what every measurement at one stamp sees (moved: it is not the keyframe's)."""
        k, layout = self.keyframe, self.layout
        found = [(pose_key(k), 6)]
        found += [(velocity_key(k), 3)] if self.chain.with_imu and (moved or layout.time_offset) else []
        found += [(EXTRINSICS, 6)] if layout.extrinsics else []
        found += [(OFFSET, 1)] if layout.time_offset else []
        return [key for key, _ in found], [size for _, size in found]


def new_builder(layout: StateLayout, m: Memory, chain: MotionChain, options: Graph) -> GraphBuilder:
    """Return the builder of a graph that goes on from a filter's memory, fixed where it never linearises anew."""
    builder = GraphBuilder if options.relinearize_every else FixedBuilder
    return builder(layout, m.x, m.bias_model, chain, options)
