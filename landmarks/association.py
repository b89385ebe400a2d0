"""Which detection is which landmark, and which turn of a symmetric object is meant.

Where each class has one landmark and one detection, the class decides. Elsewhere hypotheses about the camera pose
compete: every vote that one detection, read as one landmark in one of its symmetric turns, casts alone, and every pair
of continuously symmetric objects together. A hypothesis assigns the detections at the least total cost (Hungarian
method); the cheapest wins, and the previous frame's winner counts as half a vote, which breaks ties and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from landmarks.landmark_map import CONTINUOUS, MapArrays, turn_about
from landmarks.options import SolverOptions
from poet_loc.core.geometry import chordal_mean
from poet_loc.core.records import ObjectPoses

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_PREVIOUS_WEIGHT = 0.5  # of a vote
_FREE = 0.25  # what a hypothesis costs whose turn about an axis nobody measured
_NOBODY = 1.0  # what a detection without a landmark costs: more than any landmark of its class
_FORBIDDEN = 1e3


@dataclass(frozen=True)
class Association:
    """What each of N detections is."""

    landmarks: Indices
    """(N,) index into the map, -1: none."""
    R_cam_obj: Array
    """(N, 3, 3) the detections' rotations in the symmetric turn that fits the frame's other votes."""


@dataclass(frozen=True)
class _Pairs:
    """A detection read as a landmark of its class, in one of its symmetric turns."""

    detections: Indices
    landmarks: Indices
    R_cam_obj: Array

    def __getitem__(self, index: Indices | NDArray[np.bool_]) -> _Pairs:
        return _Pairs(self.detections[index], self.landmarks[index], self.R_cam_obj[index])


@dataclass(frozen=True)
class _Hypotheses:
    """Camera poses that compete, sorted by frame."""

    frames: Indices
    pairs: _Pairs
    """Which pair casts it."""
    R_world_cam: Array
    t_world_cam: Array
    free: NDArray[np.bool_]
    """Cast by a continuously symmetric object alone: any turn about its axis is as good."""

    def __getitem__(self, index: Indices | slice) -> _Hypotheses:
        return _Hypotheses(*(getattr(self, each.name)[index] for each in fields(self)))


def associate(object_poses: ObjectPoses, arrays: MapArrays, options: SolverOptions) -> Association:
    """Return the landmark and the turn of each detection; causal, frame after frame.

    A detection whose class the map does not have, or has fewer of than the frame has detections, gets -1.
    """
    return _Associator(object_poses, arrays, options).result()


class _Associator:
    def __init__(self, object_poses: ObjectPoses, arrays: MapArrays, options: SolverOptions) -> None:
        self.arrays, self.options = arrays, options
        self.R_cam_obj = np.reshape(object_poses.T_cam_obj.rotation.as_matrix(), (-1, 3, 3))
        self.t_cam_obj = np.reshape(object_poses.T_cam_obj.translation, (-1, 3))
        self.stamps, self.frame_of = np.unique(object_poses.stamps_ns, return_inverse=True)
        self.scores = object_poses.scores
        self.candidates = self._candidates(object_poses)

    def _candidates(self, object_poses: ObjectPoses) -> _Pairs:
        """Return every detection with every landmark that it may be."""
        match = object_poses.object_ids[:, None] == self.arrays.object_ids
        if self.options.trust_instances:
            named = match & (object_poses.instances[:, None] == self.arrays.instances)
            match = np.where(named.any(axis=1, keepdims=True), named, match)
        detections, landmarks = np.nonzero(match)
        return _Pairs(detections, landmarks, self.R_cam_obj[detections])

    def result(self) -> Association:
        pairs, frames = self.candidates, len(self.stamps)
        choices = np.bincount(pairs.detections, minlength=len(self.frame_of))
        claims = np.bincount(self.frame_of[pairs.detections] * len(self.arrays) + pairs.landmarks)
        contested = np.unique(np.flatnonzero(claims > 1) // max(len(self.arrays), 1))
        ambiguous = np.zeros(frames, bool)
        ambiguous[self.frame_of[choices > 1]] = ambiguous[contested] = True
        unclear = ambiguous.copy()
        unclear[self.frame_of[pairs.detections[self.arrays.orders[pairs.landmarks] != 1]]] = True

        landmarks = np.full(len(self.frame_of), -1, np.intp)
        clear = ~ambiguous[self.frame_of[pairs.detections]]
        landmarks[pairs.detections[clear]] = pairs.landmarks[clear]
        if not unclear.any():
            return Association(landmarks, self.R_cam_obj)
        return self._resolve(landmarks, ambiguous, unclear)

    def _resolve(self, landmarks: Indices, ambiguous: NDArray[np.bool_], unclear: NDArray[np.bool_]) -> Association:
        wanted = unclear.copy()
        wanted[:-1] |= unclear[1:]  # the frame before an unclear one is its previous frame
        pairs = self.candidates[wanted[self.frame_of[self.candidates.detections]]]
        hypotheses = self._hypotheses(pairs)
        totals = self._totals(hypotheses, pairs, ambiguous) + _FREE * hypotheses.free
        R_world_cam, t_world_cam = self._choose(hypotheses, totals)
        for frame in np.flatnonzero(ambiguous):
            mine = pairs[self.frame_of[pairs.detections] == frame]
            cost = self._costs(mine, R_world_cam[[frame]], t_world_cam[[frame]])
            for detection, landmark in self._assign(mine, cost)[1]:
                landmarks[detection] = landmark
        known = np.flatnonzero(unclear[self.frame_of] & (landmarks >= 0))
        R_cam_obj = self.R_cam_obj.copy()
        R_cam_obj[known] = self._fitting(known, landmarks[known], R_world_cam[self.frame_of[known]])
        return Association(landmarks, R_cam_obj)

    def _fitting(self, detections: Indices, landmarks: Indices, R_world_cam: Array) -> Array:
        expected = np.swapaxes(R_world_cam, -1, -2) @ self.arrays.R_world_obj[landmarks]
        return self.arrays.nearest_symmetry(landmarks, self.R_cam_obj[detections], expected)

    def _votes(self, pairs: _Pairs) -> tuple[Array, Array]:
        R_world_cam = self.arrays.R_world_obj[pairs.landmarks] @ np.swapaxes(pairs.R_cam_obj, -1, -2)
        lever = np.einsum("nij,nj->ni", R_world_cam, self.t_cam_obj[pairs.detections])
        return R_world_cam, self.arrays.t_world_obj[pairs.landmarks] - lever

    def _hypotheses(self, pairs: _Pairs) -> _Hypotheses:
        alone = self._in_every_turn(pairs)
        first, R_of_two, t_of_two = self._votes_of_two(pairs)
        R_alone, t_alone = self._votes(alone)
        casting = _Pairs(
            np.concatenate([alone.detections, first.detections]),
            np.concatenate([alone.landmarks, first.landmarks]),
            np.concatenate([alone.R_cam_obj, first.R_cam_obj]),
        )
        frames = self.frame_of[casting.detections]
        free = (self.arrays.orders[casting.landmarks] == CONTINUOUS) & (np.arange(len(frames)) < len(R_alone))
        R, t = np.concatenate([R_alone, R_of_two]), np.concatenate([t_alone, t_of_two])
        # an order that does not depend on the order of the rows: ties go to the first
        order = np.lexsort((-self.scores[casting.detections], casting.landmarks, frames))
        return _Hypotheses(frames, casting, R, t, free)[order]

    def _in_every_turn(self, pairs: _Pairs) -> _Pairs:
        turns = np.maximum(self.arrays.orders[pairs.landmarks], 1)
        row = np.repeat(np.arange(len(turns)), turns)
        rank = np.arange(len(row)) - np.repeat(np.cumsum(turns) - turns, turns)
        landmarks = pairs.landmarks[row]
        turned = pairs.R_cam_obj[row] @ turn_about(self.arrays.axes[landmarks], 2.0 * np.pi * rank / turns[row])
        R_cam_obj = np.where((rank == 0)[:, None, None], pairs.R_cam_obj[row], turned)
        return _Pairs(pairs.detections[row], landmarks, R_cam_obj)

    def _votes_of_two(self, pairs: _Pairs) -> tuple[_Pairs, Array, Array]:
        """Return the poses that two continuously symmetric objects vote for: their axes and the line between them."""
        round_pairs = pairs[self.arrays.orders[pairs.landmarks] == CONTINUOUS]
        first, second = _same_frame(self.frame_of[round_pairs.detections], self.frame_of[round_pairs.detections])
        one, two = round_pairs[first], round_pairs[second]
        keep = (one.detections < two.detections) & (one.landmarks != two.landmarks)
        one, two = one[keep], two[keep]
        axes_cam, axes_world = [], []
        for each in (one, two):
            axis = self.arrays.axes[each.landmarks]
            axes_cam.append(np.einsum("nij,nj->ni", each.R_cam_obj, axis))
            axes_world.append(np.einsum("nij,nj->ni", self.arrays.R_world_obj[each.landmarks], axis))
        t_cam = [self.t_cam_obj[each.detections] for each in (one, two)]
        t_world = [self.arrays.t_world_obj[each.landmarks] for each in (one, two)]
        in_cam = np.stack([*axes_cam, _unit(t_cam[1] - t_cam[0])], axis=1)
        in_world = np.stack([*axes_world, _unit(t_world[1] - t_world[0])], axis=1)
        R = chordal_mean(np.einsum("nki,nkj->nkij", in_world, in_cam), np.ones((len(in_cam), 3)))
        middle_cam = np.einsum("nij,nj->ni", R, (t_cam[0] + t_cam[1]) / 2)
        return one, R, (t_world[0] + t_world[1]) / 2 - middle_cam

    def _totals(self, hypotheses: _Hypotheses, pairs: _Pairs, ambiguous: NDArray[np.bool_]) -> Array:
        """Return what the best assignment under each hypothesis costs."""
        row, pair = _same_frame(hypotheses.frames, self.frame_of[pairs.detections])
        costs = self._costs(pairs[pair], hypotheses.R_world_cam[row], hypotheses.t_world_cam[row])
        totals: Array = np.bincount(row, weights=costs, minlength=len(hypotheses.frames)).astype(float)
        bounds = np.searchsorted(row, np.arange(len(hypotheses.frames) + 1))
        for index in np.flatnonzero(ambiguous[hypotheses.frames]):
            mine = slice(bounds[index], bounds[index + 1])
            totals[index] = self._assign(pairs[pair[mine]], costs[mine])[0]
        return totals

    def _costs(self, pairs: _Pairs, R_world_cam: Array, t_world_cam: Array) -> Array:
        """Return 0 for a vote equal to the hypothesis, 1/2 at the thresholds, towards 1 far away."""
        turned = pairs.R_cam_obj.copy()
        symmetric = np.flatnonzero(self.arrays.orders[pairs.landmarks] != 1)
        R_there = np.broadcast_to(R_world_cam, turned.shape)[symmetric]
        turned[symmetric] = self._fitting(pairs.detections[symmetric], pairs.landmarks[symmetric], R_there)
        R, t = self._votes(_Pairs(pairs.detections, pairs.landmarks, turned))
        return self._difference(R, t, R_world_cam, t_world_cam)

    def _difference(self, R_a: Array, t_a: Array, R_b: Array, t_b: Array) -> Array:
        cosine = (np.sum(R_a * R_b, axis=(-1, -2)) - 1.0) / 2.0
        angle = np.arccos(np.clip(cosine, -1.0, 1.0)) / np.radians(self.options.angle_deg)
        distance = np.linalg.norm(t_a - t_b, axis=-1) / self.options.distance
        square = (angle**2 + distance**2) / 2.0
        return square / (1.0 + square)

    def _assign(self, pairs: _Pairs, costs: Array) -> tuple[float, list[tuple[int, int]]]:
        detections, row = np.unique(pairs.detections, return_inverse=True)
        there, column = np.unique(pairs.landmarks, return_inverse=True)
        table = np.full((len(detections), len(there) + len(detections)), _FORBIDDEN)
        table[:, len(there) :] = _NOBODY
        table[row, column] = costs
        rows, columns = linear_sum_assignment(table)
        named = [(int(detections[i]), int(there[j])) for i, j in zip(rows, columns, strict=True) if j < len(there)]
        return float(table[rows, columns].sum()), named

    def _choose(self, hypotheses: _Hypotheses, totals: Array) -> tuple[Array, Array]:
        """Return the winner of each frame, (F, 3, 3) and (F, 3); the identity where a frame has no hypothesis."""
        frames = len(self.stamps)
        R_world_cam, t_world_cam = np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3))
        bounds = np.searchsorted(hypotheses.frames, np.arange(frames + 1))
        previous: int | None = None
        for frame in np.unique(hypotheses.frames).tolist():
            mine = slice(bounds[frame], bounds[frame + 1])
            R, t, cost = hypotheses.R_world_cam[mine], hypotheses.t_world_cam[mine], totals[mine]
            if previous is not None:
                R, t = self._turned_to(hypotheses[mine], R_world_cam[previous])
                cost = cost + _PREVIOUS_WEIGHT * self._difference(R, t, R_world_cam[previous], t_world_cam[previous])
            best = int(np.argmin(np.round(cost, 6)))
            R_world_cam[frame], t_world_cam[frame] = R[best], t[best]
            previous = frame
        return R_world_cam, t_world_cam

    def _turned_to(self, hypotheses: _Hypotheses, R_world_cam: Array) -> tuple[Array, Array]:
        """Return the hypotheses' poses, the free ones turned about their object's axis to lie nearest."""
        R, t, free = hypotheses.R_world_cam, hypotheses.t_world_cam, np.flatnonzero(hypotheses.free)
        if not free.size:
            return R, t
        pairs = hypotheses.pairs[free]
        turned = self._fitting(pairs.detections, pairs.landmarks, np.broadcast_to(R_world_cam, (len(free), 3, 3)))
        R, t = R.copy(), t.copy()
        R[free], t[free] = self._votes(_Pairs(pairs.detections, pairs.landmarks, turned))
        return R, t


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _same_frame(frames_a: Indices, frames_b: Indices) -> tuple[Indices, Indices]:
    """Return every (i, j) with frames_a[i] == frames_b[j], i ascending."""
    order = np.argsort(frames_b, kind="stable")
    first, last = (np.searchsorted(frames_b[order], frames_a, side) for side in ("left", "right"))
    row = np.repeat(np.arange(len(frames_a)), last - first)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(last - first) - (last - first), last - first)
    return row, order[first[row] + rank]
