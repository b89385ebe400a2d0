"""poet-loc convert to-kitti."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.io.kitti import times_beside, write_kitti
from poet_loc.io.tum import read_tum
from poet_loc.io.whole_folder import not_there


@dataclass(frozen=True)
class Arguments:
    """A trajectory becomes KITTI poses, its stamps beside them."""

    trajectory: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TUM")]
    """TUM file."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="POSES")]
    """The file to write; the stamps go to NAME_times.txt."""
    overwrite: bool = False
    """Replace a file that is there."""


def execute(arguments: Arguments) -> None:
    """Convert."""
    for file in (arguments.out, times_beside(arguments.out)):
        not_there(file, arguments.overwrite)
    write_kitti(arguments.out, read_tum(arguments.trajectory))
    print(arguments.out)
