"""A log folder as far as it can be read: strictly where that works, else row by row with all that is wrong."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from poet_loc.check.finding import Evidence, Finding
from poet_loc.check.rows import Mask, Rows, in_order, read_csv_rows, read_plain_rows, with_unit_quaternions, without_nan
from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, CameraPoses, ImuSamples, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.calibration_yaml import read_calibration
from poet_loc.io.camera_poses_csv import read_camera_poses
from poet_loc.io.frames_csv import read_frames
from poet_loc.io.imu_csv import read_imu
from poet_loc.io.input_text import read_text
from poet_loc.io.landmarks_json import read_landmarks
from poet_loc.io.log_folder import Log, object_pose_files
from poet_loc.io.object_poses_csv import read_object_poses
from poet_loc.io.pose_columns import COVARIANCE_COLUMNS, POSE_COLUMNS, not_positive_definite
from poet_loc.io.tum import read_tum

Record = TypeVar("Record")

_MILLIMETRES_M = 50.0
_UPPER = np.triu_indices(6)
_UNIT_SCALES = {"deg s^-1": np.pi / 180, "deg/s": np.pi / 180, "mg": 9.80665e-3, "g": 9.80665, "rad/s": 1.0}
_UNIT_SCALES |= {"m/s^2": 1.0, "rad s^-1": 1.0, "m s^-2": 1.0, "ns": 1.0}


def read_what_there_is(path: Path) -> tuple[Log, list[Finding]]:
    """Return what can be read of a log folder, and what is wrong with its files.

    Raises InputError where the path is no folder.
    """
    found: list[Finding] = []

    def read(
        file: Path, strictly: Callable[[Path], Record], tolerantly: Callable[[Path], tuple[Record, list[Finding]]]
    ) -> Record | None:
        if not file.exists():
            return None
        try:
            return strictly(file)
        except InputError as error:
            try:
                record, problems = tolerantly(file)
            except InputError:
                record, problems = None, []
            found.extend(problems or [_unreadable(file, error, repaired=record is not None)])
            return record

    detections = {name: read(file, read_object_poses, _object_poses) for name, file in object_pose_files(path).items()}
    log = Log(
        path=path,
        object_poses={name: poses for name, poses in detections.items() if poses is not None},
        landmark_map=read(path / "landmarks.json", read_landmarks, _not_at_all),
        camera_poses=read(path / "camera_poses.csv", read_camera_poses, _camera_poses),
        imu=read(path / "imu.csv", read_imu, _imu),
        calibration=read(path / "calibration.yaml", read_calibration, _calibration),
        T_world_cam=read(path / "T_world_cam.tum", read_tum, _trajectory),
        T_world_imu=read(path / "T_world_imu.tum", read_tum, _trajectory),
        T_odom_cam=read(path / "T_odom_cam.tum", read_tum, _trajectory),
        frames=read(path / "frames.csv", read_frames, _not_at_all),
    )
    return log, found


def _unreadable(file: Path, error: InputError, repaired: bool) -> Finding:
    evidence: Evidence = {} if error.line is None else {"line": error.line}
    fix = error.fix or "correct the file"
    return Finding("unreadable", "error", file.name, error.what, fix, evidence, repaired_in_reading=repaired)


def _not_at_all(file: Path) -> tuple[Any, list[Finding]]:
    return None, []


def _imu(file: Path) -> tuple[ImuSamples, list[Finding]]:
    gyroscope, accelerometer = ([f"{kind}_RS_S_{axis}" for axis in "xyz"] for kind in "wa")
    rows, _, units, found = read_csv_rows(file, ["timestamp"], [*gyroscope, *accelerometer])
    scales = np.ones(6)
    for column, name in enumerate([*gyroscope, *accelerometer]):
        unit = units.get(name, "")
        scales[column] = _UNIT_SCALES.get(unit, 1.0)
    wrong = sorted({unit for name, unit in units.items() if _UNIT_SCALES.get(unit) != 1.0})
    if wrong:
        known = all(unit in _UNIT_SCALES for unit in wrong)
        what, fix = f"the header says {', '.join(wrong)}", "convert to rad s^-1 and m s^-2"
        found.append(Finding("imu-header-units", "error", file.name, what, fix, {"line": 1}, repaired_in_reading=known))
    rows = replace(rows, numbers=rows.numbers * scales)
    rows, more = _cleaned(rows)
    samples = ImuSamples(rows.integers[:, 0], rows.numbers[:, :3], rows.numbers[:, 3:])
    return samples, found + more


def _cleaned(rows: Rows, pose: bool = False, keys: bool = False) -> tuple[Rows, list[Finding]]:
    """Return rows that a record can be made of; pose: the first seven numbers are one."""
    rows, found = without_nan(rows, slice(0, 7 if pose else None))
    if pose:
        rows, more = with_unit_quaternions(rows, slice(3, 7))
        found += more
    if not len(rows):
        raise InputError("has no row that can be used", path=rows.path, fix="see docs/formats.md")
    rows, more = in_order(rows, rows.integers[:, 2:4] if keys else None)
    return rows, found + more


def _trajectory(file: Path) -> tuple[Trajectory, list[Finding]]:
    rows, found = read_plain_rows(file, 8)
    rows, more = _cleaned(rows, pose=True)
    return Trajectory(rows.integers[:, 0], _poses(rows)), found + more


def _poses(rows: Rows):  # type: ignore[no-untyped-def]
    return pose_from_quaternion(rows.numbers[:, :3], rows.numbers[:, 3:7])


def _camera_poses(file: Path) -> tuple[CameraPoses, list[Finding]]:
    rows, has_covariance, _, found = read_csv_rows(file, ["timestamp_ns", "frame"], POSE_COLUMNS, COVARIANCE_COLUMNS)
    rows, more = _cleaned(rows, pose=True)
    covariances, bad = _covariances(rows, 7) if has_covariance else (None, [])
    return CameraPoses(rows.integers[:, 0], rows.integers[:, 1], _poses(rows), covariances), found + more + bad


def _object_poses(file: Path) -> tuple[ObjectPoses, list[Finding]]:
    integers = ["timestamp_ns", "frame", "object_id", "instance"]
    rows, has_covariance, _, found = read_csv_rows(file, integers, [*POSE_COLUMNS, "score"], COVARIANCE_COLUMNS)
    rows, more = _cleaned(rows, pose=True, keys=True)
    found += more
    distance = float(np.median(np.linalg.norm(rows.numbers[:, :3], axis=1)))
    if distance > _MILLIMETRES_M:
        what, fix = "translations are millimetres, it seems", "divide tx, ty, tz by 1000: metres belong here"
        evidence: Evidence = {"median_distance": round(distance, 1)}
        found.append(Finding("millimetres", "error", file.name, what, fix, evidence, repaired_in_reading=True))
        rows = replace(rows, numbers=rows.numbers / np.where(np.arange(rows.numbers.shape[1]) < 3, 1000.0, 1.0))
    covariances, bad = _covariances(rows, 8) if has_covariance else (None, [])
    scores, unscored = _scores(rows)
    columns = (rows.integers[:, 0], rows.integers[:, 1], rows.integers[:, 2], rows.integers[:, 3])
    return ObjectPoses(*columns, scores, _poses(rows), covariances), found + unscored + bad


def _scores(rows: Rows) -> tuple[np.ndarray, list[Finding]]:
    scores = rows.numbers[:, 7]
    bad: Mask = np.asarray(~np.isfinite(scores))
    if not bad.any():
        return scores, []
    what, fix = "scores are NaN or infinite", "give every detection a score, such as 1; --fix writes 0"
    return np.where(bad, 0.0, scores), [rows.finding("not-finite", bad, what, fix)]


def _covariances(rows: Rows, first: int) -> tuple[np.ndarray, list[Finding]]:
    upper = rows.numbers[:, first : first + 21]
    covariances = np.empty((len(rows), 6, 6))
    covariances[:, _UPPER[0], _UPPER[1]] = covariances[:, _UPPER[1], _UPPER[0]] = upper
    absent = np.isnan(upper).all(axis=1)
    bad: Mask = np.asarray(~absent & ~np.isfinite(upper).all(axis=1))
    bad[~absent & ~bad] = not_positive_definite(covariances[~absent & ~bad])
    covariances[bad] = np.nan
    if not bad.any():
        return covariances, []
    fix = "give the upper triangle of [rotation, translation] in rad^2 and m^2, or nan in all 21"
    return covariances, [rows.finding("covariance", bad, "covariances are not positive definite", fix)]


def _calibration(file: Path) -> tuple[Calibration | None, list[Finding]]:
    """Read a calibration whose lever arm is in millimetres; anything else that is refused stays refused."""
    try:
        content = yaml.safe_load(read_text(file))
        name = next(each for each in ("T_cam_imu", "T_imu_cam") if each in content["cam0"])
        matrix = np.array(content["cam0"][name], float)
        lever = float(np.linalg.norm(matrix[:3, 3]))
        if lever <= 10.0:
            return None, []
        matrix[:3, 3] /= 1000.0
        content["cam0"][name] = matrix.tolist()
    except (yaml.YAMLError, LookupError, TypeError, ValueError, StopIteration):
        return None, []
    with tempfile.TemporaryDirectory() as folder:
        corrected = Path(folder) / file.name
        corrected.write_text(yaml.safe_dump(content), encoding="utf-8")
        calibration = read_calibration(corrected)
    what, fix = f"the lever arm of {name} is millimetres, it seems", "divide its translation by 1000"
    evidence: Evidence = {"lever_arm": round(lever, 2)}
    return calibration, [Finding("millimetres", "error", file.name, what, fix, evidence, repaired_in_reading=True)]
