"""The vertices of a PLY model: ASCII and binary, as BOP data sets have them; millimetres outside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError

Array = NDArray[np.float64]

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_MM_PER_M = 1000.0


def read_model_points(path: str | Path) -> Array:
    """Return the vertices (V, 3) of a BOP model in m.  Raises InputError for what is no such file."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError("no such model", path=path) from None
    head, mark, body = data.partition(b"end_header")
    lines = head.decode("ascii", errors="replace").split("\n")
    try:
        if not mark or lines[0].strip() != "ply":
            raise ValueError("no PLY header")
        kind = next(line.split()[1] for line in lines if line.startswith("format"))
        count, columns = _vertex_columns(lines)
        body = body[body.index(b"\n") + 1 :]
        if kind == "ascii":
            rows = [line.split() for line in body.split(b"\n", count)[:count]]
            table = np.array([row[: len(columns)] for row in rows], float)
            points = table[:, [[name for name, _ in columns].index(axis) for axis in "xyz"]]
        else:
            record = np.dtype([(name, _ORDERS[kind] + _TYPES[type_name]) for name, type_name in columns])
            vertices = np.frombuffer(body, record, count)
            points = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(float)
    except (ValueError, KeyError, StopIteration, IndexError) as error:
        raise InputError(f"not a PLY model ({error})", path=path) from None
    return points / _MM_PER_M


def _vertex_columns(lines: list[str]) -> tuple[int, list[tuple[str, str]]]:
    """Return how many vertices there are, and name and type of their properties; they come first in the file."""
    elements = [line.split() for line in lines if line.startswith("element")]
    if not elements or elements[0][1] != "vertex":
        raise ValueError("the vertices do not come first")
    start = next(i for i, line in enumerate(lines) if line.startswith("element vertex"))
    columns = []
    for line in lines[start + 1 :]:
        words = line.split()
        if words[:1] == ["element"]:
            break
        if words[:1] == ["property"]:
            columns.append((words[-1], words[1]))
    return int(elements[0][2]), columns
