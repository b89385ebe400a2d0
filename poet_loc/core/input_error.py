"""The one exception that a user's mistake raises: it ends as one line and exit status 1."""

from __future__ import annotations

from pathlib import Path


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
