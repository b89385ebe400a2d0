"""A PLY model, ASCII or binary, as BOP data sets have them; millimetres outside."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError

Array = NDArray[np.float64]
Triangles = NDArray[np.int32]

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
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_FACE_LISTS = ("vertex_indices", "vertex_index")
_LENGTH_OF = "length of "
_MM_PER_M = 1000.0


@dataclass(frozen=True)
class _Element:
    """One element of the header: its name, how many there are, and its properties as the header has them."""

    name: str
    count: int
    properties: tuple[tuple[str, ...], ...]
    """(type, name), or (list, type of the count, type of the items, name)."""


def read_model_points(path: str | Path) -> Array:
    """Return the vertices (V, 3) of a BOP model in m.  Raises InputError for what is no such file."""
    return _points(_read(path, with_faces=False)[0])


def read_model_mesh(path: str | Path) -> tuple[Array, Triangles]:
    """Return vertices (V, 3) in m and triangles (F, 3) of a BOP model; polygons are cut into fans.

    Raises InputError for what is no such file, and for faces that differ in their number of corners.
    """
    vertices, triangles, _ = _read(path)
    return _points(vertices), triangles


@dataclass(frozen=True)
class ColouredMesh:
    """A model with what it looks like; at most one of the two is known."""

    vertices: Array
    """(V, 3) m."""
    triangles: Triangles
    """(F, 3)"""
    colours: NDArray[np.uint8] | None
    """(V, 3) RGB."""
    texture: Path | None
    """Image file."""
    texture_places: Array | None
    """(V, 2) in shares of the image's width and height, from its lower left corner."""


def read_coloured_mesh(path: str | Path) -> ColouredMesh:
    """Return a BOP model with its texture's places or its vertices' colours.  Raises InputError as read_model_mesh."""
    vertices, triangles, header = _read(path)
    names = vertices.dtype.names or ()
    file = next((line.split(maxsplit=2)[2].strip() for line in header if line.startswith("comment TextureFile")), None)
    if file is not None and {"texture_u", "texture_v"} <= set(names):
        places = np.stack([vertices[axis] for axis in ("texture_u", "texture_v")], -1).astype(float)
        return ColouredMesh(_points(vertices), triangles, None, Path(path).parent / file, places)
    colours = None
    if {"red", "green", "blue"} <= set(names):
        colours = np.stack([vertices[name] for name in ("red", "green", "blue")], -1).astype(np.uint8)
    return ColouredMesh(_points(vertices), triangles, colours, None, None)


def _read(path: str | Path, with_faces: bool = True) -> tuple[NDArray[np.void], Triangles, list[str]]:
    """Return the rows of vertices, the triangles, and the lines of the header."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError("no such model", path=path) from None
    head, mark, body = data.partition(b"end_header")
    lines = head.decode("ascii", errors="replace").split("\n")
    try:
        if not mark or lines[0].strip() != "ply":
            raise ValueError("no PLY header")
        order = _ORDERS[next(line.split()[1] for line in lines if line.startswith("format"))]
        elements = _elements(lines)
        if not elements or elements[0].name != "vertex":
            raise ValueError("the vertices do not come first")
        body = body[body.index(b"\n") + 1 :]
        vertices, body = _read_element(body, elements[0], order)
        _points(vertices)
        if not with_faces:
            return vertices, np.zeros((0, 3), np.int32), lines
        if len(elements) < 2 or elements[1].name != "face" or elements[1].count == 0:
            raise ValueError("it has no faces")
        return vertices, _triangles(_read_element(body, elements[1], order)[0], len(vertices)), lines
    except (ValueError, KeyError, StopIteration, IndexError) as error:
        raise InputError(f"not a PLY model ({error})", path=path) from None


def _points(vertices: NDArray[np.void]) -> Array:
    return np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(float) / _MM_PER_M


def _elements(lines: list[str]) -> list[_Element]:
    elements: list[_Element] = []
    for line in lines:
        words = line.split()
        if words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), ()))
        elif words[:1] == ["property"] and elements:
            last = elements[-1]
            elements[-1] = _Element(last.name, last.count, (*last.properties, tuple(words[1:])))
    return elements


def _read_element(body: bytes, element: _Element, order: str) -> tuple[NDArray[np.void], bytes]:
    """Return the rows of an element and what follows them; a list must be as long in all rows as in the first."""
    if order == "":
        lines = body.split(b"\n", element.count)
        first, rest = lines[0].split(), b"".join(lines[element.count :])
        record = _row_type(element, order, lambda before, _: int(first[_numbers(before)]))
        rows = np.loadtxt(io.BytesIO(b"\n".join(lines[: element.count])), record, comments=None, ndmin=1)
        if len(rows) < element.count:
            raise ValueError("it ends early")
    else:
        record = _row_type(element, order, lambda before, kind: int(np.frombuffer(body, kind, 1, before.itemsize)[0]))
        rows, rest = np.frombuffer(body, record, element.count), body[element.count * record.itemsize :]
    for name in record.names or ():
        if name.startswith(_LENGTH_OF) and (rows[name] != rows[name][0]).any():
            raise ValueError(f"the length of {name.removeprefix(_LENGTH_OF)} differs from row to row")
    return rows, rest


def _row_type(element: _Element, order: str, first_length: Callable[[np.dtype, str], int]) -> np.dtype:
    """Return the type of a row; first_length (type of what stands before it, type of the number) reads a length."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for kind, *more in element.properties:
        if kind == "list":
            length_kind, item_kind = (order + _TYPES[name] for name in more[:2])
            length = first_length(np.dtype(fields), length_kind)
            fields += [(_LENGTH_OF + more[-1], length_kind), (more[-1], item_kind, (length,))]
        else:
            fields.append((more[-1], order + _TYPES[kind]))
    return np.dtype(fields)


def _numbers(record: np.dtype) -> int:
    return sum(int(np.prod(record[name].shape)) for name in record.names or ())


def _triangles(faces: NDArray[np.void], points: int) -> Triangles:
    name = next(name for name in _FACE_LISTS if name in (faces.dtype.names or ()))
    corners = faces[name].astype(np.int32)
    if corners.shape[1] < 3 or corners.min() < 0 or corners.max() >= points:
        raise ValueError("a face has a corner that is no vertex")
    fans = [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
    return np.concatenate(fans)
