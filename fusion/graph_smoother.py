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
from scipy.linalg import solve_triangular

from fusion.eskf import ACCEPTED, POSITION_ONLY, ROTATION_ONLY, clone_pose
from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import Detection
from fusion.graph_odometry import odometry_at
from fusion.graph_variables import block_diagonal
from fusion.graph_walk import Keyframe, Walk
from fusion.measurements import ODOMETRY_STEP
from fusion.memory import Memory
from fusion.options import Graph

Array = NDArray[np.float64]


class FixedLagSmoother:
    """Keyframes of the last seconds as variables, older ones marginalised; cost per keyframe is constant."""

    def __init__(self, builder: GraphBuilder, options: Graph) -> None:
        self.builder, self._options = builder, options
        self._window = max(1, round(options.lag_s * options.keyframe_rate_hz))
        self._isam = gtsam.ISAM2(isam_parameters(options))
        self._came: dict[int, int] = {}
        self._lasting: set[int] = set()
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
        del other._isam
        return other

    def revived(self) -> FixedLagSmoother:
        """Return a smoother that goes on from what was kept, its window eliminated anew."""
        other = self._copy()
        other._isam = gtsam.ISAM2(isam_parameters(self._options))
        other._eliminate(self._factors, self._theta, self._came, True)
        return other

    def _copy(self) -> FixedLagSmoother:
        other = copy.copy(self)
        other.builder, other._came, other._lasting = self.builder.fork(), self._came.copy(), self._lasting.copy()
        return other

    def start(self, keyframe: Keyframe, walk: Walk) -> None:
        """Begin at a keyframe with the filter's state as prior."""
        m = walk.memory
        self.builder.start(keyframe.stamp_ns, m.x, m.P, m.known)
        self.builder.add_odometry(odometry_at(walk, keyframe))
        self._update()

    def extend(self, keyframe: Keyframe, walk: Walk) -> None:
        """Add a keyframe and what was measured since the last one; correct the filter's state with the result."""
        builder = self.builder
        builder.place_new_objects(walk.memory.x)
        builder.add_detections(detections(builder, walk, keyframe.between))
        builder.add_keyframe(keyframe.stamp_ns)
        forget_biases(builder, keyframe)
        builder.add_odometry(odometry_at(walk, keyframe))
        builder.add_detections(detections(builder, walk, keyframe.at))
        self._update()
        self._write_back(walk.memory)

    def _update(self) -> None:
        """Take in what is new and let the oldest go; variables are eliminated in order of time, lasting ones last."""
        newest, every = self.builder.keyframe, self._options.relinearize_every
        graph, values, came = self.builder.take()
        lasting = {variable.key for variable in self.builder.lasting}
        for key in self._lasting - lasting:
            self._came[key] = newest - 1  # until now it was eliminated behind all keyframes before this one
        self._came |= came
        self._lasting = lasting
        anew = every > 0 and (newest - self._first) % every == every - 1
        if not self._eliminate(graph, values, came, anew, anew):
            self._eliminate(gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, True)
        self._let_go(newest - self._window)

    def _eliminate(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        came: dict[int, int],
        whole: bool,
        anew: bool = False,
    ) -> bool:
        """Eliminate the end of the window or all of it, in order of time; tell whether that order is certain.

        COLAMD takes as many groups as it orders variables. Where ISAM2 eliminates more keyframes than have a group of
        their own (it does where cliques have merged, and all of them where most are concerned), the order of the oldest
        is left to chance, and they would be no leaves when they go.
        """
        newest, recent = self.builder.keyframe, 3 if self.builder.chain.with_imu else 9
        again = [key for key, k in self._came.items() if whole or k > newest - recent or key in self._lasting]
        oldest = max(self._first, newest + 2 - len(again))
        groups, old, certain = gtsam.KeyGroupMap(), gtsam.KeyList(), 0
        for key, keyframe in self._came.items():
            lasts = key in self._lasting
            groups.insert2(key, newest - oldest + 1 if lasts else max(0, keyframe - oldest))
            certain += lasts or keyframe >= oldest
        for key in again:
            if key not in came:
                old.push_back(key)
        result = self._isam.update(graph, values, [], groups, None, old, anew)
        return whole or int(result.getVariablesReeliminated()) <= certain

    def _let_go(self, until: int) -> None:
        leaving = sorted((k, key) for key, k in self._came.items() if k <= until and key not in self._lasting)
        keys = gtsam.KeyList()
        for _, key in leaving:
            keys.push_back(key)
            del self._came[key]
        if leaving:
            self._isam.marginalizeLeaves(keys)

    def _write_back(self, m: Memory) -> None:
        """Give the filter's memory the newest state and the joint covariance of all that it holds."""
        builder, variables = self.builder, self.builder.newest
        keys = [variable.key for variable in variables]
        estimate = self._isam.calculateEstimate(keys)
        for variable in variables:
            variable.read(estimate, builder.x)
            variable.read(estimate, m.x)
        at = [i for variable in variables for i in variable.errors]
        J = block_diagonal([variable.to_filter(builder.x) for variable in variables])
        P, begun = J @ joint_covariance(self._isam, keys) @ J.T, [c for c in builder.chains.values() if c.begun]
        for n, chain in enumerate(begun):  # they are the last of the newest
            phi, sigma = builder.step(chain)
            first, place = 6 * (n - len(begun)) + len(at), chain.variable.at
            m.x[place : place + 6] *= phi
            P[first : first + 6] *= phi[:, None]
            P[:, first : first + 6] *= phi
            P[range(first, first + 6), range(first, first + 6)] += sigma**2
        m.P[np.ix_(at, at)] = 0.5 * (P + P.T)
        if builder.clone == builder.keyframe:
            clone_pose(m.x, m.P, m.layout)


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
    R, _ = tree.jointBayesNet(keys, gtsam.EliminateQR).matrix()
    root = solve_triangular(R, np.eye(len(R)), check_finite=False)
    return np.asarray(root @ root.T)


def forget_biases(builder: GraphBuilder, keyframe: Keyframe) -> None:
    """Let the object biases jump that the filter has forgotten at a keyframe."""
    for i, half in np.argwhere(keyframe.forgotten):
        kind, k = divmod(int(i), builder.layout.n_objects)
        builder.forget(k, kind, int(half))


def detections(builder: GraphBuilder, walk: Walk, which: range) -> list[Detection]:
    """Return the poses of a keyframe that passed the gate, as the filter used them."""
    c = walk.columns
    decided = ((i, int(c.decisions[i]) & ACCEPTED) for i in which if c.kinds[i] != ODOMETRY_STEP)
    return [detection_of(builder, walk, i, builder.stamp_ns, builder.x, passed) for i, passed in decided if passed]


def detection_of(builder: GraphBuilder, walk: Walk, i: int, keyframe_ns: int, x: Array, passed: int) -> Detection:
    """Return those rows of measurement i that passed, after a keyframe with the nominal array x."""
    c, chain, stamp = walk.columns, builder.chain, int(walk.columns.stamps[i])
    first, end = 0 if passed & ROTATION_ONLY else 3, 6 if passed & POSITION_ONLY else 3
    return Detection(
        int(c.kinds[i]),
        int(c.objects[i]),
        first,
        end - first,
        walk.rotations[i].copy(),
        c.translations[i].copy(),
        walk.covariances[i].copy(),
        chain.motion(keyframe_ns, stamp, x),
        chain.rate(stamp, x),
        stamp != keyframe_ns,
    )
