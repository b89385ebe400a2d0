"""poet-loc convert to-euroc."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.core.input_error import InputError
from poet_loc.io.convert_euroc import write_euroc_trajectory
from poet_loc.io.tum import read_tum


@dataclass(frozen=True)
class Arguments:
    """A trajectory becomes a csv file as EuRoC's ground truth is one."""

    trajectory: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TUM")]
    """TUM file."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CSV")]
    """The file to write."""
    overwrite: bool = False
    """Replace a file that is there."""


def execute(arguments: Arguments) -> None:
    """Convert."""
    if arguments.out.exists() and not arguments.overwrite:
        raise InputError("is there already", path=arguments.out, fix="choose another name or pass --overwrite")
    write_euroc_trajectory(arguments.out, read_tum(arguments.trajectory))
    print(arguments.out)
