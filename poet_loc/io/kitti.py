"""KITTI odometry: one 3x4 matrix a line, rows in order, and the stamps in a file of their own (times.txt, seconds)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.json_fields import are_rotations
from poet_loc.io.number_table import read_number_rows
from poet_loc.io.tum import read_seconds, seconds_text
from poet_loc.io.whole_folder import write_whole_file

_NAMES = tuple(f"m{row}{column}" for row in range(3) for column in range(4))


def read_kitti(path: str | Path, times: str | Path) -> Trajectory:
    """Read poses T_world_body (KITTI's world is the first camera: z forward) and their stamps.

    Raises InputError for a malformed row, a matrix that is no rotation, and another number of stamps than of poses.
    """
    table = read_number_rows(path, [(name, float) for name in _NAMES], comments="#")
    table.refuse_not_finite(_NAMES)
    matrices = table.stack(_NAMES).reshape(-1, 3, 4)
    table.refuse(~are_rotations(matrices[:, :, :3]), "is no rotation", "write r11 r12 r13 tx r21 .. r33 tz")
    stamps = read_seconds(times)
    if len(stamps) != len(matrices):
        what = f"has {len(stamps)} stamps for {len(matrices)} poses"
        raise InputError(what, path=times, fix="give one stamp per pose")
    return Trajectory(stamps, make_pose(Rotation.from_matrix(matrices[:, :, :3]), matrices[:, :, 3]))


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write poses as KITTI does, and their stamps beside them: poses.txt -> poses_times.txt."""
    path = Path(path)
    rows = _matrices(trajectory.T_world_body).reshape(-1, 12).tolist()
    write_whole_file(path, (" ".join(map(repr, row)) + "\n" for row in rows))
    stamps = (seconds_text(stamp) + "\n" for stamp in trajectory.stamps_ns.tolist())
    write_whole_file(times_beside(path), stamps)


def times_beside(path: Path) -> Path:
    """Return the file of the stamps that `write_kitti` writes beside poses."""
    return path.with_name(f"{path.stem}_times.txt")


def _matrices(T: RigidTransform) -> NDArray[np.float64]:
    return np.ascontiguousarray(T.as_matrix()[:, :3, :])
