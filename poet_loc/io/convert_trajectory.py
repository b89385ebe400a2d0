"""Trajectories of other programs become camera poses or ground truth of a log: KITTI, and TUM with covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from poet_loc.core.records import CameraPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.kitti import read_kitti
from poet_loc.io.log_folder import Log, check_log, read_log_files, write_log
from poet_loc.io.tum import read_tum_with_covariances
from poet_loc.io.whole_folder import whole_folder

Role = Literal["camera_poses", "T_world_cam", "T_world_imu", "T_odom_cam"]


@dataclass(frozen=True)
class ConvertTrajectoryOptions:
    """What a trajectory becomes in the log."""

    role: Role = "camera_poses"
    """camera_poses.csv to be fused; T_world_cam, T_world_imu: ground truth; T_odom_cam: odometry."""
    inverse: bool = False
    """The file's poses are T_body_world."""
    like: Path | None = None
    """Folder whose other files the new log takes over."""
    overwrite: bool = False
    """Replace an output folder that holds something."""


def convert_kitti(
    poses: str | Path, times: str | Path, out: str | Path, options: ConvertTrajectoryOptions | None = None
) -> Log:
    """Write a log folder from KITTI poses and their stamps."""
    return _written(read_kitti(poses, times), None, out, options or ConvertTrajectoryOptions(), (poses, times))


def convert_openvins(trajectory: str | Path, out: str | Path, options: ConvertTrajectoryOptions | None = None) -> Log:
    """Write a log folder from a trajectory with covariance columns as OpenVINS and RPG's tools write them.

    OpenVINS writes the IMU's pose: as camera poses it needs a file of the camera, or --role T_world_imu.
    """
    options = options or ConvertTrajectoryOptions()
    read, covariances = read_tum_with_covariances(trajectory)
    return _written(read, covariances, out, options, (trajectory,))


def _written(
    trajectory: Trajectory,
    covariances: np.ndarray | None,
    out: str | Path,
    options: ConvertTrajectoryOptions,
    files: tuple[str | Path, ...],
) -> Log:
    if options.inverse:
        trajectory = Trajectory(trajectory.stamps_ns, trajectory.T_world_body.inv())
        covariances = None  # of the other pose's errors
    like = Log(Path(out)) if options.like is None else read_log_files(options.like)
    log = replace(like, path=Path(out))
    if options.role == "camera_poses":
        frames = np.arange(len(trajectory), dtype=np.int64)
        poses = CameraPoses(trajectory.stamps_ns, frames, trajectory.T_world_body, covariances)
        log = replace(log, camera_poses=poses)
    else:
        log = replace(log, **{options.role: trajectory})  # type: ignore[arg-type]
    check_log(log)
    inputs = [path for path in (*files, options.like) if path is not None]
    with whole_folder(out, options.overwrite, inputs) as folder:
        write_log(folder, log)
    return log
