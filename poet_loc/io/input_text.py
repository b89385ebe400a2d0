"""The text of a user's file, or one line that says why there is none."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from poet_loc.core.input_error import InputError


def read_text(path: str | Path) -> str:
    """Return the text of a UTF-8 file with plain newlines.  Raises InputError where it is missing, empty or binary."""
    with _readable(path):
        text = Path(path).read_text(encoding="utf-8-sig")
    if not text.strip():
        raise InputError("is empty", path=path, fix="give a file with data")
    return text


def first_line(path: str | Path) -> str:
    """Return the first line without its newline.  Raises InputError as `read_text` does."""
    with _readable(path), open(path, encoding="utf-8-sig") as file:
        line = file.readline()
    if not line.strip():
        return read_text(path).split("\n", 1)[0]
    return line.rstrip("\n")


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.  Raises InputError with the line where it is no JSON."""
    text = read_text(path)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"is no JSON: {error.msg}", path=path, line=error.lineno, fix="correct the file") from error


def line_of(text: str, pattern: str, occurrence: int = 0) -> int | None:
    """Return the line number, from 1, where a regular expression matches for the n-th time (from 0)."""
    for index, match in enumerate(re.finditer(pattern, text)):
        if index == occurrence:
            return text.count("\n", 0, match.start()) + 1
    return None


@contextmanager
def _readable(path: str | Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise InputError("does not exist", path=path, fix="check the path") from error
    except IsADirectoryError as error:
        raise InputError("is a folder where a file belongs", path=path, fix="check the path") from error
    except UnicodeDecodeError as error:
        raise InputError("is no UTF-8 text", path=path, fix="save it as plain text") from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path, fix="check the path") from error
