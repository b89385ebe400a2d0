"""poet-loc run: a log goes through every stage."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from landmarks.options import MODES
from poet_loc.cli.arguments import Flat, LogFolder
from poet_loc.cli.estimates import FUSIONS, Estimates, Fusion, StageOptions, estimate_log, refuse_one_estimator, steps
from poet_loc.cli.found import found_lines
from poet_loc.cli.noise_file import with_noise_from
from poet_loc.cli.run_folder import WRITING_STEPS, error_tables, named_files, write_run
from poet_loc.cli.terminal import print_tables, progress
from poet_loc.cli.unread import refuse_unread
from poet_loc.io.log_folder import read_log
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class Arguments:
    """Localise in all modes, fuse with all estimators, evaluate, draw and record; what the log lacks is left out."""

    log: LogFolder
    """The log folder."""
    out: Path
    """The run folder to write."""
    detections: str | None = None
    """NAME of object_poses_NAME.csv; without it object_poses.csv, or the only one there is."""
    fusions: tuple[Fusion, ...] = FUSIONS
    """Estimators and what they fuse, one row each."""
    noise_from: Path | None = None
    """Noise and bias of the detections from this file, as fit-noise writes it."""
    pictures: bool = True
    """Draw the figures and write the recording for rerun."""
    paper: bool = False
    """Write the figures as vector PDF, too: 8 pt, as wide as two columns of a paper."""
    overwrite: bool = False
    """Replace a run folder that has results."""
    options: Flat[StageOptions] = field(default_factory=StageOptions)


def execute(arguments: Arguments) -> None:
    """Run all stages, print the table and name the files."""
    fusion = with_noise_from(arguments.noise_from, arguments.options.fusion)
    refuse_one_estimator(fusion)
    with whole_folder(arguments.out, arguments.overwrite, inputs=[arguments.log]) as folder:
        log = read_log(arguments.log, arguments.detections, unmapped=fusion.estimate.map == "unknown")
        named = () if arguments.detections is None else (arguments.detections,)
        refuse_unread(arguments.options, [log], MODES, arguments.fusions, named, arguments.noise_from)
        stages = replace(arguments.options, fusion=fusion)
        with progress(steps(MODES, arguments.fusions) + WRITING_STEPS) as report:
            estimates = estimate_log(log, arguments.detections, stages, report, MODES, arguments.fusions)
            write_run(folder, estimates, arguments, report, arguments.pictures, arguments.paper)
    show(estimates, arguments.out)


def show(estimates: Estimates, out: Path) -> None:
    """Print the tables of a run and name its files."""
    if estimates.evaluation is not None:
        print_tables(error_tables(estimates.evaluation))
        print()
    print("\n".join([*found_lines(estimates), *named_files(out)]))
