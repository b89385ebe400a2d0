"""slam-super-6d's text files become the object poses of a log: one file per object, a row per image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.input_error import InputError
from poet_loc.core.records import ObjectPoses
from poet_loc.io.log_folder import Log, check_log, read_log_files, write_log
from poet_loc.io.number_table import read_number_rows
from poet_loc.io.tum import read_seconds_column
from poet_loc.io.whole_folder import whole_folder

_TRANSLATION = ("tx", "ty", "tz")


@dataclass(frozen=True)
class ConvertSuper6dOptions:
    """How detections of slam-super-6d become a log."""

    objects: Mapping[str, int]
    """File name -> object id: --objects 003_cracker_box.txt 2 010_potted_meat_can.txt 9."""
    unit: Literal["m", "cm", "mm"] = "m"
    """Unit of the translations."""
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    """Order of the quaternions; the files' own is x, y, z, w."""
    name: str = ""
    """The object poses become object_poses_NAME.csv."""
    like: Path | None = None
    """Folder whose map, IMU, calibration and ground truth the new log takes over."""
    overwrite: bool = False
    """Replace an output folder that holds something."""


def convert_super6d(folder: str | Path, out: str | Path, options: ConvertSuper6dOptions) -> Log:
    """Write a log folder from `t tx ty tz qx qy qz qw` rows; a row of zeros after the stamp is no detection.

    Raises InputError for a missing file, a malformed row and records that do not belong together.
    """
    if not options.objects:
        raise InputError("no object is named", fix="give --objects FILE ID FILE ID ..")
    parts = [_read(Path(folder) / file, object_id, options) for file, object_id in options.objects.items()]
    stamps = np.concatenate([part[0] for part in parts])
    order = np.argsort(stamps, kind="stable")
    numbers, ids = (
        np.concatenate([part[1] for part in parts])[order],
        np.concatenate([part[2] for part in parts])[order],
    )
    stamps = stamps[order]
    poses = ObjectPoses(
        stamps_ns=stamps,
        frames=np.unique(stamps, return_inverse=True)[1].astype(np.int64),
        object_ids=ids,
        instances=np.zeros(len(stamps), np.int64),
        scores=np.ones(len(stamps)),
        T_cam_obj=pose_from_quaternion(numbers[:, :3], numbers[:, 3:]),
    )
    like = Log(Path(out)) if options.like is None else read_log_files(options.like)
    log = replace(like, path=Path(out), object_poses={**like.object_poses, options.name: poses})
    check_log(log)
    inputs = [path for path in (folder, options.like) if path is not None]
    with whole_folder(out, options.overwrite, inputs) as target:
        write_log(target, log)
    return log


def _read(path: Path, object_id: int, options: ConvertSuper6dOptions):  # type: ignore[no-untyped-def]
    quaternion = tuple(f"q{axis}" for axis in options.quaternion)
    columns = [("t", "S64"), *((name, float) for name in (*_TRANSLATION, *quaternion))]
    table = read_number_rows(path, columns, comments="#")
    table.refuse_not_finite((*_TRANSLATION, *quaternion))
    stamps = read_seconds_column(table)
    table.refuse_disorder(stamps, "sort the rows by time")
    numbers = table.stack((*_TRANSLATION, "qx", "qy", "qz", "qw"))
    seen = np.any(numbers != 0.0, axis=1)
    norm = np.linalg.norm(numbers[:, 3:], axis=1)
    table.refuse(seen & (np.abs(norm - 1.0) > 0.01), "the quaternion has a norm other than 1", "normalise it")
    numbers[:, :3] *= {"m": 1.0, "cm": 0.01, "mm": 0.001}[options.unit]
    return stamps[seen], numbers[seen], np.full(int(seen.sum()), object_id, np.int64)
