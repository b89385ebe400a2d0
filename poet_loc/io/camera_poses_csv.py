"""camera_poses.csv: camera poses T_world_cam from the solver or from elsewhere, one row per frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from poet_loc.core.records import CameraPoses
from poet_loc.io.number_table import read_number_csv, write_csv
from poet_loc.io.pose_columns import (
    COVARIANCE_COLUMNS,
    POSE_COLUMNS,
    covariance_cells,
    covariances_of,
    pose_cells,
    poses_of,
)

_REQUIRED = dict.fromkeys(("timestamp_ns", "frame"), int) | dict.fromkeys(POSE_COLUMNS, float)


def read_camera_poses(path: str | Path) -> CameraPoses:
    """Read camera poses: metres, q_xyzw, covariance of [e_r, e_t]; columns beyond those are ignored.

    Raises InputError, with the line, for whatever a camera pose cannot be.
    """
    table = read_number_csv(path, _REQUIRED, dict.fromkeys(COVARIANCE_COLUMNS, float), further_columns=True)
    T_world_cam = poses_of(table)
    covariances = covariances_of(table)
    stamps = table["timestamp_ns"]
    table.refuse_disorder(stamps, "sort the rows by time, one per frame")
    return CameraPoses(stamps, table["frame"], T_world_cam, covariances)


def write_camera_poses(
    path: str | Path, poses: CameraPoses, extra_columns: Mapping[str, Sequence[object] | ArrayLike] | None = None
) -> None:
    """Write camera poses and further columns by name; texts of these may hold no comma and no newline."""
    extra_columns = extra_columns or {}
    header, cells = [*_REQUIRED], [poses.stamps_ns, poses.frames, *pose_cells(poses.T_world_cam)]
    if poses.covariances is not None:
        header += COVARIANCE_COLUMNS
        cells += covariance_cells(poses.covariances)
    columns = [np.asarray(column) for column in extra_columns.values()]
    for name, column in zip(extra_columns, columns, strict=True):
        if column.dtype.kind in "OU" and any("," in str(cell) or "\n" in str(cell) for cell in column):
            raise ValueError(f"column {name} holds a comma or a newline")
    write_csv(path, [*header, *extra_columns], [*cells, *columns])
