"""poet-loc run: a log goes through every stage."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from poet_loc.cli.arguments import Flat, LogFolder
from poet_loc.cli.estimates import Estimates, StageOptions, estimate_log, steps
from poet_loc.cli.noise_file import with_noise_from
from poet_loc.cli.run_folder import WRITING_STEPS, named_files, write_run
from poet_loc.cli.terminal import print_tables, progress
from poet_loc.core.input_error import InputError
from poet_loc.io.log_folder import Log, read_log
from poet_loc.io.whole_folder import whole_folder
from poet_loc.report.error_tables import Block, consistency_table, error_table
from poet_loc.report.summary import to_summary


@dataclass(frozen=True)
class Arguments:
    """Localise in all modes, fuse with all estimators, evaluate, draw and record; what the log lacks is left out."""

    log: LogFolder
    """The log folder."""
    out: Path
    """The run folder to write."""
    detections: str | None = None
    """NAME of object_poses_NAME.csv; without it object_poses.csv, or the only one there is."""
    noise_from: Path | None = None
    """Noise and bias of the detections from this file, as fit-noise writes it."""
    pictures: bool = True
    """Draw the figures and write the recording for rerun."""
    overwrite: bool = False
    """Replace a run folder that has results."""
    options: Flat[StageOptions] = field(default_factory=StageOptions)


def execute(arguments: Arguments) -> None:
    """Run all stages, print the table and name the files."""
    fusion, default = with_noise_from(arguments.noise_from, arguments.options.fusion), StageOptions().fusion
    if (fusion.estimator, fusion.measurements) != (default.estimator, default.measurements):
        raise InputError("run fuses with all estimators", fix="poet-loc fuse takes one --estimator and --measurements")
    with whole_folder(arguments.out, arguments.overwrite, inputs=[arguments.log]) as folder:
        log = read_log(arguments.log, arguments.detections)
        stages = replace(arguments.options, fusion=fusion)
        estimates = run_stages(log, arguments.detections, stages, folder, arguments, arguments.pictures)
    show(estimates, arguments.out)


def run_stages(
    log: Log, detections: str | None, options: StageOptions, folder: Path, asked: Any, pictures: bool
) -> Estimates:
    """Take a log through every stage and write the run into an existing folder."""
    with progress(steps() + WRITING_STEPS) as report:
        estimates = estimate_log(log, detections, options, report)
        write_run(folder, estimates, asked, report, pictures)
    return estimates


def show(estimates: Estimates, out: Path) -> None:
    """Print the tables of a run and name its files."""
    if estimates.evaluation is not None:
        blocks = [Block(to_summary(estimates.evaluation))]
        print_tables([table for table in (error_table(blocks), consistency_table(blocks)) if table.rows])
        print()
    print("\n".join(named_files(out)))
