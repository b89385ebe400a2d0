"""A TUM trajectory of a camera, from a SLAM system or a tracker, becomes a log whose camera poses it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import CameraPoses
from poet_loc.io.log_folder import Log, check_log, read_log_files, write_log
from poet_loc.io.tum import read_tum
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class ConvertTumOptions:
    """How a trajectory becomes a log."""

    holds: Literal["T_world_cam", "T_cam_world"] = "T_world_cam"
    """What the file's poses are; T_cam_world is inverted."""
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    """The order of the file's quaternions; TUM's own is xyzw."""
    position_sigma_m: float | None = None
    """Standard deviation of each position axis, m; none: the log has no covariances."""
    attitude_sigma_deg: float | None = None
    """Standard deviation of each attitude axis, degrees; given with the position's."""
    like: Path | None = None
    """Folder whose landmarks, IMU, calibration, ground truth and detections the new log takes over."""
    overwrite: bool = False
    """Replace an output folder that holds something."""


def convert_tum(trajectory: str | Path, out: str | Path, options: ConvertTumOptions | None = None) -> Log:
    """Write a log folder whose camera_poses.csv is a TUM trajectory of the camera in the map's world; return it.

    Raises InputError for what `read_tum` refuses and for records that do not belong together.
    """
    options = options or ConvertTumOptions()
    read = read_tum(trajectory)
    poses = read.T_world_body
    if options.quaternion == "wxyz":
        poses = _from_wxyz(poses)
    if options.holds == "T_cam_world":
        poses = poses.inv()
    camera_poses = CameraPoses(read.stamps_ns, np.arange(len(read)), poses, _covariances(options, len(read)))
    like = Log(Path(out)) if options.like is None else read_log_files(options.like)
    log = replace(like, path=Path(out), camera_poses=camera_poses)
    check_log(log)
    inputs = [path for path in (trajectory, options.like) if path is not None]
    with whole_folder(out, options.overwrite, inputs) as folder:
        write_log(folder, log)
    return log


def _from_wxyz(T: RigidTransform) -> RigidTransform:
    """Return the poses whose quaternions were read scalar last and are scalar first."""
    w_x_y_z = T.rotation.as_quat()
    return make_pose(Rotation.from_quat(w_x_y_z[..., [1, 2, 3, 0]]), T.translation)


def _covariances(options: ConvertTumOptions, count: int) -> NDArray[np.float64] | None:
    position, attitude = options.position_sigma_m, options.attitude_sigma_deg
    if position is None and attitude is None:
        return None
    if position is None or attitude is None or not (0 < position < math.inf and 0 < attitude < math.inf):
        fix = "give --position-sigma-m and --attitude-sigma-deg together, both above zero"
        raise InputError("the sigmas of the camera poses are incomplete", fix=fix)
    sigmas = np.repeat([np.deg2rad(attitude), position], 3)
    return np.tile(np.diag(sigmas**2), (count, 1, 1))
