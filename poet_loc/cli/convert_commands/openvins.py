"""poet-loc convert openvins."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.io.convert_trajectory import ConvertTrajectoryOptions, convert_openvins


@dataclass(frozen=True)
class Arguments:
    """A trajectory with the covariance columns of OpenVINS or RPG's tools becomes part of a log."""

    trajectory: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TRAJECTORY")]
    """t tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 Pt23 Pt33."""
    out: OutFolder
    options: Flat[ConvertTrajectoryOptions] = field(default_factory=ConvertTrajectoryOptions)


def execute(arguments: Arguments) -> None:
    """Convert and say where."""
    convert_openvins(arguments.trajectory, arguments.out, arguments.options)
    print(f"{arguments.out}: {arguments.options.role}")
