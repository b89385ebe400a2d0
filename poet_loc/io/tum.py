"""TUM trajectories: t tx ty tz qx qy qz qw, seconds with up to nine decimals, never through a float."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.trajectory import Trajectory
from poet_loc.io.number_table import NumberTable, read_number_rows
from poet_loc.io.pose_columns import POSE_COLUMNS, not_positive_definite, pose_cells, poses_of
from poet_loc.io.whole_folder import write_whole_file

Stamps = NDArray[np.int64]

_NS_PER_S = 10**9
_INT64_MAX = np.iinfo(np.int64).max


def read_tum(path: str | Path) -> Trajectory:
    """Read a trajectory: stamps exact to the nanosecond, metres, q_xyzw; `#` starts a comment.

    Raises InputError, with the line, for a malformed row, a bad quaternion and stamps that do not increase.
    """
    table = read_number_rows(path, [("t", "S64"), *((name, float) for name in POSE_COLUMNS)], comments="#")
    T_world_body = poses_of(table)
    stamps = read_seconds_column(table)
    table.refuse_disorder(stamps, "sort the rows by time, one per stamp, with all decimals")
    return Trajectory(stamps, T_world_body)


def read_seconds(path: str | Path) -> Stamps:
    """Read a file of stamps in seconds, one a line, exact to the nanosecond.

    Raises InputError where they do not increase.
    """
    table = read_number_rows(path, [("t", "S64")], comments="#")
    stamps = read_seconds_column(table)
    table.refuse_disorder(stamps, "sort the stamps, each once, with all decimals")
    return stamps


def read_tum_with_covariances(path: str | Path) -> tuple[Trajectory, NDArray[np.float64]]:
    """Read a trajectory with twelve columns of covariance as RPG's tools and OpenVINS write them.

    t tx ty tz qx qy qz qw, then the upper triangles of two 3x3 blocks: Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 of the rotation
    (body axes, rad^2) and Pt11 .. Pt33 of the position (world axes, m^2). Returns (N, 6, 6) of [e_r, e_t] with
    R = R_true Exp(e_r), t = t_true + e_t; the blocks between the two are not in the file and are zero.
    """
    blocks = [f"P{kind}{i}{j}" for kind in "rt" for i in range(3) for j in range(i, 3)]
    columns = [("t", "S64"), *((name, float) for name in (*POSE_COLUMNS, *blocks))]
    table = read_number_rows(path, columns, comments="#")
    table.refuse_not_finite(blocks)
    T_world_body, stamps = poses_of(table), read_seconds_column(table)
    table.refuse_disorder(stamps, "sort the rows by time, one per stamp, with all decimals")
    covariances = np.zeros((len(table), 6, 6))
    rows, columns_ = np.triu_indices(3)
    for offset, names in ((0, blocks[:6]), (3, blocks[6:])):
        upper = table.stack(names)
        covariances[:, offset + rows, offset + columns_] = covariances[:, offset + columns_, offset + rows] = upper
    bad = not_positive_definite(covariances)
    table.refuse(bad, "the covariance is not positive definite", "give variances above zero, rotation first")
    return Trajectory(stamps, T_world_body), covariances


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory, stamps with nine decimals."""
    columns = [map(repr, column.tolist()) for column in pose_cells(trajectory.T_world_body)]
    rows = zip(map(seconds_text, trajectory.stamps_ns.tolist()), *columns, strict=True)
    write_whole_file(path, (" ".join(row) + "\n" for row in rows))


def seconds_text(stamp_ns: int) -> str:
    """Return a stamp in seconds with nine decimals, exactly."""
    seconds, rest = divmod(abs(stamp_ns), _NS_PER_S)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{rest:09d}"


def read_seconds_column(table: NumberTable) -> Stamps:
    """Return the column t of a table, text of seconds, in nanoseconds.  Raises InputError for what is no time."""
    texts = table["t"]
    stamps, plain = _plain_decimals(texts)
    for row in np.flatnonzero(~plain):
        value = _nanoseconds(texts[row].decode(errors="replace"))
        if value is None or abs(value) > _INT64_MAX:
            what = f"{shortened(texts[row].decode(errors='replace'))} is no time in seconds"
            table.refuse(np.arange(len(table)) == row, what, "TUM wants seconds, for example 1403715273.312140000")
        else:
            stamps[row] = value
    return stamps


def _plain_decimals(texts: NDArray[Any]) -> tuple[Stamps, NDArray[np.bool_]]:
    """Return nanoseconds of texts such as b"1600059000.033333333", and which texts have that plain form."""
    width = texts.dtype.itemsize
    characters = texts.view(np.uint8).reshape(len(texts), width)
    length = np.count_nonzero(characters, axis=1)
    is_dot = characters == ord(".")
    is_digit = (characters >= ord("0")) & (characters <= ord("9"))
    dots = is_dot.sum(axis=1)
    point = np.where(dots > 0, is_dot.argmax(axis=1), length)
    decimals = np.maximum(length - point - 1, 0)
    plain = (dots <= 1) & (is_digit.sum(axis=1) + dots == length) & (decimals <= 9) & (point >= 1) & (point <= 10)
    value = np.zeros(len(texts), np.uint64)  # 19 digits fit
    for column in range(int(length.max(initial=0))):
        digit = is_digit[:, column] & plain
        value[digit] = value[digit] * np.uint64(10) + (characters[digit, column] - ord("0"))
    value *= np.uint64(10) ** (9 - np.minimum(decimals, 9)).astype(np.uint64)
    plain &= value <= _INT64_MAX
    return np.where(plain, value, 0).astype(np.int64), plain


def _nanoseconds(text: str) -> int | None:
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        return None
    if "_" in text or not seconds.is_finite() or seconds.adjusted() > 10:
        return None
    return int((seconds * _NS_PER_S).to_integral_value())
