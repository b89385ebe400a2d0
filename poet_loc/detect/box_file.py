"""Boxes from another program: csv with image,x1,y1,x2,y2,score,class."""

from __future__ import annotations

import csv
from pathlib import Path

import torch
from torch import Tensor

from poet_loc.core.input_error import InputError

HEADER = ["image", "x1", "y1", "x2", "y2", "score", "class"]


def read_boxes(path: str | Path) -> dict[str, Tensor]:
    """Read boxes by file name of their image, (n, 6) each: x1, y1, x2, y2 (px), score, class from 1.

    Raises InputError, with the line, for a malformed row.
    """
    try:
        lines = Path(path).read_text().splitlines()
    except FileNotFoundError:
        raise InputError("no such file", path=path) from None
    reader = csv.reader(lines)
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
        rows.setdefault(Path(name.strip()).name, []).append([x1, y1, x2, y2, score, label])
    return {name: torch.tensor(found) for name, found in rows.items()}
