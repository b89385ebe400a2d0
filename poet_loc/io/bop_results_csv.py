"""BOP results: scene_id,im_id,obj_id,score,R,t,time; R row-major and t in millimetres, each separated by spaces."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.io.input_text import read_text
from poet_loc.io.json_fields import are_rotations
from poet_loc.io.whole_folder import write_whole_file

Array = NDArray[np.float64]

_HEADER = "scene_id,im_id,obj_id,score,R,t,time"
_COMMAS = tuple(f"comma_{index}" for index in range(6))
_DTYPE = np.dtype(
    [
        ("scene_id", np.int64),
        (_COMMAS[0], "S1"),
        ("im_id", np.int64),
        (_COMMAS[1], "S1"),
        ("obj_id", np.int64),
        (_COMMAS[2], "S1"),
        ("score", float),
        (_COMMAS[3], "S1"),
        ("R", float, (9,)),
        (_COMMAS[4], "S1"),
        ("t", float, (3,)),
        (_COMMAS[5], "S1"),
        ("time", float),
    ]
)
_MM_PER_M = 1000.0
_NEAREST_MEDIAN_MM = 20.0
_FIX = f"a row is {_HEADER} with nine numbers in R and three in t, separated by spaces"


@dataclass(frozen=True)
class BopResults:
    """Estimates of a BOP method, N rows in the order of the file."""

    scene_ids: NDArray[np.int64]
    image_ids: NDArray[np.int64]
    object_ids: NDArray[np.int64]
    scores: Array
    T_cam_obj: RigidTransform
    """m"""
    times_s: Array
    """Run time for the image, s; -1 where unknown."""

    def __len__(self) -> int:
        return len(self.scene_ids)


def read_bop_results(path: str | Path) -> BopResults:
    """Read BOP results; a header glued to its first row, as PoET writes it, is repaired with a warning.

    Raises InputError, with the line, for a malformed row, a matrix that is no rotation, and metres.
    """
    lines = _lines_after_header(path)
    rows = _parse(path, lines)

    def refuse(bad: NDArray[np.bool_], what: str) -> None:
        if bad.any():
            raise InputError(what, path=path, line=lines[int(np.argmax(bad))][0], fix=_FIX)

    matrices = rows["R"].reshape(-1, 3, 3)
    finite = [np.isfinite(rows[name]).reshape(len(rows), -1).all(axis=1) for name in ("score", "R", "t", "time")]
    refuse(~np.logical_and.reduce(finite), "a number is NaN or infinite")
    refuse(~are_rotations(matrices), "R is no rotation")
    distance = float(np.median(np.linalg.norm(rows["t"], axis=1)))
    if distance < _NEAREST_MEDIAN_MM:
        what = f"t looks like metres (median length {distance:.3g})"
        raise InputError(what, path=path, fix="multiply by 1000: BOP keeps millimetres")
    T_cam_obj = make_pose(Rotation.from_matrix(matrices), rows["t"] / _MM_PER_M)
    columns = {name: np.ascontiguousarray(rows[name]) for name in ("scene_id", "im_id", "obj_id", "score", "time")}
    return BopResults(
        columns["scene_id"], columns["im_id"], columns["obj_id"], columns["score"], T_cam_obj, columns["time"]
    )


def write_bop_results(path: str | Path, results: BopResults) -> None:
    """Write BOP results."""
    rotations = results.T_cam_obj.rotation.as_matrix().reshape(-1, 9).tolist()
    millimetres = (results.T_cam_obj.translation * _MM_PER_M).tolist()
    ids = zip(results.scene_ids.tolist(), results.image_ids.tolist(), results.object_ids.tolist(), strict=True)
    rest = zip(results.scores.tolist(), rotations, millimetres, results.times_s.tolist(), strict=True)
    rows = (
        f"{scene},{image},{object_id},{score!r},{' '.join(map(repr, R))},{' '.join(map(repr, t))},{time!r}\n"
        for (scene, image, object_id), (score, R, t, time) in zip(ids, rest, strict=True)
    )
    write_whole_file(path, [_HEADER + "\n", *rows])


def _lines_after_header(path: str | Path) -> list[tuple[int, str]]:
    """Return line number and text of each row."""
    first, *rest = read_text(path).split("\n")
    header = re.match(r"\s*" + r"\s*,\s*".join(_HEADER.split(",")), first)
    if header is None:
        raise InputError(f"the header is {first.strip()[:80]!r}", path=path, line=1, fix=f"write {_HEADER}")
    glued = first[header.end() :]
    if glued.strip():
        warnings.warn(f"{path}:1: the header is glued to its first row; read as two lines", stacklevel=3)
    lines = [(number, line) for number, line in enumerate([glued, *rest], start=1) if line.strip()]
    if not lines:
        raise InputError("has no rows", path=path, fix="give a file with data")
    return lines


def _parse(path: str | Path, lines: list[tuple[int, str]]) -> NDArray[Any]:
    try:
        return _rows("\n".join(line for _, line in lines))
    except (ValueError, OverflowError) as error:
        for number, line in lines:
            if not _is_row(line):
                raise InputError("is no row of BOP results", path=path, line=number, fix=_FIX) from None
        raise InputError(f"cannot be read: {error}", path=path, fix=_FIX) from error


def _rows(text: str) -> NDArray[Any]:
    """Return the rows of a text; a comma is a column of its own, so that each stands where it belongs."""
    rows = np.loadtxt(io.StringIO(text.replace(",", " , ")), _DTYPE, comments=None, ndmin=1)
    if any((rows[comma] != b",").any() for comma in _COMMAS):
        raise ValueError("a comma is out of place")
    return rows


def _is_row(line: str) -> bool:
    try:
        return len(_rows(line)) == 1
    except (ValueError, OverflowError):
        return False
