"""The one exception that a user's mistake raises: it ends as one line and exit status 1."""

from __future__ import annotations

import math
from dataclasses import is_dataclass
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints


class InputError(Exception):
    """A mistake in the user's input, told in one line: where, what, and what to do.

    Anything else that escapes a command is a bug and keeps its traceback.
    """

    def __init__(
        self,
        what: str,
        *,
        path: str | Path | None = None,
        line: int | None = None,
        fix: str | None = None,
    ) -> None:
        self.what, self.path, self.line, self.fix = what, path, line, fix
        where = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        remedy = "" if fix is None else f"; {fix}"
        super().__init__(" ".join(f"{where}{what}{remedy}".split()))


def at_least(least: float, options: object, *names: str) -> None:
    """Raise InputError for a field of an options record that is no number, or below the least that makes sense."""
    for name in names:
        value = getattr(options, name)
        if not isinstance(value, int | float) or not value >= least:
            raise InputError(f"{name.replace('_', '-')} is {value!r}", fix=f"give at least {least:g}")


def processes(name: str, count: int) -> None:
    """Raise InputError for a number of processes that is 0: joblib counts up from 1, or down from -1, all cores."""
    if count == 0:
        raise InputError(f"{name} is 0", fix="give the number of processes, or -1 for one per core")


def within(interval: str, options: object, *names: str) -> None:
    """Raise InputError for a field of an options record outside an interval such as "(0, 1]" or "[0, inf)".

    A field of a record in the record is named with a dot: bias.correlation_rotation_s.
    """
    low, high = (float(end) for end in interval[1:-1].split(","))
    open_low, open_high = interval[0] == "(", interval[-1] == ")"
    least = f"more than {low:g}" if open_low else f"at least {low:g}"
    most = f"less than {high:g}" if open_high else f"at most {high:g}"
    for name in names:
        value = attrgetter(name)(options)
        inside = isinstance(value, int | float) and low <= value <= high
        if not inside or (open_low and value == low) or (open_high and value == high):
            fix = f"give {least}" if math.isinf(high) and value != high else f"give {least} and {most}"
            raise InputError(f"{name.replace('_', '-')} is {value!r}", fix=fix)


def refuse_other_words(options: Any, place: str = "") -> None:
    """Raise InputError for a word that a field of an options record, or of a record in it, does not know.

    The command line sees to that by itself; a program does not. A field that is no record of its type is refused, too.
    """
    for name, kind in _kinds(type(options)).items():  # type: ignore[arg-type]
        value, called = getattr(options, name), f"{place}{name}"
        if get_origin(kind) is Literal and value not in get_args(kind):
            raise InputError(f"{called} is {value!r}", fix=f"choose among {', '.join(map(str, get_args(kind)))}")
        if is_dataclass(kind):
            if not isinstance(value, kind):  # type: ignore[arg-type]
                raise InputError(f"{called} is {value!r}", fix=f"give {kind.__name__}(..)")  # type: ignore[union-attr]
            refuse_other_words(value, f"{called}.")


@lru_cache
def _kinds(record: type) -> dict[str, Any]:
    return get_type_hints(record)
