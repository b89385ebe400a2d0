"""object_poses.csv: what the pose sensor saw, T_cam_obj, one row per detection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.records import ObjectPoses
from poet_loc.io.number_table import NumberTable, read_number_csv, write_csv
from poet_loc.io.pose_columns import (
    COVARIANCE_COLUMNS,
    POSE_COLUMNS,
    covariance_cells,
    covariances_of,
    pose_cells,
    poses_of,
    refuse_millimetres,
)

_REQUIRED = dict.fromkeys(("timestamp_ns", "frame", "object_id", "instance"), int) | dict.fromkeys(
    ("score", *POSE_COLUMNS), float
)
_FARTHEST_MEDIAN_M = 50.0


def read_object_poses(path: str | Path) -> ObjectPoses:
    """Read object poses: metres, q_xyzw, covariance in camera axes; rows sorted by stamp.

    A file may be ordered by time or object after object: within one (object_id, instance) stamps increase.
    Raises InputError, with the line, for whatever a detection cannot be.
    """
    table = _read_table(path)
    table.refuse_not_finite(["score"])
    T_cam_obj = poses_of(table)
    covariances = covariances_of(table)
    _refuse_disorder(table)
    refuse_millimetres(path, T_cam_obj, _FARTHEST_MEDIAN_M)
    poses = ObjectPoses(
        table["timestamp_ns"],
        table["frame"],
        table["object_id"],
        table["instance"],
        table["score"],
        T_cam_obj,
        covariances,
    )
    if np.all(poses.stamps_ns[1:] >= poses.stamps_ns[:-1]):
        return poses
    return poses[np.argsort(poses.stamps_ns, kind="stable")]


def write_object_poses(path: str | Path, poses: ObjectPoses) -> None:
    """Write object poses, with the 21 covariance columns where they have covariances."""
    header = [*_REQUIRED]
    columns = [poses.stamps_ns, poses.frames, poses.object_ids, poses.instances, poses.scores]
    cells = [*columns, *pose_cells(poses.T_cam_obj)]
    if poses.covariances is not None:
        header += COVARIANCE_COLUMNS
        cells += covariance_cells(poses.covariances)
    write_csv(path, header, cells)


def line_of_object(path: str | Path, object_id: int) -> int:
    """Return the first line of a well-formed file that holds an object."""
    table = _read_table(path)
    return table.line(int(np.argmax(table["object_id"] == object_id)))


def count_instances(images: NDArray[Any], object_ids: NDArray[Any]) -> NDArray[np.int64]:
    """Return 0, 1, 2 .. for the detections of one object in one image, in their order.  (N,), (N,) -> (N,)."""
    if len(images) == 0:
        return np.empty(0, np.int64)
    order = np.lexsort((object_ids, images))
    starts = np.ones(len(order), bool)
    starts[1:] = (np.diff(images[order]) != 0) | (np.diff(object_ids[order]) != 0)
    position = np.arange(len(order))
    instances = np.empty(len(order), np.int64)
    instances[order] = position - np.maximum.accumulate(np.where(starts, position, 0))
    return instances


def _read_table(path: str | Path) -> NumberTable:
    return read_number_csv(path, _REQUIRED, dict.fromkeys(COVARIANCE_COLUMNS, float))


def _refuse_disorder(table: NumberTable) -> None:
    stamps, objects, instances = table["timestamp_ns"], table["object_id"], table["instance"]
    order = np.lexsort((instances, objects))  # stable: the file's order within one object
    earlier, later = order[:-1], order[1:]
    same = (objects[earlier] == objects[later]) & (instances[earlier] == instances[later])
    bad = np.flatnonzero(same & (stamps[later] <= stamps[earlier]))
    if bad.size:
        first = bad[np.argmin(later[bad])]
        row = int(later[first])
        name = f"object {objects[row]}, instance {instances[row]}"
        backwards = stamps[row] < stamps[earlier[first]]
        what = f"the stamps of {name} go backwards" if backwards else f"{name} is there twice at one stamp"
        table.refuse(np.arange(len(table)) == row, what, "sort the rows by time" if backwards else "keep one row")
