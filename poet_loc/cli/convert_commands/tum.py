"""poet-loc convert tum."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.io.convert_tum import ConvertTumOptions, convert_tum


@dataclass(frozen=True)
class Arguments:
    """A camera trajectory in the map's world becomes the camera poses of a log."""

    trajectory: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TUM")]
    """TUM file: t tx ty tz qx qy qz qw."""
    out: OutFolder
    """The log folder to write."""
    options: Flat[ConvertTumOptions] = field(default_factory=ConvertTumOptions)


def execute(arguments: Arguments) -> None:
    """Convert and say what came out."""
    log = convert_tum(arguments.trajectory, arguments.out, arguments.options)
    assert log.camera_poses is not None
    print(f"{arguments.out}: {len(log.camera_poses)} camera poses")
