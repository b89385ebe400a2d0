"""poet-loc convert kitti."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.io.convert_trajectory import ConvertTrajectoryOptions, convert_kitti


@dataclass(frozen=True)
class Arguments:
    """KITTI poses and their stamps become camera poses or ground truth of a log."""

    poses: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="POSES")]
    """One 3x4 matrix a line."""
    times: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TIMES")]
    """times.txt: seconds, one a line."""
    out: OutFolder
    options: Flat[ConvertTrajectoryOptions] = field(default_factory=ConvertTrajectoryOptions)


def execute(arguments: Arguments) -> None:
    """Convert and say where."""
    convert_kitti(arguments.poses, arguments.times, arguments.out, arguments.options)
    print(f"{arguments.out}: {arguments.options.role}")
