"""Boxes of objects in images: csv with image,x1,y1,x2,y2,score,class."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.io.input_text import read_text
from poet_loc.io.whole_folder import write_whole_file

Array = NDArray[np.float64]

HEADER = ["image", "x1", "y1", "x2", "y2", "score", "class"]


def read_boxes(path: str | Path) -> dict[str, Array]:
    """Read boxes by file name of their image, (n, 6) each: x1, y1, x2, y2 (px), score, class from 1.

    The name is without its folder, unless there are images of one name in several folders.

    Raises InputError, with the line, for a malformed row.
    """
    reader = csv.reader(read_text(path).splitlines())
    header = next(reader, [])
    if [cell.strip() for cell in header] != HEADER:
        raise InputError(f"the header is {','.join(header)!r}", path=path, line=1, fix=f"write {','.join(HEADER)}")
    rows: dict[str, list[list[float]]] = {}
    for row in reader:
        if not row:
            continue
        try:
            name, *cells = row
            x1, y1, x2, y2, score, label = map(float, cells)
        except ValueError:
            raise InputError("is no row of boxes", path=path, line=reader.line_num, fix=",".join(HEADER)) from None
        if not (x2 > x1 and y2 > y1 and label >= 1 and label == int(label)):
            raise InputError("needs x1 < x2, y1 < y2 and a class from 1", path=path, line=reader.line_num)
        rows.setdefault(name.strip(), []).append([x1, y1, x2, y2, score, label])
    found: dict[str, list[list[float]]] = {}
    folders: dict[str, set[Path]] = defaultdict(set)
    for path_of_image in map(Path, rows):
        folders[path_of_image.name] |= {path_of_image.parent} - {Path()}
    for name, values in rows.items():
        short = Path(name).name
        found.setdefault(short if len(folders[short]) < 2 else name, []).extend(values)
    return {name: np.array(values) for name, values in found.items()}


def write_boxes(path: str | Path, boxes: Mapping[str, Array]) -> None:
    """Write boxes (n, 6) by file name of their image."""
    lines = [
        f"{name},{x1:.3f},{y1:.3f},{x2:.3f},{y2:.3f},{score:.5f},{label:.0f}\n"
        for name, rows in boxes.items()
        for x1, y1, x2, y2, score, label in rows.tolist()
    ]
    write_whole_file(path, [",".join(HEADER) + "\n", *lines])
