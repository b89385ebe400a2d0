"""Rows of a text file that the strict readers refuse: everything that can be read, and all that is wrong with it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.check.finding import Evidence, Finding
from poet_loc.core.input_error import InputError
from poet_loc.io.input_text import read_text

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SHOWN_LINES = 5
_INT64 = np.iinfo(np.int64)


@dataclass(frozen=True)
class Rows:
    """Numbers by column, and the line that each row came from."""

    path: Path
    lines: NDArray[np.int64]
    integers: NDArray[np.int64]
    """(N, I)"""
    numbers: Array
    """(N, F)"""

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, index: Mask | NDArray[np.intp]) -> Rows:
        return replace(self, lines=self.lines[index], integers=self.integers[index], numbers=self.numbers[index])

    def finding(self, check: str, bad: Mask, what: str, fix: str, **evidence: float | int | str) -> Finding:
        """Return a finding about some rows, with the first of their lines."""
        lines = shown_lines(self.lines[bad].tolist())
        counted = {"rows": int(bad.sum()), "of": len(bad), "lines": lines, **evidence}
        return Finding(check, "error", self.path.name, what, fix, counted, repaired_in_reading=True)


def shown_lines(lines: Sequence[int]) -> str:
    """Return the first few line numbers as text."""
    more = ", .." if len(lines) > _SHOWN_LINES else ""
    return ", ".join(map(str, lines[:_SHOWN_LINES])) + more


def read_csv_rows(
    path: Path, integers: Sequence[str], numbers: Sequence[str], optional: Sequence[str] = ()
) -> tuple[Rows, bool, dict[str, str], list[Finding]]:
    """Return the rows, whether the optional columns are there, the units in the header and what is wrong.

    Raises InputError where a column is missing or there is nothing to read.
    """
    lines = read_text(path).split("\n")
    cells = [re.fullmatch(r"#?\s*(\w*)\s*(?:\[(.*)\])?", cell.strip()) for cell in lines[0].split(",")]
    names = [cell.group(1) if cell else "" for cell in cells]
    units = {cell.group(1): cell.group(2).strip() for cell in cells if cell and cell.group(2)}
    has_optional = bool(optional) and all(name in names for name in optional)
    wanted = [*integers, *numbers, *(optional if has_optional else ())]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise InputError(f"column {missing[0]} is missing", path=path, line=1, fix=f"the header is {','.join(wanted)}")
    picked = [names.index(name) for name in wanted]
    split = ((number, text.split(",")) for number, text in enumerate(lines[1:], start=2) if text.strip())
    rows, found = _parsed(path, split, len(names), picked, len(integers), _whole_number)
    return rows, has_optional, units, found


def read_plain_rows(path: Path, columns: int) -> tuple[Rows, list[Finding]]:
    """Return rows separated by blanks, the first column a time in seconds turned into nanoseconds."""
    lines = enumerate(read_text(path).split("\n"), start=1)
    split = ((number, text.split("#")[0].split()) for number, text in lines if text.split("#")[0].strip())
    return _parsed(path, split, columns, list(range(columns)), 1, _nanoseconds)


def _parsed(path, split: Iterable[tuple[int, list[str]]], width, picked, count, whole) -> tuple[Rows, list[Finding]]:  # type: ignore[no-untyped-def]
    lines, integers, numbers, bad = [], [], [], []
    for number, cells in split:
        try:
            if len(cells) != width:
                raise ValueError
            values = [cells[k].strip() for k in picked]
            integers.append([whole(value) for value in values[:count]])
            numbers.append([float(value) for value in values[count:]])
            lines.append(number)
        except (ValueError, InvalidOperation):
            del integers[len(lines) :], numbers[len(lines) :]
            bad.append(number)
    if not lines:
        raise InputError("has no row that can be read", path=path, fix="see docs/formats.md")
    rows = Rows(path, np.array(lines), np.array(integers, np.int64), np.array(numbers, float))
    if not bad:
        return rows, []
    evidence: Evidence = {"rows": len(bad), "of": len(lines) + len(bad), "lines": shown_lines(bad)}
    what = f"rows cannot be read: {width} numbers belong on each"
    return rows, [Finding("rows", "error", path.name, what, "leave them out", evidence, repaired_in_reading=True)]


def _whole_number(text: str) -> int:
    value = int(text)
    if not _INT64.min <= value <= _INT64.max:
        raise ValueError
    return value


def _nanoseconds(text: str) -> int:
    seconds = Decimal(text)
    if not seconds.is_finite() or abs(seconds) > 9_223_372_036:
        raise ValueError
    return int((seconds * 1_000_000_000).to_integral_value())


def without_nan(rows: Rows, columns: slice) -> tuple[Rows, list[Finding]]:
    """Return the rows whose numbers are finite."""
    bad: Mask = np.asarray(~np.isfinite(rows.numbers[:, columns]).all(axis=1))
    found = [rows.finding("not-finite", bad, "numbers are NaN or infinite", "leave such rows out")] if bad.any() else []
    return rows[~bad], found


def with_unit_quaternions(rows: Rows, columns: slice) -> tuple[Rows, list[Finding]]:
    """Return the rows with normalised quaternions, without zero ones."""
    q = rows.numbers[:, columns]
    norm = np.linalg.norm(q, axis=1)
    zero, off = norm == 0, (np.abs(norm - 1.0) > 0.01) & (norm > 0)
    found = []
    if zero.any():
        what = "quaternions are zero: a row without a pose is no pose"
        found.append(rows.finding("quaternion-norm", zero, what, "leave rows without a pose out"))
    if off.any():
        what = "quaternions have a norm other than 1"
        fix = "normalise them; a norm far from 1 points at swapped or shifted columns"
        norms = {"median_norm": round(float(np.median(norm[off])), 4)}
        found.append(rows.finding("quaternion-norm", off, what, fix, **norms))
    numbers = rows.numbers.copy()
    numbers[:, columns] = q / np.where(zero, 1.0, norm)[:, None]
    return replace(rows, numbers=numbers)[~zero], found


def in_order(rows: Rows, keys: NDArray[np.int64] | None = None) -> tuple[Rows, list[Finding]]:
    """Return the rows sorted by stamp, each stamp once; with keys (N, K) once for each key."""
    stamps, found = rows.integers[:, 0], []
    groups = np.zeros(len(rows), np.intp) if keys is None else np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    by_group = np.lexsort((np.arange(len(rows)), groups))
    backwards = np.zeros(len(rows), bool)
    same = groups[by_group][1:] == groups[by_group][:-1]
    step = np.diff(stamps[by_group])
    backwards[by_group[1:]] = same & (step < 0)
    if backwards.any():
        worst = float(-step[same].min()) / 1e9
        what = "stamps go backwards"
        fix = "sort the rows by time; if the clock was set while recording, cut the log there"
        found.append(rows.finding("stamps-backward", backwards, what, fix, largest_step_back_s=worst))
    order = np.lexsort((np.arange(len(rows)), groups, stamps))
    s, g = stamps[order], groups[order]
    duplicate = np.zeros(len(rows), bool)
    duplicate[order[1:]] = (s[1:] == s[:-1]) & (g[1:] == g[:-1])
    if duplicate.any():
        what = "stamps are there twice"
        fix = "keep one row per stamp; a driver that repeats its last sample writes such rows"
        found.append(rows.finding("stamps-duplicate", duplicate, what, fix))
    return rows[order][~duplicate[order]], found
