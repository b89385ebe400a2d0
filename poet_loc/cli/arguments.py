"""How the fields of options become arguments of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from poet_loc.core.input_error import InputError

Options = TypeVar("Options")

Flat = Annotated[Options, tyro.conf.arg(name="")]
"""Options whose fields stand on the command line without a prefix."""

LogFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
"""The folder of a log."""

OutFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
"""The folder that a conversion writes."""


def refuse_overwrite_without(target: Path | None, flag: str, overwrite: bool) -> None:
    """Raise InputError where --overwrite is given and the file or folder that it is about is not."""
    if overwrite and target is None:
        raise InputError(f"--overwrite changes nothing without {flag}", fix="leave it out")


def refuse_twice(logs: Sequence[Path]) -> None:
    """Raise InputError where no log is named, or one twice: its frames would count as those of two."""
    if not logs:
        raise InputError("no log was named", fix="name one folder or several")
    for k, path in enumerate(logs):
        if path.resolve() in {other.resolve() for other in logs[:k]}:
            raise InputError(
                "is named twice", path=path, fix="its errors would count as those of two logs: name it once"
            )
