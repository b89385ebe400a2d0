"""The largest sets of votes that agree with each other, and their averages: the modes all, out, prev and best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from landmarks.options import SolverOptions
from landmarks.votes import Votes
from poet_loc.core.geometry import chordal_mean

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

_KARCHER_STEPS = 10


def agreement(votes: Votes, distance: float, angle: float) -> Mask:
    """Return (F, K, K): both votes are there and lie within a distance (m) and an angle (rad) of each other."""
    apart = np.linalg.norm(votes.t_world_cam[:, :, None] - votes.t_world_cam[:, None], axis=-1)
    trace = np.einsum("faij,fbij->fab", votes.R_world_cam, votes.R_world_cam)
    near = (apart <= distance) & (rotation_angle(trace) <= angle)
    near |= np.eye(near.shape[-1], dtype=bool)  # whatever rounding makes of the angle from a vote to itself
    return near & votes.valid[:, :, None] & votes.valid[:, None]


def rotation_angle(trace: Array) -> Array:
    """Return the angle (rad) of rotations with these traces."""
    return np.asarray(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def largest_sets(agree: Mask) -> tuple[Indices, Mask]:
    """Return every largest set of mutually agreeing votes: frame (M,) ascending and members (M, K).

    The maximum cliques of each frame, found once per pattern of agreement; in a frame, sets stand in the order of
    their members.
    """
    frames, places = agree.shape[:2]
    if frames == 0 or places == 0:
        return np.empty(0, np.intp), np.empty((0, places), bool)
    packed = np.packbits(agree.reshape(frames, -1), axis=1)
    _, example, pattern = np.unique(packed, axis=0, return_index=True, return_inverse=True)
    found = [_maximum_cliques(agree[index]) for index in example]
    count = np.array([len(sets) for sets in found])
    start = np.cumsum(count) - count
    pattern = pattern.reshape(-1)
    frame = np.repeat(np.arange(frames), count[pattern])
    first = np.repeat(np.cumsum(count[pattern]) - count[pattern], count[pattern])
    return frame, np.concatenate(found)[start[pattern][frame] + np.arange(len(frame)) - first]


def _maximum_cliques(agree: Mask) -> Mask:
    """Return the maximum cliques of one graph, (C, K).

    Source: C. Bron, J. Kerbosch, "Algorithm 457", Communications of the ACM 16 (1973), with pivots.
    """
    nodes = np.flatnonzero(np.diagonal(agree)).tolist()
    neighbours = {v: sum(1 << u for u in np.flatnonzero(agree[v]).tolist() if u != v) for v in nodes}
    best: list[int] = []

    def extend(clique: int, candidates: int, excluded: int) -> None:
        nonlocal best
        if best and (clique | candidates).bit_count() < best[0].bit_count():
            return
        if not candidates:
            if not excluded:
                best = [*best, clique] if best and best[0].bit_count() == clique.bit_count() else [clique]
            return
        pivot = max(_bits(candidates | excluded), key=lambda v: (neighbours[v] & candidates).bit_count())
        for v in _bits(candidates & ~neighbours[pivot]):
            extend(clique | 1 << v, candidates & neighbours[v], excluded & neighbours[v])
            candidates &= ~(1 << v)
            excluded |= 1 << v

    if nodes:
        extend(0, sum(1 << v for v in nodes), 0)
    places = range(agree.shape[0])
    members = sorted(([bool(clique >> v & 1) for v in places] for clique in best), reverse=True)
    return np.array(members, dtype=bool).reshape(-1, agree.shape[0])


def _bits(mask: int) -> list[int]:
    return [v for v in range(mask.bit_length()) if mask >> v & 1]


def average(votes: Votes, members: Mask, options: SolverOptions) -> tuple[Array, Array, Array]:
    """Return the mean of the members, rotations (F, 3, 3) and positions (F, 3) in m, and the weights (F, K) used."""
    weights = members.astype(float)
    if options.vote_weights == "score":
        positive = np.where(members, np.maximum(votes.scores, 0.0), 0.0)
        weights = np.where(positive.sum(axis=1, keepdims=True) > 0.0, positive, weights)
    weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    rotations = chordal_mean(votes.R_world_cam, weights)
    if options.rotation_average == "geodesic":
        rotations = _karcher_mean(votes.R_world_cam, weights, rotations)
    if options.position_average == "median":
        inside = np.where(members[..., None], votes.t_world_cam, np.nan)
        return rotations, np.nanmedian(inside, axis=1), weights
    return rotations, np.einsum("fk,fki->fi", weights, votes.t_world_cam), weights


def _karcher_mean(rotations: Array, weights: Array, start: Array) -> Array:
    """Return the geodesic mean, by gradient steps from the chordal one (Hartley et al., IJCV 103 (2013), alg. 1)."""
    mean = start
    for _ in range(_KARCHER_STEPS):
        relative = np.swapaxes(mean, -1, -2)[:, None] @ rotations
        steps = Rotation.from_matrix(relative.reshape(-1, 3, 3)).as_rotvec().reshape(*weights.shape, 3)
        mean = mean @ Rotation.from_rotvec(np.einsum("fk,fki->fi", weights, steps)).as_matrix()
    return mean


def first_of_frame(frame: Indices) -> Indices:
    """Return where each frame begins in an ascending column."""
    return np.flatnonzero(np.diff(frame, prepend=-1) > 0)


def sorted_by_tie_rule(votes: Votes, frame: Indices, members: Mask, options: SolverOptions) -> Indices:
    """Return the order of equally large sets that puts each frame's winner first."""
    rank = np.arange(len(frame))  # sets of a frame stand in the order of the map
    if options.tie_rule == "order":
        return rank
    near = np.sum(np.where(members, np.linalg.norm(votes.t_cam_obj[frame], axis=-1), 0.0), axis=1) / members.sum(axis=1)
    if options.tie_rule == "score":
        key = -np.sum(np.where(members, votes.scores[frame], 0.0), axis=1)
    else:
        key = _spread(votes[frame], members, options) if options.tie_rule == "compact" else near
    return np.lexsort((rank, np.round(near, 9), np.round(key, 9), frame))


def _spread(votes: Votes, members: Mask, options: SolverOptions) -> Array:
    """Return the mean square distance from the average, in thresholds."""
    rotations, positions, _ = average(votes, members, options)
    apart = np.linalg.norm(votes.t_world_cam - positions[:, None], axis=-1) / options.distance
    trace = np.einsum("fkij,fij->fk", votes.R_world_cam, rotations)
    turned = rotation_angle(trace) / np.radians(options.angle_deg)
    return np.asarray(np.sum(np.where(members, apart**2 + turned**2, 0.0), axis=1) / members.sum(axis=1))


def nearest_to_previous(
    frame: Indices, first: Indices, rotations: Array, positions: Array, options: SolverOptions
) -> Indices:
    """Return the chosen set of each frame: where several tie, the one whose average lies nearest the frame before.

    rotations and positions are the averages of the sets; nearness counts distance and angle in thresholds.
    """
    chosen = first.copy()
    last = np.append(first[1:], len(frame))
    for index in np.flatnonzero(last - first > 1):
        if index == 0:
            continue
        mine, previous = slice(first[index], last[index]), chosen[index - 1]
        apart = np.linalg.norm(positions[mine] - positions[previous], axis=-1) / options.distance
        trace = np.einsum("cij,ij->c", rotations[mine], rotations[previous])
        difference = np.round(apart + rotation_angle(trace) / np.radians(options.angle_deg), 9)
        chosen[index] += int(np.argmin(difference))
    return chosen
