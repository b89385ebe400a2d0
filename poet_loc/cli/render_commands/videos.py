"""poet-loc render videos."""

from __future__ import annotations

from dataclasses import dataclass

from poet_loc.cli.arguments import Flat
from poet_loc.videos import VideoOptions, render_videos


@dataclass(frozen=True)
class Arguments:
    """Hand-held videos of the household world as log folders, with IMU, calibration, landmarks and ground truth."""

    options: Flat[VideoOptions]


def execute(arguments: Arguments) -> None:
    """Render and list the log folders."""
    for folder in render_videos(arguments.options):
        print(folder)
