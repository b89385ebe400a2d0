"""poet-loc convert to-mcap."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log, read_log_files
from poet_loc.io.mcap_log import write_mcap
from poet_loc.io.tum import read_tum


@dataclass(frozen=True)
class Arguments:
    """A log or single trajectories become an MCAP file that Foxglove, rerun and ROS 2 open."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """A log or run folder, .tum files, or both; what a folder has of a log's files is written."""
    out: Path
    """The .mcap file to write."""
    overwrite: bool = False
    """Replace a file that is there."""


def execute(arguments: Arguments) -> None:
    """Convert and list the topics."""
    log, further = Log(arguments.out), dict[str, Trajectory]()
    for source in arguments.sources:
        if source.is_dir():
            log = read_log_files(source)
        else:
            further[f"/trajectories/{source.stem}"] = read_tum(source)
    for topic, messages in write_mcap(arguments.out, log, further, arguments.overwrite).items():
        print(f"{topic}  {messages}")
