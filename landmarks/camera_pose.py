"""The landmark solver: relative object poses and a map become one camera pose per frame, in five modes.

Per landmark the vote is T_world_cam = T_world_obj * inv(T_cam_obj). How votes become a pose is the mode; see
`landmarks.options` for the modes and every default.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from landmarks.association import associate
from landmarks.consensus import (
    agreement,
    average,
    first_of_frame,
    largest_sets,
    nearest_to_previous,
    sorted_by_tie_rule,
)
from landmarks.evidence import choose_by_evidence
from landmarks.landmark_map import map_arrays
from landmarks.options import MODES, ORACLES, Memory, Mode, SolverOptions, VoteNoise
from landmarks.votes import Votes, cast_votes, detection_covariances, vote_covariances
from landmarks.weighted_consensus import ACCEPTED_WEIGHT, weighted_consensus
from poet_loc.core.consistency import chi_square_quantile
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import CameraPoses, LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory

__all__ = ["MODES", "ORACLES", "CameraPoseEstimates", "Memory", "Mode", "SolverOptions", "VoteNoise", "solve"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CameraPoseEstimates:
    """F camera poses from N detections, and who voted for them."""

    camera_poses: CameraPoses
    """One row per frame that was solved."""
    voted: Mask
    """(N,) the detection took part in its frame's estimate; False: refused, or not of the map."""
    frame_of_detection: Indices
    """(N,) row of the estimate, -1: the frame was not solved."""
    landmark_of_detection: Indices
    """(N,) index into the map, -1: none."""
    held: Mask
    """(F,) robust: no vote of the frame was believed, the pose is an earlier one with a covariance grown since.
    Such a row brings no new information: a filter leaves it out."""


@dataclass(frozen=True)
class _Solution:
    """What a mode makes of the votes, F rows; solved is False where it has nothing to say."""

    R_world_cam: Array
    t_world_cam: Array
    covariances: Array
    members: Mask
    """(F, K)"""
    held: Mask
    solved: Mask


@dataclass(frozen=True)
class _Task:
    votes: Votes
    covariances: Array
    """(F, K, 6, 6) of the detections."""
    options: SolverOptions
    reference: Trajectory | None


def solve(
    object_poses: ObjectPoses,
    landmark_map: LandmarkMap,
    options: SolverOptions | None = None,
    reference: Trajectory | None = None,
) -> CameraPoseEstimates:
    """Return a camera pose for every frame that has a detection of a landmark.

    reference is the ground truth T_world_cam: only `best` looks at it, and solves the frames inside its span.
    Raises InputError for `best` without a reference.
    """
    options = options or SolverOptions()
    if options.mode in ORACLES and reference is None:
        what = f"mode {options.mode} is an oracle and needs the ground truth"
        raise InputError(what, fix="put T_world_cam.tum into the log or choose another mode")
    arrays = map_arrays(landmark_map)
    association = associate(object_poses, arrays, options)
    votes = cast_votes(object_poses, arrays, association)
    task = _Task(votes, detection_covariances(votes, object_poses, arrays, options.noise), options, reference)
    solution = _MODES[options.mode](task) if len(votes) else _nothing(votes)
    return _estimates(object_poses, votes, solution, association.landmarks)


def _estimates(object_poses: ObjectPoses, votes: Votes, solution: _Solution, landmarks: Indices) -> CameraPoseEstimates:
    solved = np.flatnonzero(solution.solved)
    row = np.full(len(votes) + 1, -1, np.intp)
    row[solved] = np.arange(len(solved))
    frame = np.searchsorted(votes.stamps_ns, object_poses.stamps_ns)
    there = np.isin(object_poses.stamps_ns, votes.stamps_ns)
    members = solution.members & solution.solved[:, None]
    voted = np.zeros(len(object_poses), bool)
    voted[votes.detections[members]] = True
    rotation = Rotation.from_matrix(solution.R_world_cam[solved])
    return CameraPoseEstimates(
        camera_poses=CameraPoses(
            stamps_ns=votes.stamps_ns[solved],
            frames=votes.frames[solved],
            T_world_cam=make_pose(rotation, solution.t_world_cam[solved]),
            covariances=solution.covariances[solved],
        ),
        voted=voted,
        frame_of_detection=row[np.where(there, frame, len(votes))],
        landmark_of_detection=landmarks,
        held=solution.held[solved],
    )


def _nothing(votes: Votes) -> _Solution:
    none = np.empty(0, bool)
    return _Solution(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 6, 6)), votes.valid, none, none)


def _averaged(task: _Task, members: Mask, solved: Mask | None = None) -> _Solution:
    """Return the means of the members, with the covariance of a weighted mean of independent votes."""
    rotations, positions, weights = average(task.votes, members, task.options)
    spread = vote_covariances(task.votes, task.covariances)
    covariances = np.einsum("fk,fkij->fij", weights**2, spread)
    frames = len(task.votes)
    everywhere = np.ones(frames, bool)
    held = np.zeros(frames, bool)
    return _Solution(rotations, positions, covariances, members, held, everywhere if solved is None else solved)


def _solve_all(task: _Task) -> _Solution:
    return _averaged(task, task.votes.valid)


def _solve_out(task: _Task) -> _Solution:
    frame, members = _largest_sets_of(task)
    return _averaged(task, members[first_of_frame(frame)])


def _solve_prev(task: _Task) -> _Solution:
    frame, members = _largest_sets_of(task)
    rotations, positions, _ = average(task.votes[frame], members, task.options)
    chosen = nearest_to_previous(frame, first_of_frame(frame), rotations, positions, task.options)
    return _averaged(task, members[chosen])


def _largest_sets_of(task: _Task) -> tuple[Indices, Mask]:
    """Return the largest sets of agreeing votes, those of a frame in the order of the tie rule."""
    agree = agreement(task.votes, task.options.distance, np.radians(task.options.angle_deg))
    frame, members = largest_sets(agree)
    order = sorted_by_tie_rule(task.votes, frame, members, task.options)
    return frame, members[order]


def _solve_best(task: _Task) -> _Solution:
    assert task.reference is not None
    truth, known = task.reference.interpolate(task.votes.stamps_ns)
    apart = np.linalg.norm(task.votes.t_world_cam - truth.translation[:, None], axis=-1)
    nearest = np.argmin(np.where(task.votes.valid, apart, np.inf), axis=1)
    members = (np.arange(task.votes.valid.shape[1]) == nearest[:, None]) & known[:, None]
    return _averaged(task, members, solved=known)


def _solve_robust(task: _Task) -> _Solution:
    gate = float(chi_square_quantile(task.options.gate_probability, 6))
    hypotheses = weighted_consensus(task.votes, task.covariances, gate)
    chosen, age_s = choose_by_evidence(task.votes.stamps_ns, hypotheses, task.options.memory)
    believed, held = hypotheses[chosen], age_s > 0.0
    memory = task.options.memory
    grown = np.repeat([np.radians(memory.turn_rate_deg), memory.speed], 3) ** 2
    return _Solution(
        R_world_cam=believed.R_world_cam,
        t_world_cam=believed.t_world_cam,
        covariances=believed.covariances + (age_s**2)[:, None, None] * np.diag(grown),
        members=(believed.weights > ACCEPTED_WEIGHT) & ~held[:, None],
        held=held,
        solved=np.ones(len(task.votes), bool),
    )


_MODES: dict[Mode, Callable[[_Task], _Solution]] = {
    "all": _solve_all,
    "out": _solve_out,
    "prev": _solve_prev,
    "best": _solve_best,
    "robust": _solve_robust,
}
