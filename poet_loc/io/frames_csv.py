"""frames.csv: the stamp, number and image of each camera frame."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Stamps
from poet_loc.io.input_text import read_text
from poet_loc.io.whole_folder import write_whole_file

_HEADER = ["timestamp_ns", "frame", "image"]


@dataclass(frozen=True)
class Frames:
    """Camera frames in order of time."""

    stamps_ns: Stamps
    frames: NDArray[np.int64]
    images: tuple[str, ...]
    """Path of each image, relative to the log's folder, or any name of it."""

    def __len__(self) -> int:
        return len(self.stamps_ns)


def read_frames(path: str | Path) -> Frames:
    """Read frames.  Raises InputError, with the line, for a malformed row and stamps that do not increase."""
    reader = csv.reader(read_text(path).splitlines())
    header = next(reader)
    if [cell.strip() for cell in header] != _HEADER:
        raise InputError(f"the header is {','.join(header)!r}", path=path, line=1, fix=f"write {','.join(_HEADER)}")
    stamps, frames, images = [], [], []
    for row in reader:
        if not row:
            continue
        try:
            stamp, frame, image = row
            stamps.append(int(np.int64(int(stamp))))
            frames.append(int(np.int64(int(frame))))
            images.append(image.strip())
        except (ValueError, OverflowError):
            fix = "a row is: whole nanoseconds, whole number, image"
            raise InputError("is no row of frames", path=path, line=reader.line_num, fix=fix) from None
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            what = "the stamp is there twice" if stamps[-1] == stamps[-2] else "the stamp goes backwards"
            raise InputError(what, path=path, line=reader.line_num, fix="sort the rows by time, one per frame")
    if not stamps:
        raise InputError("has no rows", path=path, fix="give a file with data")
    return Frames(np.array(stamps, np.int64), np.array(frames, np.int64), tuple(images))


def write_frames(path: str | Path, frames: Frames) -> None:
    """Write frames."""
    rows = zip(frames.stamps_ns.tolist(), frames.frames.tolist(), map(_quoted, frames.images), strict=True)
    write_whole_file(path, [",".join(_HEADER) + "\n", *(f"{stamp},{frame},{image}\n" for stamp, frame, image in rows)])


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if set(text) & {",", '"'} else text
