"""The streams of a log by the name of their file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from poet_loc.io.log_folder import Log, object_poses_file

Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Stream:
    """The stamps of one file."""

    file: str
    stamps_ns: Stamps
    """Strictly increasing: a frame's detections share one."""
    on_imu_clock: bool
    regular: bool
    """Whether rows are expected at a steady rate; a pose sensor may see nothing for a while."""

    @property
    def intervals_s(self) -> NDArray[np.float64]:
        """(N-1,)"""
        return np.diff(self.stamps_ns) / 1e9


def streams_of(log: Log) -> Iterator[Stream]:
    """Yield the streams that a log has."""
    for name, poses in log.object_poses.items():
        yield Stream(object_poses_file(name), np.unique(poses.stamps_ns), False, False)
    if log.camera_poses is not None:
        yield Stream("camera_poses.csv", log.camera_poses.stamps_ns, False, False)
    if log.imu is not None:
        yield Stream("imu.csv", log.imu.stamps_ns, True, True)
    for file, trajectory in trajectories_of(log).items():
        yield Stream(file, trajectory.stamps_ns, file == "T_world_imu.tum", False)
    if log.frames is not None:
        yield Stream("frames.csv", log.frames.stamps_ns, False, False)


def trajectories_of(log: Log):  # type: ignore[no-untyped-def]
    """Return the trajectories that a log has, by file."""
    every = {"T_world_cam.tum": log.T_world_cam, "T_world_imu.tum": log.T_world_imu, "T_odom_cam.tum": log.T_odom_cam}
    return {file: trajectory for file, trajectory in every.items() if trajectory is not None}


def with_stamps(log: Log, file: str, change: Callable[[Stamps], Stamps]) -> Log:
    """Return the log with other stamps in one file."""
    for name, poses in log.object_poses.items():
        if object_poses_file(name) == file:
            moved = replace(poses, stamps_ns=change(poses.stamps_ns))
            return replace(log, object_poses={**log.object_poses, name: moved})
    field = file.split(".")[0]
    record = getattr(log, field)
    return replace(log, **{field: replace(record, stamps_ns=change(record.stamps_ns))})
