"""poet-loc view: open the recordings of runs in rerun's viewer."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro

from poet_loc.cli.arguments import refuse_overwrite_without
from poet_loc.core.input_error import InputError


@dataclass(frozen=True)
class Arguments:
    """Open the recording of a run in rerun's viewer; several runs are laid side by side in one recording."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folders, or .rrd files."""
    web: bool = False
    """Serve the viewer to a browser on this machine (127.0.0.1 only) instead of opening a window."""
    save: Path | None = None
    """Write the comparison of several runs to this .rrd file instead of opening it."""
    overwrite: bool = False
    """Replace the file of --save."""


def execute(arguments: Arguments) -> None:
    """Start rerun and wait until it is closed, or write the comparison."""
    recordings = [_recording(run) for run in arguments.runs]
    if not recordings:
        raise InputError("no run was named", fix="poet-loc view RUN [RUN ..]")
    refuse_overwrite_without(arguments.save, "--save", arguments.overwrite)
    if arguments.save is not None and arguments.web:
        raise InputError("--save opens nothing, --web does", fix="leave out one of them")
    if arguments.save is not None:
        _save(arguments, recordings)
        return
    if len(recordings) == 1:
        _open(recordings[0], arguments.web)
        return
    with TemporaryDirectory() as folder:
        comparison = Path(folder) / "comparison.rrd"
        _compare(arguments.runs, recordings, comparison)
        _open(comparison, arguments.web)


def _save(arguments: Arguments, recordings: Sequence[Path]) -> None:
    out = arguments.save
    assert out is not None
    if len(recordings) < 2:
        raise InputError("--save writes a comparison, which takes two runs", fix="name another run")
    if out.exists() and not arguments.overwrite:
        raise InputError("is there already", path=out, fix="choose another file or add --overwrite")
    if any(out.resolve() == each.resolve() for each in recordings):
        raise InputError("is one of the recordings to be compared", path=out, fix="choose another file")
    partial = out.with_name(f".{out.name}.part")
    try:
        _compare(arguments.runs, recordings, partial)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    print(out)


def _compare(runs: Sequence[Path], recordings: Sequence[Path], out: Path) -> None:
    from poet_loc.report.rerun_comparison import write_comparison

    write_comparison(dict(zip(run_names(runs), recordings, strict=True)), out)


def run_names(runs: Sequence[Path]) -> list[str]:
    """Return a name for each run: as much of the end of its path as tells them apart.

    Raises InputError for a run that is named twice.
    """
    parts = [Path(str(run.resolve()).removesuffix(".rrd")).parts[1:] for run in runs]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["_".join(each[-length:]) for each in parts]
        if len(set(names)) == len(names):
            return ["".join(c if c.isalnum() or c in "_-." else "_" for c in name) for name in names]
    raise InputError("a run is named twice", fix="name each run once")


def _open(recording: Path, web: bool) -> None:
    place = ["--bind", "127.0.0.1"]  # by itself the window, too, listens on every interface
    place += ["--web-viewer"] if web else []
    status = subprocess.call([_program(), *place, str(recording)])
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
