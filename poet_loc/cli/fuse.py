"""poet-loc fuse: camera or object poses and a motion source become a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from fusion.options import FuseOptions
from landmarks.options import Mode, SolverOptions
from poet_loc.cli.arguments import Flat, LogFolder
from poet_loc.cli.estimates import StageOptions, estimate_log, fusion_of, steps
from poet_loc.cli.noise_file import with_noise_from
from poet_loc.cli.run import show
from poet_loc.cli.run_folder import WRITING_STEPS, write_run
from poet_loc.cli.terminal import progress
from poet_loc.cli.unread import refuse_unread
from poet_loc.io.log_folder import read_log
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class Arguments:
    """Camera or object poses and an IMU become a trajectory with its sigmas, by one estimator."""

    log: LogFolder
    """The log folder."""
    out: Path
    """The run folder to write."""
    detections: str | None = None
    """NAME of object_poses_NAME.csv; without it object_poses.csv, or the only one there is."""
    mode: Mode = "robust"
    """Mode of the solver whose camera poses are fused by --measurements camera, if the log brings none of its own."""
    options: Flat[FuseOptions] = field(default_factory=FuseOptions)
    noise_from: Path | None = None
    """Noise and bias of the detections from this file, as fit-noise writes it."""
    pictures: bool = True
    """Draw the figures and write the recording for rerun."""
    paper: bool = False
    """Write the figures as vector PDF, too: 8 pt, as wide as two columns of a paper."""
    overwrite: bool = False
    """Replace a run folder that has results."""


def execute(arguments: Arguments) -> None:
    """Fuse, print the table and name the files."""
    options = with_noise_from(arguments.noise_from, arguments.options)
    typed = StageOptions(solver=SolverOptions(mode=arguments.mode), fusion=arguments.options)
    stages = replace(typed, fusion=options)
    named = () if arguments.detections is None else (arguments.detections,)
    with whole_folder(arguments.out, arguments.overwrite, inputs=[arguments.log]) as folder:
        log = read_log(arguments.log, arguments.detections, unmapped=options.estimate.map == "unknown")
        fusions = (fusion_of(options),)
        refuse_unread(typed, [log], (), fusions, named, arguments.noise_from)
        solve = options.measurements == "camera" and log.camera_poses is None
        modes = (arguments.mode,) if solve else ()
        with progress(steps(modes, fusions) + WRITING_STEPS) as report:
            estimates = estimate_log(log, arguments.detections, stages, report, modes, fusions, strict=True)
            write_run(folder, estimates, arguments, report, arguments.pictures, arguments.paper)
    show(estimates, arguments.out)
