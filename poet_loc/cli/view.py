"""poet-loc view: open the recordings of runs in rerun's viewer."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.core.input_error import InputError


@dataclass(frozen=True)
class Arguments:
    """Open the recording of one run or several in rerun's viewer."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folders, or .rrd files."""
    web: bool = False
    """Serve the viewer to a browser on this machine (127.0.0.1 only) instead of opening a window."""


def execute(arguments: Arguments) -> None:
    """Start rerun and wait until it is closed."""
    recordings = [_recording(run) for run in arguments.runs]
    if not recordings:
        raise InputError("no run was named", fix="poet-loc view RUN")
    place = ["--bind", "127.0.0.1"]  # by itself the window, too, listens on every interface
    place += ["--web-viewer"] if arguments.web else []
    status = subprocess.call([_program(), *place, *map(str, recordings)])
    if status:
        raise InputError(
            f"rerun ended with status {status}", fix="without a display use --web, or open the .rrd file elsewhere"
        )


def _recording(run: Path) -> Path:
    recording = run if run.suffix == ".rrd" else run / "recording.rrd"
    if not recording.is_file():
        raise InputError("has no recording", path=run, fix="make one with poet-loc run LOG --out RUN")
    return recording


def _program() -> str:
    beside = Path(sys.executable).parent / "rerun"
    program = str(beside) if beside.is_file() else shutil.which("rerun")
    if program is None:
        raise InputError("the rerun viewer is not installed", fix="pip install rerun-sdk")
    return program
