"""How the fields of options become arguments of the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeVar

import tyro

Options = TypeVar("Options")

Flat = Annotated[Options, tyro.conf.arg(name="")]
"""Options whose fields stand on the command line without a prefix."""

LogFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
"""The folder of a log."""

OutFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
"""The folder that a conversion writes."""
