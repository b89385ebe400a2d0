"""The command line: names the commands, reads their options, and turns a user's mistake into one line.

A command is a module of this package with a frozen dataclass `Arguments` and a function `execute(arguments)`; only the
module of the command that was asked for is imported.
"""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from io import StringIO
from typing import Any

from poet_loc.core.input_error import InputError

COMMANDS = {
    "demo": "the embedded default from end to end: from rendered images to a trajectory with its errors",
    "run": "localise in all modes, fuse with all estimators, evaluate, draw and record",
    "detect": "images, a video or a log become object poses with covariances",
    "train": "a pose network from images with poses",
    "train-refiner": "a refiner for a trained pose network, from images with poses and the objects' models",
    "calibrate": "scale a network's variances until held-out errors agree with them",
    "ablation": "what each part of the pose network is worth: the paper's rows and ours, equally trained",
    "export": "write a pose network as ONNX or OpenVINO",
    "localize": "object poses and a landmark map become camera poses",
    "fuse": "camera or object poses and a motion source become a trajectory with its sigmas",
    "fit-noise": "white noise and biases of detections, from logs with ground truth",
    "evaluate": "errors of a trajectory against a reference, per axis, APE and RPE",
    "evaluate-poses": "object poses against the truth: ADD, ADD-S, their areas, BOP recalls, per class",
    "table": "the localisation table of one log or several: detections x modes",
    "check": "say what looks wrong in a log: units, stamps, conventions, extrinsics, map",
    "compile": "compile the filter once, so that the first run does not wait",
    "convert": "bring data from other formats into a log folder",
    "model-card": "figures of a checkpoint on rendered test videos",
    "render": "images or videos of the rendered household world",
    "simulate": "write a simulated log folder, or run many simulated logs through the estimators",
    "view": "open the recording of a run in rerun",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0, 1 after a user's mistake, 130 after Ctrl-C, 143 when terminated."""
    argv = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _warnings_as_lines(), _termination_tidies_up():
            status = dispatch("poet-loc", COMMANDS, "poet_loc.cli", argv)
            sys.stdout.flush()
            return status
    except InputError as error:
        return _one_line(str(error), 1)
    except _Terminated:
        return _one_line("terminated", 143)
    except KeyboardInterrupt:
        return _one_line("interrupted", 130)
    except BrokenPipeError:
        sys.stdout = StringIO()  # the reader has gone: nothing to flush at exit
        return 0
    except OSError as error:
        if error.filename is None or error.strerror is None:
            raise
        return _one_line(f"{error.filename}: {error.strerror.lower()}", 1)


def dispatch(program: str, commands: Mapping[str, str], package: str, argv: Sequence[str]) -> int:
    """Run the command that argv names, from the module of that name in the package; return its exit status."""
    name = argv[0] if argv else "--help"
    if name in ("-h", "--help"):
        print(_overview(program, commands))
        return 0
    if name == "--version":
        from importlib.metadata import version

        print(f"poet-loc {version('poet-loc')}")
        return 0
    if name not in commands:
        raise InputError(f"unknown command '{name}'", fix=f"one of {', '.join(commands)}")
    module = import_module(f"{package}.{name.replace('-', '_')}")
    if hasattr(module, "COMMANDS"):
        return dispatch(f"{program} {name}", module.COMMANDS, f"{package}.{name}_commands", argv[1:])
    options = read_arguments(f"{program} {name}", module.Arguments, argv[1:])
    return 0 if options is None else module.execute(options) or 0


def read_arguments(program: str, kind: type, argv: Sequence[str]) -> Any:
    """Return the dataclass that the arguments describe, or None where help was asked for and printed."""
    import tyro

    complaint = StringIO()
    stderr, sys.stderr = sys.stderr, complaint
    try:
        return tyro.cli(kind, prog=program, args=list(argv))
    except SystemExit as leaving:
        if leaving.code in (0, None):
            return None
        raise InputError(_unboxed(complaint.getvalue()), fix=f"see {program} --help") from None
    finally:
        sys.stderr = stderr


def _unboxed(text: str) -> str:
    """Return the sentences inside tyro's box, without the frame, its title and the pointer to the help.

    Where the terminal knows ASCII only there is no frame: the title stands above a line of dashes.
    """
    sections: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.startswith(("╭", "╰")):
            continue
        words = line.strip("│ ")
        if words.startswith(("──", "-----")):
            sections.append([])
        else:
            sections[-1].append(words)
    framed = "╭" in text
    sentences = [" ".join(section).strip() for section in (sections if framed else sections[1:])]
    told = [s for s in sentences if s and not s.startswith(("For full helptext", "Argument helptext"))]
    return "; ".join(told) or "these arguments cannot be read"


def _overview(program: str, commands: Mapping[str, str]) -> str:
    width = max(map(len, commands)) + 2
    lines = [f"usage: {program} COMMAND ...", ""]
    lines += [f"  {name:{width}}{what}" for name, what in commands.items()]
    lines += ["", f"{program} COMMAND --help tells the options of a command."]
    return "\n".join(lines)


def _one_line(message: str, status: int) -> int:
    print(f"poet-loc: {message}", file=sys.stderr)
    return status


class _Terminated(KeyboardInterrupt):
    """SIGTERM came, as from kill, timeout or a cluster's queue."""


@contextmanager
def _termination_tidies_up() -> Iterator[None]:
    """Let SIGTERM end the command as Ctrl-C does: what is half-written goes, and so do worker processes."""

    def leave(*_: object) -> None:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():  # where signals cannot be handled
        yield
        return
    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    def show(message: Warning | str, *_: object, **__: object) -> None:
        print(f"poet-loc: warning: {' '.join(str(message).split())}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
