"""The stage localize: a log's object poses and landmark map become camera poses."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from landmarks.camera_pose import CameraPoseEstimates, SolverOptions, solve
from landmarks.landmark_map import landmark_names
from poet_loc.core.input_error import InputError
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log


@dataclass(frozen=True)
class LocalizeOptions(SolverOptions):
    """Which detections are localised, and how."""

    detections: str | None = None
    """NAME of object_poses_NAME.csv; without it object_poses.csv, or the only one there is."""


@dataclass(frozen=True)
class LocalizeResult:
    """Camera poses of one log by one mode."""

    name: str
    """localize/<mode>"""
    detections: str
    """Name of the set of detections, "" for object_poses.csv."""
    object_poses: ObjectPoses
    landmark_map: LandmarkMap
    estimates: CameraPoseEstimates
    runtime_s: float
    """Time that solving took, without reading files."""

    @property
    def trajectory(self) -> Trajectory:
        """T_world_cam of the solved frames."""
        poses = self.estimates.camera_poses
        return Trajectory(poses.stamps_ns, poses.T_world_cam)

    @property
    def voter_columns(self) -> dict[str, list[str]]:
        """Further columns of camera_poses.csv: who voted and who was refused."""
        return voter_columns(self.estimates, self.object_poses, self.landmark_map)


def localize(log: Log, options: LocalizeOptions | None = None) -> LocalizeResult:
    """Return the camera poses of a log's detections.

    Raises InputError where the log lacks detections or the map, for an unknown mode, and where the oracle `best`
    finds no ground truth.
    """
    options = options or LocalizeOptions()
    name, object_poses = log.detections(options.detections)
    if log.landmark_map is None:
        raise InputError("has no landmarks.json", path=log.path, fix="add the map of the objects that were detected")
    start = time.perf_counter()
    estimates = solve(object_poses, log.landmark_map, options, log.T_world_cam)
    runtime_s = time.perf_counter() - start
    return LocalizeResult(f"localize/{options.mode}", name, object_poses, log.landmark_map, estimates, runtime_s)


def voter_columns(
    estimates: CameraPoseEstimates, object_poses: ObjectPoses, landmark_map: LandmarkMap
) -> dict[str, list[str]]:
    """Return per estimate the landmarks that voted and those refused, as "2:0 3:0" (object_id:instance).

    A detection that is no landmark stands among the refused under its own name. Where nobody voted, the pose is held.
    """
    detections = np.flatnonzero(estimates.frame_of_detection >= 0)
    names = [landmark.key for landmark in landmark_map]
    voters: list[list[tuple[int, int]]] = [[] for _ in range(len(estimates.camera_poses))]
    refused: list[list[tuple[int, int]]] = [[] for _ in range(len(estimates.camera_poses))]
    for detection in detections.tolist():
        landmark = int(estimates.landmark_of_detection[detection])
        own = int(object_poses.object_ids[detection]), int(object_poses.instances[detection])
        side = voters if estimates.voted[detection] else refused
        side[int(estimates.frame_of_detection[detection])].append(names[landmark] if landmark >= 0 else own)
    return {
        "voters": [landmark_names(sorted(row)) for row in voters],
        "refused": [landmark_names(sorted(row)) for row in refused],
    }
