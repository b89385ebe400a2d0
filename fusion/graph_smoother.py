"""The fixed-lag smoother, and its newest state handed back to the filter.

gtsam's IncrementalFixedLagSmoother leaves the order of elimination to a heuristic and so eliminates its whole window
anew for every keyframe. Here ISAM2 is told to eliminate in order of time: a new keyframe touches the end of the window
only, the oldest variables are leaves, and the joint covariance of the newest stands in the root.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

from fusion.eskf import ACCEPTED, POSITION_ONLY, ROTATION_ONLY
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import Detection
from fusion.graph_fixed import FixedBuilder
from fusion.graph_model import seen_at
from fusion.graph_odometry import odometry_at
from fusion.graph_walk import Keyframe, Walk
from fusion.measurements import CAMERA_POSE, OBJECT_POSE, ODOMETRY_STEP
from fusion.memory import CLONED, Memory
from fusion.new_states import clone_pose
from fusion.options import Graph

Array = NDArray[np.float64]
_NOWHERE = np.zeros(3)


class FixedLagSmoother:
    """Keyframes of the last seconds as variables, older ones marginalised; cost per keyframe is constant."""

    def __init__(self, builder: GraphBuilder, options: Graph) -> None:
        self.builder, self._options = builder, options
        least = 2 if options.relinearize_every else 1  # of one keyframe nothing is left to be linearised anew
        self._window = max(least, round(options.lag_s * options.keyframe_rate_hz))
        self._isam = gtsam.ISAM2(isam_parameters(options))
        self._came: dict[int, list[int]] = {}  # per keyframe, what does not last
        self._lasting: dict[int, None] = {}
        self._pinned: set[int] = set()  # what was marginalised holds them where they were linearised
        self._first = builder.keyframe + 1
        self._factors, self._theta = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def kept(self) -> FixedLagSmoother:
        """Return what `revived` needs to begin from here again; it shares nothing with this one that changes."""
        other = self._copy()
        factors, other._factors = self._isam.getFactorsUnsafe(), gtsam.NonlinearFactorGraph()
        for factor in (factors.at(i) for i in range(factors.size())):
            if factor is not None:
                other._factors.add(factor)
        other._theta = gtsam.Values(self._isam.getLinearizationPoint())
        other._pinned = self._pinned.union(self._isam.getFixedVariables())
        del other._isam
        return other

    def revived(self) -> FixedLagSmoother:
        """Return a smoother that goes on from what was kept, its window eliminated anew."""
        other = self._copy()
        other._isam = gtsam.ISAM2(isam_parameters(self._options))
        other._eliminate(self._factors, self._theta, True)
        return other

    def _copy(self) -> FixedLagSmoother:
        other = copy.copy(self)
        other.builder, other._lasting = self.builder.fork(), self._lasting.copy()
        other._came = {keyframe: keys.copy() for keyframe, keys in self._came.items()}
        return other

    def start(self, keyframe: Keyframe, walk: Walk) -> None:
        """Begin at a keyframe with the filter's state as prior."""
        m = walk.memory
        self.builder.start(keyframe.stamp_ns, m.x, m.P, m.known)
        self.builder.follow_spreads(m.x)
        self.builder.add_odometry(odometry_at(walk, keyframe))
        if self.builder.clone < 0:
            m.counters[CLONED] = 0  # a pose that this graph does not have
        self._update()

    def extend(self, keyframe: Keyframe, walk: Walk) -> None:
        """Add a keyframe and what was measured since the last one; correct the filter's state with the result."""
        builder = self.builder
        builder.place_new_objects(walk.memory.x)
        builder.follow_spreads(walk.memory.x)
        add_measurements(builder, walk, keyframe.between)
        builder.add_keyframe(keyframe.stamp_ns)
        forget_biases(builder, keyframe)
        builder.add_odometry(odometry_at(walk, keyframe))
        add_measurements(builder, walk, keyframe.at)
        self._update()
        self._write_back(walk.memory)

    def _update(self) -> None:
        """Take in what is new and let the oldest go; variables are eliminated in order of time, lasting ones last."""
        newest, every = self.builder.keyframe, self._options.relinearize_every
        graph, values, came = self.builder.take()
        lasting = dict.fromkeys(variable.key for variable in self.builder.lasting)
        for key in self._lasting:
            if key not in lasting:  # until now it was eliminated behind all keyframes before this one
                self._came.setdefault(newest - 1, []).append(key)
        for key in lasting:
            if key not in self._lasting and key not in came:  # a keyframe's pose that odometry is measured from
                self._came[newest - 1].remove(key)
        for key, keyframe in came.items():
            if key not in lasting:
                self._came.setdefault(keyframe, []).append(key)
        self._lasting = lasting
        anew = every > 0 and (newest - self._first) % every == every - 1
        if not self._eliminate(graph, values, anew, anew):
            self._eliminate(gtsam.NonlinearFactorGraph(), gtsam.Values(), True)
        if anew:
            self._read_origin()
        self._let_go(newest - self._window)

    def _eliminate(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, whole: bool, anew: bool = False
    ) -> bool:
        """Eliminate the end of the window or all of it, in order of time; tell whether that order is certain.

        COLAMD takes as many groups as it orders variables. Where ISAM2 eliminates more keyframes than have a group of
        their own (it does where cliques have merged, and all of them where most are concerned), the order of the oldest
        is left to chance, and they would be no leaves when they go.
        """
        newest, recent = self.builder.keyframe, 2 if self.builder.chain.with_imu else 9
        again = [*self._lasting]
        for keyframe, keys in self._came.items():
            if whole or keyframe > newest - recent:
                again += keys
        oldest = max(self._first, newest + 2 - len(again))
        groups, old, certain = gtsam.KeyGroupMap(), gtsam.KeyList(), len(self._lasting)
        for key in self._lasting:
            groups.insert2(key, newest - oldest + 1)
        for keyframe, keys in self._came.items():
            if keyframe < oldest:  # in the first group, as those at the oldest are
                continue
            for key in keys:
                groups.insert2(key, keyframe - oldest)
            certain += len(keys)
        for key in again:
            if not values.exists(key):
                old.push_back(key)
        pinned = gtsam.KeyList()
        for key in self._pinned if anew else ():
            pinned.push_back(key)
        result = self._isam.update(graph, values, [], groups, pinned, old, anew)
        return whole or int(result.getVariablesReeliminated()) <= certain

    def _let_go(self, until: int) -> None:
        keys = gtsam.KeyList()
        for keyframe in sorted(keyframe for keyframe in self._came if keyframe <= until):
            for key in sorted(self._came.pop(keyframe)):
                keys.push_back(key)
        if keys.size():
            self._isam.marginalizeLeaves(keys)

    def _read_origin(self) -> None:
        """Read where the newest variables are linearised."""
        theta = self._isam.getLinearizationPoint()
        for variable in self.builder.newest:
            variable.read(theta, self.builder.origin)

    def _write_back(self, m: Memory) -> None:
        """Give the filter's memory the newest state and the joint covariance of all that it holds.

        The root of the joint information knows both: how far the newest variables have come from where they were
        linearised, and how sure that is. So nothing older has to be solved for.
        """
        builder, variables = self.builder, self.builder.newest
        root, step = newest_root(self._isam, [variable.key for variable in variables])
        arrangement = builder.arrangement(variables)
        J_root = arrangement.settle(builder.origin, builder.x, m.x, step, root)
        m.P[arrangement.errors[:, None], arrangement.errors] = self._carried(J_root @ J_root.T, m.x)
        if builder.clone == builder.keyframe:
            clone_pose(m.x, m.P, m.layout)

    def _carried(self, P: Array, x: Array) -> Array:
        """Return a covariance of the newest variables, and change x, with all object biases as they are by now."""
        builder = self.builder
        begun = [chain for chain in builder.chains.values() if chain.begun]
        if all(map(builder.unchanged, begun)):
            return P
        left, variances, first = np.ones(len(P)), np.zeros(len(P)), len(P) - 6 * len(begun)  # the last of the newest
        for n, chain in enumerate(begun):
            if not builder.unchanged(chain):
                part, at = slice(first + 6 * n, first + 6 * n + 6), chain.variable.at
                left[part], sigma = builder.step(chain)
                x[at : at + 6] *= left[part]
                variances[part] = sigma**2
        P *= left[:, None] * left
        P.reshape(-1)[:: len(P) + 1] += variances
        return P


def isam_parameters(options: Graph) -> gtsam.ISAM2Params:
    """Return parameters under which the IMU's small noise leaves no indeterminate system: QR, not Cholesky."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.setRelinearizeThreshold(options.relinearize)
    params.relinearizeSkip = 1_000_000_000  # only where it is asked for
    params.findUnusedFactorSlots = True
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))  # every change is carried through, however small
    return params


def joint_covariance(tree: gtsam.ISAM2 | gtsam.GaussianBayesTree, keys: Sequence[int]) -> Array:
    """Return the joint marginal covariance of variables in this order, by QR: gtsam's own way takes Cholesky."""
    root, _ = newest_root(tree, keys)
    return np.asarray(root @ root.T)


def newest_root(tree: gtsam.ISAM2 | gtsam.GaussianBayesTree, keys: Sequence[int]) -> tuple[Array, Array]:
    """Return a root of the joint covariance of variables in this order, and their step from the linearisation."""
    R, d = tree.jointBayesNet(keys, gtsam.EliminateQR).matrix()
    root, _ = dtrtri(R)
    return root, root @ d


def forget_biases(builder: GraphBuilder, keyframe: Keyframe) -> None:
    """Let the object biases jump that the filter has forgotten at a keyframe."""
    for one in keyframe.forgotten:
        builder.forget(one)


def add_measurements(builder: GraphBuilder, walk: Walk, which: range) -> None:
    """Add the measurements that passed the gate to the newest keyframe, together where the graph lets them be."""
    if not which:
        return
    c, layout = walk.columns, builder.layout
    whole = c.stamps[which[0]] == builder.stamp_ns and not (layout.extrinsics or layout.time_offset)
    native = whole and CAMERA_POSE in c.kinds[which.start : which.stop].tolist()  # gtsam has a factor for it
    if isinstance(builder, FixedBuilder) and not native:
        builder.add_linearised(c, walk.fitted, which)
    else:
        builder.add_detections(detections(builder, walk, which))


def detections(builder: GraphBuilder, walk: Walk, which: range) -> list[Detection]:
    """Return the poses of a keyframe that passed the gate, as the filter used them."""
    c = walk.columns
    decided = ((i, int(c.decisions[i]) & ACCEPTED) for i in which if c.kinds[i] != ODOMETRY_STEP)
    return [detection_of(builder, walk, i, builder.stamp_ns, builder.x, passed) for i, passed in decided if passed]


def detection_of(builder: GraphBuilder, walk: Walk, i: int, keyframe_ns: int, x: Array, passed: int) -> Detection:
    """Return those rows of measurement i that passed, after a keyframe with the nominal array x."""
    c, chain, stamp = walk.columns, builder.chain, int(walk.columns.stamps[i])
    first, end = 0 if passed & ROTATION_ONLY else 3, 6 if passed & POSITION_ONLY else 3
    k, motion = int(c.objects[i]), chain.motion(keyframe_ns, stamp, x)
    return Detection(
        int(c.kinds[i]),
        k,
        first,
        end - first,
        walk.fitted.rotations[i].copy(),
        c.translations[i].copy(),
        walk.fitted.covariances[i].copy(),
        motion,
        chain.rate(stamp, x),
        stamp != keyframe_ns,
        seen_at(k, motion, x) if c.kinds[i] == OBJECT_POSE else _NOWHERE,
    )
