"""EuRoC (ASL) folders become logs: imu0, cam0 with its stamps, the extrinsics and the ground truth."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform

from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, Camera, ImuNoise
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.frames_csv import Frames
from poet_loc.io.imu_csv import read_imu
from poet_loc.io.input_text import read_text
from poet_loc.io.json_fields import number, numbers, required, rigid_matrix
from poet_loc.io.log_folder import Log, check_log, read_log_files, write_log
from poet_loc.io.number_table import read_number_csv, write_csv
from poet_loc.io.pose_columns import pose_cells
from poet_loc.io.whole_folder import whole_folder

_POSITION = ("p_RS_R_x", "p_RS_R_y", "p_RS_R_z")
_QUATERNION_WXYZ = ("q_RS_w", "q_RS_x", "q_RS_y", "q_RS_z")
_MODELS = {"radial-tangential": "radtan", "radtan": "radtan", "equidistant": "equidistant", "none": "none"}


@dataclass(frozen=True)
class ConvertEurocOptions:
    """What of a EuRoC folder becomes a log."""

    camera: str = "cam0"
    """Which camera: cam0 or cam1."""
    ground_truth: str = "state_groundtruth_estimate0"
    """Folder of the ground truth, where it is there; it holds the pose of the IMU (T_BS of the body is identity)."""
    like: Path | None = None
    """Folder whose other files (object poses, map) the new log takes over."""
    overwrite: bool = False
    """Replace an output folder that holds something."""


def convert_euroc(mav: str | Path, out: str | Path, options: ConvertEurocOptions | None = None) -> Log:
    """Write a log folder from a mav0 folder (or its parent); T_cam_imu is the inverse of EuRoC's T_BS.

    Raises InputError for a folder without imu0, and for whatever its files cannot mean.
    """
    options = options or ConvertEurocOptions()
    root = Path(mav) / "mav0" if (Path(mav) / "mav0").is_dir() else Path(mav)
    if not (root / "imu0" / "data.csv").exists():
        raise InputError("has no imu0/data.csv", path=root, fix="give the mav0 folder of a EuRoC sequence")
    like = Log(Path(out)) if options.like is None else read_log_files(options.like)
    calibration = _calibration(root, options.camera)
    log = replace(like, path=Path(out), imu=read_imu(root / "imu0" / "data.csv"), calibration=calibration)
    images = root / options.camera / "data.csv"
    if images.exists():
        log = replace(log, frames=_frames(images, Path(out)))
    truth = root / options.ground_truth / "data.csv"
    if truth.exists():
        T_world_imu = read_euroc_trajectory(truth)
        log = replace(log, T_world_imu=T_world_imu)
        if calibration.T_cam_imu is not None:
            log = replace(log, T_world_cam=T_world_imu.to_body(calibration.T_cam_imu.inv()))
    check_log(log)
    with whole_folder(out, options.overwrite, [p for p in (root, options.like) if p is not None]) as folder:
        write_log(folder, log)
    return log


def read_euroc_trajectory(path: str | Path) -> Trajectory:
    """Read EuRoC's ground truth, its quaternions scalar first; columns beyond the pose are passed over."""
    types = dict.fromkeys(("timestamp",), int) | dict.fromkeys((*_POSITION, *_QUATERNION_WXYZ), float)
    table = read_number_csv(path, types, further_columns=True, column_name=_without_unit)
    table.refuse_not_finite((*_POSITION, *_QUATERNION_WXYZ))
    table.refuse_disorder(table["timestamp"], "sort the rows by time")
    w, x, y, z = (table[name] for name in _QUATERNION_WXYZ)
    q_xyzw = np.column_stack([x, y, z, w])
    off = np.abs(np.linalg.norm(q_xyzw, axis=1) - 1.0) > 0.01
    table.refuse(off, "the quaternion has a norm other than 1", "write w, x, y, z of a unit quaternion")
    return Trajectory(table["timestamp"], pose_from_quaternion(table.stack(_POSITION), q_xyzw))


def write_euroc_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write poses as EuRoC's ground truth has them: nanoseconds, metres, quaternion scalar first."""
    x, y, z, *q_xyzw = pose_cells(trajectory.T_world_body)
    header = ["#timestamp [ns]", *(f"{name} [m]" for name in _POSITION), *(f"{name} []" for name in _QUATERNION_WXYZ)]
    write_csv(path, header, [trajectory.stamps_ns, x, y, z, q_xyzw[3], *q_xyzw[:3]])


def _without_unit(cell: str) -> str:
    return cell.lstrip("#").split("[")[0].strip()


def _frames(path: Path, out: Path) -> Frames:
    rows = [line.split(",") for line in read_text(path).splitlines()[1:] if line.strip()]
    try:
        stamps = np.array([int(row[0]) for row in rows], np.int64)
        folder = os.path.relpath(path.parent / "data", out)
        images = tuple(f"{folder}/{row[1].strip()}" for row in rows)
    except (ValueError, IndexError):
        raise InputError("is no list of images", path=path, fix="rows are: nanoseconds, file name") from None
    order = np.argsort(stamps, kind="stable")
    return Frames(stamps[order], np.arange(len(stamps), dtype=np.int64), tuple(images[row] for row in order))


def _calibration(root: Path, camera: str) -> Calibration:
    of_imu, of_camera = (root / name / "sensor.yaml" for name in ("imu0", camera))
    imu, cam = _sensor(of_imu), _sensor(of_camera)
    with _told(of_imu):
        T_body_imu, noise = _pose(imu), _noise(imu)
    with _told(of_camera):
        T_body_cam, pinhole = _pose(cam), _camera(cam)
    T_cam_imu = None if T_body_cam is None or T_body_imu is None else T_body_cam.inv() * T_body_imu
    return Calibration(T_cam_imu=T_cam_imu, camera=pinhole, imu=noise)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, LookupError) as error:
        raise InputError(str(error), path=path, fix="write it as EuRoC's sensor.yaml does") from None


def _noise(imu: Mapping[str, Any]) -> ImuNoise | None:
    names = [name for name in ImuNoise.__dataclass_fields__ if name != "update_rate"]
    if not all(name in imu for name in names):
        return None
    rate = number(imu.get("rate_hz", 200.0), "rate_hz")
    return ImuNoise(update_rate=rate, **{name: number(imu[name], name) for name in names})


def _sensor(path: Path) -> Mapping[str, Any]:
    if not path.exists():
        return {}
    try:
        content = yaml.safe_load(read_text(path).replace("%YAML:1.0", ""))
    except yaml.YAMLError as error:
        raise InputError("is no YAML", path=path, fix="correct the file") from error
    return content if isinstance(content, Mapping) else {}


def _pose(sensor: Mapping[str, Any]) -> RigidTransform | None:
    """Return T_BS: the sensor in the body."""
    if "T_BS" not in sensor:
        return None
    matrix = sensor["T_BS"]
    data = matrix["data"] if isinstance(matrix, Mapping) else matrix
    return rigid_matrix(np.reshape(data, (4, 4)).tolist(), "T_BS")


def _camera(sensor: Mapping[str, Any]) -> Camera | None:
    if "intrinsics" not in sensor:
        return None
    fx, fy, cx, cy = numbers(required(sensor, "intrinsics"), "intrinsics", (4,)).tolist()
    model = _MODELS.get(str(sensor.get("distortion_model", "none")), "none")
    written = sensor.get("distortion_coefficients") or ()
    coefficients = tuple(number(value, "distortion_coefficients") for value in written)
    size = sensor.get("resolution")
    resolution = (int(size[0]), int(size[1])) if size else None
    return Camera((fx, fy, cx, cy), model, () if model == "none" else coefficients, resolution)
