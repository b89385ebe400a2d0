"""Text files of numbers: whole columns at C speed, and the line of a row once something is wrong."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from reprlib import repr as shortened
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from poet_loc.core.input_error import InputError
from poet_loc.io.input_text import first_line, read_text
from poet_loc.io.whole_folder import write_whole_file

Array = NDArray[np.float64]

_STAMPS = "write stamps as whole nanoseconds: seconds times 1e9"


@dataclass(frozen=True)
class NumberTable:
    """The columns of a file, and how its lines are counted."""

    path: Path
    columns: NDArray[Any]
    header_lines: int = 1
    comments: str | None = None

    def __len__(self) -> int:
        return len(self.columns)

    def __contains__(self, name: str) -> bool:
        return name in (self.columns.dtype.names or ())

    def __getitem__(self, name: str) -> NDArray[Any]:
        return np.ascontiguousarray(self.columns[name])

    def stack(self, names: Sequence[str]) -> Array:
        """Return float columns side by side, (N, len(names))."""
        return np.column_stack([self.columns[name] for name in names])

    def line(self, row: int) -> int:
        """Return the line number, from 1, of a row."""
        numbered = _numbered_rows(self.path, self.header_lines, self.comments)
        return next(itertools.islice(numbered, row, None))[0]

    def refuse(self, bad_rows: ArrayLike, what: str, fix: str) -> None:
        """Raise InputError for the first bad row, if there is one.  bad_rows (N,) bool."""
        bad = np.flatnonzero(bad_rows)
        if bad.size:
            raise InputError(what, path=self.path, line=self.line(int(bad[0])), fix=fix)

    def refuse_not_finite(self, names: Sequence[str]) -> None:
        """Raise InputError for the first NaN or infinite number of these columns."""
        for name in names:
            self.refuse(~np.isfinite(self.columns[name]), f"column {name} is NaN or infinite", "leave such rows out")

    def refuse_disorder(self, stamps: NDArray[np.int64], fix: str) -> None:
        """Raise InputError for the first stamp that is not later than the one before."""
        earlier, later = stamps[:-1], stamps[1:]
        bad = np.concatenate([[False], later <= earlier])
        if bad.any():
            row = int(np.argmax(bad))
            what = "the stamp is there twice" if stamps[row] == stamps[row - 1] else "the stamp goes backwards"
            self.refuse(bad, what, fix)


def read_number_csv(
    path: str | Path,
    required: Mapping[str, type],
    optional: Mapping[str, type] | None = None,
    *,
    further_columns: bool = False,
    column_name: Callable[[str], str] = str,
) -> NumberTable:
    """Read a csv file with a header into typed columns; int columns are exact over the whole int64 range.

    The order of the columns is free. Raises InputError for a missing, empty or malformed file, for a missing column,
    for an optional group that is there in part, and for an unknown column unless further_columns is set.
    column_name turns a header cell into a name of required or optional.
    """
    path, optional = Path(path), dict(optional or {})
    header = first_line(path)
    _refuse_other_separators(path, header)
    names = [column_name(cell.strip()) for cell in header.split(",")]
    wanted = dict(required) | (optional if any(name in names for name in optional) else {})
    _check_header(path, names, wanted, optional, further_columns)
    picked = [name for name in names if name in wanted]
    dtype = np.dtype([(name, np.dtype(wanted[name])) for name in picked])
    usecols = [names.index(name) for name in picked] if len(picked) < len(names) else None
    return _load(path, dtype, ",", header_lines=1, comments=None, usecols=usecols, cells_per_row=len(names))


def read_number_rows(path: str | Path, columns: Sequence[tuple[str, Any]], comments: str) -> NumberTable:
    """Read whitespace-separated rows without a header into columns of numpy types.  Raises InputError as above."""
    path = Path(path)
    first_line(path)
    dtype = np.dtype(list(columns))
    return _load(path, dtype, None, header_lines=0, comments=comments, usecols=None, cells_per_row=len(columns))


def write_csv(path: str | Path, header: Sequence[str], columns: Sequence[ArrayLike]) -> None:
    """Write equal-length columns; floats in the shortest form that reads back exactly."""
    cells = [_cells(column) for column in columns]
    rows = (",".join(row) + "\n" for row in zip(*cells, strict=True))
    write_whole_file(path, itertools.chain([",".join(header) + "\n"], rows))


def _cells(column: ArrayLike) -> Iterable[str]:
    values = np.asarray(column)
    return map(repr if values.dtype.kind == "f" else str, values.tolist())


def _refuse_other_separators(path: Path, header: str) -> None:
    for character, name in ((";", "semicolons"), ("\t", "tabs")):
        if "," not in header and character in header:
            raise InputError(f"the columns are separated by {name}", path=path, line=1, fix="separate them by commas")


def _check_header(
    path: Path, names: list[str], wanted: Mapping[str, type], optional: Mapping[str, type], further_columns: bool
) -> None:
    expected = f"the header is: {','.join(wanted)}"
    missing = [name for name in wanted if name not in names]
    if missing:
        raise InputError(f"column {missing[0]} is missing", path=path, line=1, fix=expected)
    unknown = [name for name in names if name not in wanted and name not in optional]
    if unknown and not further_columns:
        raise InputError(f"unknown column {unknown[0]!r}", path=path, line=1, fix=expected)
    twice = [name for name in wanted if names.count(name) > 1]
    if twice:
        raise InputError(f"column {twice[0]} is there twice", path=path, line=1, fix=expected)


def _load(
    path: Path,
    dtype: np.dtype[Any],
    delimiter: str | None,
    *,
    header_lines: int,
    comments: str | None,
    usecols: list[int] | None,
    cells_per_row: int,
) -> NumberTable:
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            columns = np.loadtxt(
                path,
                dtype,
                comments=comments,
                delimiter=delimiter,
                skiprows=header_lines,
                usecols=usecols,
                ndmin=1,
                encoding="utf-8-sig",
            )
    except (ValueError, OverflowError) as error:
        _explain(path, dtype, delimiter, header_lines, comments, usecols, cells_per_row, error)
    if len(columns) == 0:
        raise InputError("has no rows", path=path, fix="give a file with data")
    if usecols is not None:  # numpy then does not count the cells itself
        _refuse_other_cell_counts(path, delimiter, header_lines, comments, cells_per_row)
    return NumberTable(path, columns, header_lines, comments)


def _explain(
    path: Path,
    dtype: np.dtype[Any],
    delimiter: str | None,
    header_lines: int,
    comments: str | None,
    usecols: list[int] | None,
    cells_per_row: int,
    error: Exception,
) -> NoReturn:
    _refuse_other_cell_counts(path, delimiter, header_lines, comments, cells_per_row)
    names = dtype.names or ()
    for line, row in _numbered_rows(path, header_lines, comments):
        cells = row.split(delimiter)
        for name, cell in zip(names, [cells[k] for k in usecols] if usecols else cells, strict=True):
            what = _wrong_cell(cell.strip(), dtype[name])
            if what:
                fix = _STAMPS if name.startswith("timestamp") and "." in cell else "correct or leave out the row"
                raise InputError(f"column {name} {what}", path=path, line=line, fix=fix)
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        if text and not text.strip():  # numpy passes over empty lines only
            raise InputError("holds blanks only", path=path, line=line, fix="delete the line")
    raise InputError(f"cannot be read: {error}", path=path, fix="save it as plain text, one row a line") from error


def _refuse_other_cell_counts(
    path: Path, delimiter: str | None, header_lines: int, comments: str | None, expected: int
) -> None:
    for line, row in _numbered_rows(path, header_lines, comments):
        if (row.count(delimiter) + 1 if delimiter else len(row.split())) != expected:
            count = len(row.split(delimiter))
            fix = f"separate the values by {'commas' if delimiter else 'spaces'}"
            raise InputError(f"{count} values where {expected} belong", path=path, line=line, fix=fix)


def _wrong_cell(cell: str, dtype: np.dtype[Any]) -> str | None:
    """Return what is wrong with a cell: numpy's own grammar, one cell at a time."""
    if not cell:
        return "is empty"
    if dtype.kind == "S":
        return None
    try:
        np.loadtxt([cell], dtype, delimiter="\x1f", comments=None)  # which no cell holds
    except (ValueError, OverflowError):
        return f"holds {shortened(cell)} where a {'whole number of 64 bits' if dtype.kind == 'i' else 'number'} belongs"
    return None


def _numbered_rows(path: Path, header_lines: int, comments: str | None) -> Iterable[tuple[int, str]]:
    for number, text in enumerate(read_text(path).split("\n"), start=1):
        row = text.split(comments)[0] if comments else text
        if number > header_lines and row.strip():
            yield number, row
