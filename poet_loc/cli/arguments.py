"""How the fields of options become arguments of the command line."""

from __future__ import annotations

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
