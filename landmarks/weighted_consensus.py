"""Camera poses that weigh all votes of a frame by their covariances, from every consensus that the frame offers.

Minimised over T_world_cam: sum over detections of rho(e^T S^-1 e) with e = [Log(R_measured R_predicted^T),
t_measured - t_predicted] in camera axes, S the detection's covariance, and rho of Geman and McClure with its scale at
the gate. The detection's own frame keeps position and rotation apart, so the lever arm from the object to the camera
needs no approximation.
Sources: S. Geman, D. McClure, "Statistical methods for tomographic image reconstruction", Bull. ISI 52 (1987);
iteratively reweighted Gauss-Newton as in Z. Zhang, "Parameter estimation techniques", IVC 15 (1997), section 9.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from landmarks.votes import Votes
from poet_loc.core.consistency import chi_square_quantile
from poet_loc.core.geometry import skew, so3_right_jacobian_inverse

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

ACCEPTED_WEIGHT = 0.25
"""The weight at the gate: a detection that weighs less is refused."""

_WIDER_START = 4.0  # the first step's gate, in gates
_LEAST_SUPPORT = 1.0 / 3.0  # of the frame's best consensus
_MAX_STEPS = 30
_LONGEST_STEP = 0.5  # rad and m: a pose that some direction leaves nearly free does not fly off
_CONVERGED = 1e-6  # rad and m
_SAME_POSE = 1e-5
_ROWS_AT_ONCE = 16384


@dataclass(frozen=True)
class Hypotheses:
    """M camera poses, those of a frame next to each other, frames ascending."""

    frame: Indices
    """(M,)"""
    R_world_cam: Array
    t_world_cam: Array
    weights: Array
    """(M, K) of each vote, 1 where it fits perfectly, ACCEPTED_WEIGHT at the gate."""
    covariances: Array
    """(M, 6, 6) of [e_r, e_t] with R = R_true Exp(e_r), t = t_true + e_t."""

    def __getitem__(self, index: Indices) -> Hypotheses:
        return Hypotheses(*(getattr(self, each.name)[index] for each in fields(self)))


def weighted_consensus(votes: Votes, covariances: Array, gate: float) -> Hypotheses:
    """Return one refined pose per consensus: the distinct sets of detections within the gate of one of the votes.

    covariances (F, K, 6, 6) of the detections; gate is a bound on the squared Mahalanobis distance (6 degrees).
    """
    information = np.where(votes.valid[..., None, None], np.linalg.inv(covariances), 0.0)
    per_chunk = max(1, _ROWS_AT_ONCE // max(votes.valid.shape[1] ** 2, 1))
    parts = []
    for first in range(0, max(len(votes), 1), per_chunk):
        chunk = slice(first, first + per_chunk)
        frame, place = _starts(votes[chunk], information[chunk], gate)
        parts.append(_refined(votes[chunk], information[chunk], frame, place, gate, first))
    return Hypotheses(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Hypotheses)))


def residuals(votes: Votes, R_world_cam: Array, t_world_cam: Array) -> tuple[Array, Array]:
    """Return [e_r, e_t] (M, K, 6) of the votes' rows at camera poses (M, 3, 3), (M, 3), and t_predicted (M, K, 3)."""
    R_cam_world = np.swapaxes(R_world_cam, -1, -2)[:, None]
    turned = votes.R_cam_obj @ np.swapaxes(R_cam_world @ votes.R_world_obj, -1, -2)
    t_predicted = np.einsum("mij,mki->mkj", R_world_cam, votes.t_world_obj - t_world_cam[:, None])
    return np.concatenate([_rotation_vector(turned), votes.t_cam_obj - t_predicted], axis=-1), t_predicted


def _rotation_vector(rotations: Array) -> Array:
    """Return Log of matrices (..., 3, 3); at a half turn, where every vote is refused, only its length is right."""
    axis = 0.5 * np.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        axis=-1,
    )
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, (np.trace(rotations, axis1=-2, axis2=-1) - 1.0) / 2.0)
    small = sine < 1e-9
    scaled = axis * np.where(small, 1.0, angle / np.where(small, 1.0, sine))[..., None]
    scaled[small & (angle > 1.0)] = [np.pi, 0.0, 0.0]
    return scaled


def _starts(votes: Votes, information: Array, gate: float) -> tuple[Indices, Indices]:
    """Return frame and place of one vote per distinct consensus: the one with the least total loss.

    A consensus that explains less than a third of what the frame's best one explains is not pursued.
    """
    frame, place = np.nonzero(votes.valid)
    square = _squares(
        votes[frame], information[frame], votes.R_world_cam[frame, place], votes.t_world_cam[frame, place]
    )
    consensus = np.packbits((square < gate) & votes.valid[frame], axis=1)
    loss = np.sum(square / (gate + square), axis=1)
    support = votes.valid[frame].sum(axis=1) - loss
    best = np.zeros(len(votes))
    np.maximum.at(best, frame, support)
    order = np.lexsort((place, np.round(loss, 9), *consensus.T[::-1], frame))
    key = np.column_stack([frame, consensus])[order]
    new = np.any(np.diff(key, axis=0, prepend=-1) != 0, axis=1)
    chosen = np.sort(order[new & (support[order] >= _LEAST_SUPPORT * best[frame[order]])])
    return frame[chosen], place[chosen]


def _squares(votes: Votes, information: Array, R_world_cam: Array, t_world_cam: Array) -> Array:
    """Return (M, K) squared Mahalanobis distances, 0 where there is no vote."""
    errors, _ = residuals(votes, R_world_cam, t_world_cam)
    return np.asarray(np.sum(np.einsum("mki,mkij->mkj", errors, information) * errors, axis=-1))


def _loss(votes: Votes, information: Array, R_world_cam: Array, t_world_cam: Array, gate: float) -> Array:
    square = _squares(votes, information, R_world_cam, t_world_cam)
    return np.asarray(np.sum(square / (gate + square), axis=1))


def _refined(
    votes: Votes, information: Array, frame: Indices, place: Indices, gate: float, first_frame: int
) -> Hypotheses:
    R, t = votes.R_world_cam[frame, place].copy(), votes.t_world_cam[frame, place].copy()
    before = _loss(votes[frame], information[frame], R, t, gate)
    active = np.arange(len(frame))
    for step in range(_MAX_STEPS):
        if not active.size:
            break
        scale = gate * (_WIDER_START if step == 0 else 1.0)
        rows, inverse = votes[frame[active]], information[frame[active]]
        equations = _normal_equations(rows, inverse, R[active], t[active], scale)
        change = -np.linalg.solve(equations.normal, equations.gradient[..., None])[..., 0]
        change *= np.minimum(1.0, _LONGEST_STEP / np.maximum(np.abs(change).max(axis=1), 1e-12))[:, None]
        t[active] += np.einsum("mij,mj->mi", R[active], change[:, 3:])
        R[active] = R[active] @ Rotation.from_rotvec(change[:, :3]).as_matrix()
        moving = np.abs(change).max(axis=1) > _CONVERGED
        active = active[moving | (step == 0)]
    worse = np.flatnonzero(_loss(votes[frame], information[frame], R, t, gate) > before)
    R[worse], t[worse] = votes.R_world_cam[frame, place][worse], votes.t_world_cam[frame, place][worse]
    equations = _normal_equations(votes[frame], information[frame], R, t, gate)
    covariances = _covariances(equations, R)
    return Hypotheses(frame + first_frame, R, t, equations.weights, covariances)[_first_of_each_pose(frame, R, t)]


def _covariances(equations: _NormalEquations, R_world_cam: Array) -> Array:
    """Return (M, 6, 6) of [e_r, e_t] in the record's axes: the covariance of a weighted mean of independent votes.

    Votes that disagree more than their covariances allow nine times in ten are worth less, in proportion
    (after R. Birge, Phys. Rev. 40 (1932)).
    """
    weights, inside = equations.weights, equations.weights > ACCEPTED_WEIGHT
    freedom = 6.0 * np.maximum(inside.sum(axis=1) - 1, 1)
    disagreement = np.sum(np.where(inside, equations.square, 0.0), axis=1)
    excess = np.maximum(1.0, disagreement / chi_square_quantile(0.9, freedom))
    of_mean = np.sum(weights[..., None, None] ** 2 * equations.information, axis=1)
    inverse = np.linalg.inv(equations.normal)
    to_world = np.zeros_like(inverse)
    to_world[:, :3, :3], to_world[:, 3:, 3:] = np.eye(3), R_world_cam
    factor = to_world @ inverse
    covariances = excess[:, None, None] * (factor @ of_mean @ np.swapaxes(factor, -1, -2))
    return (covariances + np.swapaxes(covariances, -1, -2)) / 2.0


def _first_of_each_pose(frame: Indices, R: Array, t: Array) -> Indices:
    """Return the rows without those that ended where an earlier start of their frame did."""
    repeated = np.zeros(len(frame), bool)
    for lag in range(1, int(np.bincount(frame).max(initial=0))):
        same = frame[lag:] == frame[:-lag]
        same &= np.abs(t[lag:] - t[:-lag]).max(axis=1) < _SAME_POSE
        repeated[lag:] |= same & (np.abs(R[lag:] - R[:-lag]).max(axis=(1, 2)) < _SAME_POSE)
    return np.flatnonzero(~repeated)


@dataclass(frozen=True)
class _NormalEquations:
    normal: Array
    """(M, 6, 6) J^T W J of all votes, in camera axes."""
    gradient: Array
    """(M, 6) J^T W e"""
    information: Array
    """(M, K, 6, 6) J^T S^-1 J of each vote, without its weight."""
    weights: Array
    """(M, K)"""
    square: Array
    """(M, K) e^T S^-1 e"""


def _normal_equations(votes: Votes, information: Array, R: Array, t: Array, gate: float) -> _NormalEquations:
    """Return the equations of one step, with T_world_cam changed to R Exp(a), t + R b.

    e_r then becomes e_r + J_r^-1(e_r) a and e_t becomes e_t - t_predicted x a + b, to first order.
    """
    errors, t_predicted = residuals(votes, R, t)
    weighted_errors = np.einsum("mkij,mkj->mki", information, errors)
    square = np.sum(weighted_errors * errors, axis=-1)
    weights = np.where(votes.valid, (gate / (gate + square)) ** 2, 0.0)
    jacobian = np.zeros((*weights.shape, 6, 6))
    jacobian[..., :3, :3] = so3_right_jacobian_inverse(errors[..., :3])
    jacobian[..., 3:, 3:] = np.eye(3)
    jacobian[..., 3:, :3] = -skew(t_predicted)
    transposed = np.swapaxes(jacobian, -1, -2)
    per_vote = transposed @ information @ jacobian
    gradient = np.sum(weights[..., None] * (transposed @ weighted_errors[..., None])[..., 0], axis=1)
    normal = np.sum(weights[..., None, None] * per_vote, axis=1)
    return _NormalEquations(normal, gradient, per_vote, weights, square)
