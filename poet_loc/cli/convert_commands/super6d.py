"""poet-loc convert super6d."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.io.convert_super6d import ConvertSuper6dOptions, convert_super6d


@dataclass(frozen=True)
class Arguments:
    """slam-super-6d's text files, one per object, become the object poses of a log."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the text files."""
    out: OutFolder
    options: Flat[ConvertSuper6dOptions]


def execute(arguments: Arguments) -> None:
    """Convert and say what came out."""
    log = convert_super6d(arguments.folder, arguments.out, arguments.options)
    print(f"{arguments.out}: {len(log.object_poses[arguments.options.name])} object poses")
