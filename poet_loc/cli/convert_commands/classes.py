"""poet-loc convert classes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.data.class_lists import ClassList, write_class_files


@dataclass(frozen=True)
class Arguments:
    """Write the class and symmetry files of YCB-V or LM-O, as the official code reads them."""

    name: Annotated[ClassList, tyro.conf.Positional]
    """Data set."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder to write into."""


def execute(arguments: Arguments) -> None:
    """Write the files and name them."""
    print(*write_class_files(arguments.name, arguments.out))
