"""From keyframes to variables and factors."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion import object_biases
from fusion.graph_arrangement import Arrangement
from fusion.graph_factors import Detection, Model, bias_factor, measurement_factor
from fusion.graph_model import bias_step
from fusion.graph_motion import MotionChain
from fusion.graph_odometry import OdometryStep, odometry_factor
from fusion.graph_variables import (
    CloneVariable,
    Variable,
    errors_of,
    joint_prior,
    keyframe_variables,
    object_bias_key,
    object_variable,
    pose_key,
    static_variables,
)
from fusion.graph_walk import Forgotten
from fusion.measurements import OBJECT_POSE
from fusion.nav_state import OBJECT_SIZE, StateLayout
from fusion.options import Graph

Array = NDArray[np.float64]

_ANYWHERE = np.repeat([10.0, 100.0], 3)  # rad, m: an object whose pose nothing is known of


@dataclass(frozen=True)
class BiasModel:
    """The Gauss-Markov model of the object biases, as the filter's memory has it."""

    values: Array

    def stationary(self, kind: int) -> Array:
        """Return the stationary 1-sigma (6,) of a kind of bias."""
        return np.array([object_biases.bias_sigma(self.values, kind, i) for i in range(6)])

    def constant(self, kind: int) -> bool:
        """Tell whether a kind of bias stays as it is for ever."""
        return bool(object_biases.is_steady.py_func(self.values, kind))

    def step(self, kind: int, mean: Array, seconds: float) -> tuple[Array, Array]:
        """Return factor and 1-sigma, each (6,), of what a bias does in some seconds (`object_biases.decay_biases`)."""
        left, sigma = np.empty(6), np.empty(6)
        bias_step(self.values, kind, mean, seconds, left, sigma)
        return left, sigma


@dataclass
class BiasChain:
    """One bias of one object over time: its newest variable, or what is known before there is one."""

    kind: int
    variable: Variable
    """Key of the newest variable, -1 before there is one; places of the object's bias."""
    sigma: Array
    stamp_ns: int

    @property
    def begun(self) -> bool:
        """Whether there is a variable."""
        return self.variable.key >= 0


class GraphBuilder:
    """Collects what a new keyframe adds: factors, initial values, and the keyframe at which each variable came.

    Object poses, where they are estimated, and extrinsics, time offset and gravity are one variable each. An object's
    bias has a variable per keyframe that sees the object. x is the nominal array from which new variables start, origin
    the one where the newest did, clone the keyframe of the last odometry, -1 where there was none.
    """

    def __init__(
        self,
        layout: StateLayout,
        x: Array,
        bias_model: Array,
        chain: MotionChain,
        options: Graph,
    ) -> None:
        self.layout, self.bias_model, self.chain = layout, BiasModel(bias_model.copy()), chain
        self.model = Model(layout, x.copy(), chain.with_imu, options)
        self.keyframe, self.stamp_ns, self.x, self.origin = -1, 0, x.copy(), x.copy()
        self._spreads = slice(layout.spread_start, None)
        self._own: list[Variable] = []
        self._arrangement = Arrangement([])
        self._arranged = (0, 0, False)
        self.chains: dict[tuple[int, int], BiasChain] = {}
        self._statics: dict[int, Variable] = {}
        self._bias_count = 0
        self.clone = -1
        self._clear()

    def _clear(self) -> None:
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.keyframes: dict[int, int] = {}

    def fork(self) -> GraphBuilder:
        """Return a copy, of a builder whose additions have been taken, that may go its own way."""
        other = copy.copy(self)
        other._clear()
        other.x, other.origin, other._statics = self.x.copy(), self.origin.copy(), self._statics.copy()
        other.chains = {which: copy.copy(chain) for which, chain in self.chains.items()}
        return other

    def take(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, int]]:
        """Return what was added since the last call: factors, initial values, each variable's keyframe."""
        added = self.graph, self.values, self.keyframes
        self._clear()
        return added

    @property
    def newest(self) -> list[Variable]:
        """The newest keyframe's variables and those that last."""
        return self._own + self.lasting

    def arrangement(self, newest: Sequence[Variable]) -> Arrangement:
        """Return where the newest variables stand; only more of them, or the last odometry's pose, change that."""
        arranged = len(newest), len(self._statics), 0 <= self.clone < self.keyframe  # no other goes within a graph
        if arranged != self._arranged:
            self._arrangement, self._arranged = Arrangement(newest), arranged
        return self._arrangement

    @property
    def statics(self) -> list[Variable]:
        """Extrinsics, time offset, gravity and object poses as far as they are estimated."""
        return list(self._statics.values())

    @property
    def lasting(self) -> list[Variable]:
        """What must not be marginalised: statics, objects, the last odometry's pose, each object's newest biases."""
        clone = [self._clone_variable()] if 0 <= self.clone < self.keyframe else []
        return [*self._statics.values(), *clone, *(chain.variable for chain in self.chains.values() if chain.begun)]

    def _clone_variable(self) -> Variable:
        return CloneVariable(pose_key(self.clone), errors_of(self.layout, "clone"), self.layout.clone_start)

    @property
    def newest_biases(self) -> list[tuple[int, int]]:
        """Key (-1: none yet) and stamp of each object bias's newest variable, in the order of the state."""
        kinds, objects = range(self.layout.bias_kinds), range(self.layout.n_objects)
        chains = (self.chains[k, kind] for kind in kinds for k in objects)
        return [(chain.variable.key, chain.stamp_ns) for chain in chains]

    def start(self, stamp_ns: int, x: Array, P: Array, known: Array, start_from: Array | None = None) -> None:
        """Begin a graph with the filter's state as prior, object biases among it where anything ties them to the rest.

        known (K,) tells which object poses the filter knows; the others come in when they are first seen. Initial
        values are those of x, or of start_from.
        """
        self._clear()
        self._arranged = (0, 0, False)
        self.x, layout, self.clone = x.copy() if start_from is None else start_from.copy(), self.layout, -1
        self.origin = self.x.copy()
        self._statics = {variable.key: variable for variable in static_variables(layout)}
        for k in range(layout.n_objects if layout.objects else 0):
            if known[k] > 0.0:
                self._statics[object_variable(layout, k).key] = object_variable(layout, k)
        self._add_keyframe(stamp_ns)
        for variable in self._statics.values():
            self._add(variable)
        self.chains = {}
        for k in range(layout.n_objects):
            for kind in range(layout.bias_kinds):
                self.chains[k, kind] = self._first_bias(k, kind, P)
        first = self._own + list(self._statics.values())
        first += [chain.variable for chain in self.chains.values() if chain.begun]
        self.graph.add(joint_prior(first, x, P))

    def _first_bias(self, k: int, kind: int, P: Array) -> BiasChain:
        """Return an object's bias at the first keyframe: a variable where P ties it to anything but itself."""
        layout = self.layout
        errors, at = errors_of(layout, "biases", k, kind), layout.nominal_bias(k, kind).start
        rows = P[errors.start : errors.stop].copy()
        sigma = np.sqrt(np.diag(rows[:, errors.start :]))
        rows[:, errors.start : errors.stop] = 0.0
        chain = BiasChain(kind, Variable(-1, errors, at), sigma, self.stamp_ns)
        if rows.any():
            chain.variable = self._new_bias(chain)
        return chain

    def _new_bias(self, chain: BiasChain) -> Variable:
        variable = Variable(object_bias_key(self._bias_count), chain.variable.errors, chain.variable.at)
        self._bias_count += 1
        self._add(variable)
        return variable

    def _add(self, variable: Variable) -> None:
        variable.insert(self.values, self.x)
        place = variable.place
        self.origin[place] = self.x[place]
        self.keyframes[variable.key] = self.keyframe

    def _add_keyframe(self, stamp_ns: int) -> None:
        self.keyframe, self.stamp_ns = self.keyframe + 1, stamp_ns
        self._own = self._keyframe_variables()
        for variable in self._own:
            self._add(variable)

    def _keyframe_variables(self) -> list[Variable]:
        return keyframe_variables(self.keyframe, self.chain.with_imu)

    def add_keyframe(self, stamp_ns: int, x: Array | None = None) -> None:
        """Add a keyframe and the motion up to it; it starts from x, or from what the motion predicts."""
        link, predicted = self.chain.link(self.keyframe, self.stamp_ns, stamp_ns, self.x)
        self.graph.add(link)
        self.x = predicted if x is None else x.copy()
        self._add_keyframe(stamp_ns)

    def add_detections(self, detections: Iterable[Detection]) -> None:
        """Add detections to the newest keyframe."""
        for d in detections:
            kinds = range(self.layout.bias_kinds if d.kind == OBJECT_POSE else 0)
            if self.layout.objects and d.kind == OBJECT_POSE:
                self._meet(d.object)
            biases = [self._bias_here(d.object, kind) for kind in kinds]
            self.graph.add(measurement_factor(d, self.keyframe, biases, self.model))

    def add_odometry(self, step: OdometryStep | None) -> None:
        """Add the odometry that ends at the newest keyframe, where there is one; the next is measured from there."""
        if step is None:
            return
        if self.clone >= 0 and step.size > 0:
            self.graph.add(odometry_factor(step, self.clone, self.keyframe, self.model))
        self.clone = self.keyframe
        self.origin[self._clone_variable().place] = self.origin[:OBJECT_SIZE]

    def place_new_objects(self, x: Array) -> None:
        """Let objects that the graph has not met start where they stand in a nominal array."""
        for k in range(self.layout.n_objects if self.layout.objects else 0):
            variable = object_variable(self.layout, k)
            if variable.key not in self._statics:
                self.x[variable.at : variable.at + OBJECT_SIZE] = x[variable.at : variable.at + OBJECT_SIZE]

    def follow_spreads(self, x: Array) -> None:
        """Let the objects' biases spread, from here on, as a nominal array of the filter says.

        Factors keep the model that they were made with: whenever they are linearised, their biases spread as then.
        """
        spreads = x[self._spreads]
        self.x[self._spreads] = self.origin[self._spreads] = spreads
        if not np.array_equal(self.model.x[self._spreads], spreads):
            self.model = replace(self.model, x=np.append(self.model.x[: self._spreads.start], spreads))

    def _meet(self, k: int) -> None:
        """Add an object's pose where it is seen for the first time."""
        variable = object_variable(self.layout, k)
        if variable.key not in self._statics:
            self._statics[variable.key] = variable
            self._add(variable)
            anywhere = gtsam.noiseModel.Diagonal.Sigmas(_ANYWHERE)
            self.graph.addPriorPose3(variable.key, self.values.atPose3(variable.key), anywhere)

    def forget(self, bias: Forgotten) -> None:
        """Let half of an object's bias be another from the newest keyframe on."""
        chain, part = self.chains[bias.object, bias.kind], slice(3 * bias.half, 3 * bias.half + 3)
        phi, sigma = self.step(chain)
        phi[part], sigma[part] = 0.0, bias.sigma
        if chain.begun:
            self._add_bias(chain, phi, np.maximum(sigma, 1e-6))
        else:
            chain.sigma, chain.stamp_ns = np.hypot(phi * chain.sigma, sigma), self.stamp_ns

    def _bias_here(self, k: int, kind: int) -> int:
        """Return the key of an object's bias at the newest keyframe."""
        chain = self.chains[k, kind]
        if chain.begun and self.unchanged(chain):
            return chain.variable.key
        phi, sigma = self.step(chain)
        if not chain.begun:
            chain.sigma, chain.stamp_ns = np.hypot(phi * chain.sigma, sigma), self.stamp_ns
            self._add_bias(chain, None, chain.sigma)
        elif sigma.any():
            self._add_bias(chain, phi, sigma)
        return chain.variable.key

    def unchanged(self, chain: BiasChain) -> bool:
        """Tell whether a bias is at the newest keyframe what its newest variable says."""
        return chain.stamp_ns == self.stamp_ns or self.bias_model.constant(chain.kind)

    def step(self, chain: BiasChain) -> tuple[Array, Array]:
        """Return factor and 1-sigma, each (6,), from a bias's newest variable to the newest keyframe."""
        at, seconds = chain.variable.at, (self.stamp_ns - chain.stamp_ns) * 1e-9
        return self.bias_model.step(chain.kind, self.x[at : at + 6], seconds)

    def _add_bias(self, chain: BiasChain, phi: Array | None, sigma: Array) -> None:
        """Add a bias variable at the newest keyframe: with a prior, or a step from the one before."""
        before, at = chain.variable, chain.variable.at
        began = self.origin[at : at + 6].copy()
        if phi is not None:
            self.x[at : at + 6] *= phi
        chain.variable, chain.stamp_ns = self._new_bias(chain), self.stamp_ns
        if phi is None:
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
            self.graph.addPriorVector(chain.variable.key, np.zeros(6), noise)
        else:
            self.graph.add(self._bias_factor(before.key, chain.variable, phi, sigma, began))

    def _bias_factor(
        self, before: int, variable: Variable, phi: Array, sigma: Array, began: Array
    ) -> gtsam.NonlinearFactor:
        """Return the step to a bias from the one before, which began at `began`."""
        return bias_factor(before, variable.key, phi, sigma)
