"""A log: the folder of files that one recording is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, CameraPoses, ImuSamples, LandmarkMap, ObjectPoses, Stamps
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.calibration_yaml import read_calibration, write_calibration
from poet_loc.io.camera_poses_csv import read_camera_poses, write_camera_poses
from poet_loc.io.frames_csv import Frames, read_frames, write_frames
from poet_loc.io.imu_csv import read_imu, write_imu
from poet_loc.io.landmarks_json import read_landmarks, write_landmarks
from poet_loc.io.object_poses_csv import line_of_object, read_object_poses, write_object_poses
from poet_loc.io.tum import read_tum, write_tum

Record = TypeVar("Record")

_OBJECT_POSES = "object_poses"
_FIX = "a log holds object_poses.csv with landmarks.json, or camera_poses.csv"
_NO_MAP_FIX = f"{_FIX}; fuse --estimate.map unknown makes a map"


@dataclass(frozen=True)
class Log:
    """What a log folder holds; None where a file is missing."""

    path: Path
    object_poses: Mapping[str, ObjectPoses] = field(default_factory=dict)
    """By name: "" for object_poses.csv, NAME for object_poses_NAME.csv."""
    landmark_map: LandmarkMap | None = None
    camera_poses: CameraPoses | None = None
    imu: ImuSamples | None = None
    calibration: Calibration | None = None
    T_world_cam: Trajectory | None = None
    """Ground truth of the camera."""
    T_world_imu: Trajectory | None = None
    """Ground truth of the IMU."""
    T_odom_cam: Trajectory | None = None
    """Odometry: relative motion holds, the frame drifts."""
    frames: Frames | None = None

    @property
    def timeshift_ns(self) -> int:
        """What turns a camera stamp into an IMU stamp; 0 without a calibration."""
        return 0 if self.calibration is None else self.calibration.timeshift_ns

    def detections(self, name: str | None = None) -> tuple[str, ObjectPoses]:
        """Return name and poses of one set of detections.

        Without a name: object_poses.csv, or the only set there is. Raises InputError where that leaves a choice,
        and for a name that is not there.
        """
        names = sorted(self.object_poses)
        if name is None:
            if not names:
                raise InputError("has no object_poses.csv", path=self.path, fix=_FIX)
            if "" not in names and len(names) > 1:
                what = f"has several sets of detections: {', '.join(names)}"
                raise InputError(what, path=self.path, fix="choose one with --detections NAME")
            name = "" if "" in names else names[0]
        if name not in self.object_poses:
            raise _no_such_detections(self.path, name, names)
        return name, self.object_poses[name]


def read_log(path: str | Path, detections: str | None = None, unmapped: bool = False) -> Log:
    """Read a log folder; of several sets of detections only the named one where a name is given.

    unmapped: object poses without landmarks.json will do, as for an unknown map.
    Raises InputError for a folder that is no log, streams without a common time span, detections of objects that the
    map does not have, and whatever the readers of the files refuse.
    """
    log = read_log_files(path, detections)
    if log.camera_poses is None and not log.object_poses:
        raise InputError("has no object_poses.csv", path=path, fix=_FIX)
    if log.camera_poses is None and log.landmark_map is None and not unmapped:
        raise InputError("has no landmarks.json", path=path, fix=_NO_MAP_FIX)
    check_log(log)
    return log


def read_log_files(path: str | Path, detections: str | None = None) -> Log:
    """Read whatever files of a log a folder has, without asking whether they are enough or belong together."""
    path = Path(path)
    files = object_pose_files(path)
    if detections is not None:
        if detections not in files:
            raise _no_such_detections(path, detections, sorted(files))
        files = {detections: files[detections]}
    return Log(
        path=path,
        object_poses={name: read_object_poses(file) for name, file in files.items()},
        landmark_map=_read_if_there(path / "landmarks.json", read_landmarks),
        camera_poses=_read_if_there(path / "camera_poses.csv", read_camera_poses),
        imu=_read_if_there(path / "imu.csv", read_imu),
        calibration=_read_if_there(path / "calibration.yaml", read_calibration),
        T_world_cam=_read_if_there(path / "T_world_cam.tum", read_tum),
        T_world_imu=_read_if_there(path / "T_world_imu.tum", read_tum),
        T_odom_cam=_read_if_there(path / "T_odom_cam.tum", read_tum),
        frames=_read_if_there(path / "frames.csv", read_frames),
    )


def check_log(log: Log) -> None:
    """Raise InputError where the records do not belong together: unknown objects, no common time span."""
    _refuse_unknown_objects(log)
    _refuse_separate_spans(log)


def write_log(path: str | Path, log: Log) -> None:
    """Write what a log holds into an existing folder."""
    path = Path(path)
    for name, poses in log.object_poses.items():
        write_object_poses(path / object_poses_file(name), poses)
    _write_if_there(path / "landmarks.json", log.landmark_map, write_landmarks)
    _write_if_there(path / "camera_poses.csv", log.camera_poses, write_camera_poses)
    _write_if_there(path / "imu.csv", log.imu, write_imu)
    _write_if_there(path / "calibration.yaml", log.calibration, write_calibration)
    _write_if_there(path / "T_world_cam.tum", log.T_world_cam, write_tum)
    _write_if_there(path / "T_world_imu.tum", log.T_world_imu, write_tum)
    _write_if_there(path / "T_odom_cam.tum", log.T_odom_cam, write_tum)
    _write_if_there(path / "frames.csv", log.frames, write_frames)


def object_pose_files(path: Path) -> dict[str, Path]:
    """Return the files of the sets of detections by name.  Raises InputError where the path is no folder."""
    if not path.is_dir():
        what = "is a file, no log folder" if path.exists() else "does not exist"
        raise InputError(what, path=path, fix=_FIX)
    files = sorted(path.glob(f"{_OBJECT_POSES}*.csv"))
    names = {file: file.stem.removeprefix(_OBJECT_POSES) for file in files}
    return {name[1:]: file for file, name in names.items() if name == "" or (name[0] == "_" and name[1:])}


def object_poses_file(name: str) -> str:
    """Return the file name of a set of detections."""
    return f"{_OBJECT_POSES}_{name}.csv" if name else f"{_OBJECT_POSES}.csv"


def _no_such_detections(path: Path, name: str, names: list[str]) -> InputError:
    there = ", ".join(object_poses_file(each) for each in names) or "none"
    return InputError(f"has no {object_poses_file(name)}", path=path, fix=f"choose among {there}")


def _read_if_there(path: Path, read: Callable[[Path], Record]) -> Record | None:
    return read(path) if path.exists() else None


def _write_if_there(path: Path, record: Record | None, write: Callable[[Path, Record], None]) -> None:
    if record is not None:
        write(path, record)


def _refuse_unknown_objects(log: Log) -> None:
    if log.landmark_map is None:
        return
    known = log.landmark_map.object_ids
    for name, poses in log.object_poses.items():
        unknown = poses.object_ids[~np.isin(poses.object_ids, known)]
        if unknown.size:
            file = log.path / object_poses_file(name)
            ids, rows = np.unique(unknown, return_counts=True)
            what = f"object {unknown[0]} is not in the map (it has {', '.join(map(str, sorted(set(known.tolist()))))})"
            if len(ids) > 1:
                counted = ", ".join(f"{each} ({count} rows)" for each, count in zip(ids, rows, strict=True))
                what += f"; not in it: {counted}"
            fix = f"add it to {log.path / 'landmarks.json'}, or leave its rows out: poet-loc check LOG --fix COPY does"
            line = line_of_object(file, int(unknown[0])) if file.exists() else None
            raise InputError(what, path=file, line=line, fix=fix)


def _refuse_separate_spans(log: Log) -> None:
    streams = list(_spans_ns(log))
    for index, (file, start, end) in enumerate(streams):
        for other, other_start, other_end in streams[:index]:
            if max(start, other_start) > min(end, other_end):
                what = (
                    f"covers {start / 1e9:.3f} .. {end / 1e9:.3f} s, {other} {other_start / 1e9:.3f} .. "
                    f"{other_end / 1e9:.3f} s: no common time span"
                )
                fix = "bring all stamps to one clock, in nanoseconds"
                if log.calibration is not None and abs(log.calibration.timeshift_cam_imu_s) >= 1.0:
                    shift = f"timeshift_cam_imu = {log.calibration.timeshift_cam_imu_s:g} s"
                    fix += f"; with {shift} of calibration.yaml, which is in seconds"
                raise InputError(what, path=log.path / file, fix=fix)


def _spans_ns(log: Log) -> Iterator[tuple[str, int, int]]:
    """Yield file, first and last stamp of each stream, on the camera's clock."""
    streams: list[tuple[str, Stamps | None, int]] = [
        *((object_poses_file(name), poses.stamps_ns, 0) for name, poses in log.object_poses.items()),
        ("camera_poses.csv", None if log.camera_poses is None else log.camera_poses.stamps_ns, 0),
        ("imu.csv", None if log.imu is None else log.imu.stamps_ns, log.timeshift_ns),
        ("T_world_cam.tum", None if log.T_world_cam is None else log.T_world_cam.stamps_ns, 0),
        ("T_world_imu.tum", None if log.T_world_imu is None else log.T_world_imu.stamps_ns, log.timeshift_ns),
        ("T_odom_cam.tum", None if log.T_odom_cam is None else log.T_odom_cam.stamps_ns, 0),
        ("frames.csv", None if log.frames is None else log.frames.stamps_ns, 0),
    ]
    for file, stamps, shift in streams:
        if stamps is not None and len(stamps):
            yield file, int(stamps[0]) - shift, int(stamps[-1]) - shift
