"""poet-loc convert poet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.io.convert_poet import ConvertPoetOptions, convert_poet


@dataclass(frozen=True)
class Arguments:
    """PoET's results.json becomes the object poses of a log, with the stamps that it lacks."""

    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")]
    """PoET's results.json."""
    out: OutFolder
    """The log folder to write."""
    options: Flat[ConvertPoetOptions]


def execute(arguments: Arguments) -> None:
    """Convert and say what came out."""
    log = convert_poet(arguments.results, arguments.out, arguments.options)
    print(f"{arguments.out}: {len(log.object_poses[arguments.options.name])} object poses")
