"""poet-loc localize: object poses and a landmark map become camera poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from landmarks.localize import LocalizeOptions
from poet_loc.cli.arguments import Flat, LogFolder
from poet_loc.cli.estimates import StageOptions, estimate_log, steps
from poet_loc.cli.run import show
from poet_loc.cli.run_folder import WRITING_STEPS, write_run
from poet_loc.cli.terminal import progress
from poet_loc.cli.unread import refuse_unread_by_solver
from poet_loc.io.log_folder import read_log
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class Arguments:
    """Object poses and a landmark map become camera poses by one mode of the solver."""

    log: LogFolder
    """The log folder."""
    out: Path
    """The run folder to write."""
    options: Flat[LocalizeOptions] = field(default_factory=LocalizeOptions)
    pictures: bool = True
    """Draw the figures and write the recording for rerun."""
    paper: bool = False
    """Write the figures as vector PDF, too: 8 pt, as wide as two columns of a paper."""
    overwrite: bool = False
    """Replace a run folder that has results."""


def execute(arguments: Arguments) -> None:
    """Localise, print the table and name the files."""
    options = arguments.options
    with whole_folder(arguments.out, arguments.overwrite, inputs=[arguments.log]) as folder:
        log = read_log(arguments.log, options.detections)
        name, _ = log.detections(options.detections)
        refuse_unread_by_solver(options, [log], (options.mode,), (name,))
        with progress(steps((options.mode,), ()) + WRITING_STEPS) as report:
            stages = StageOptions(solver=options)
            estimates = estimate_log(log, options.detections, stages, report, (options.mode,), (), strict=True)
            write_run(folder, estimates, arguments, report, arguments.pictures, arguments.paper)
    show(estimates, arguments.out)
