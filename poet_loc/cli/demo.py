"""poet-loc demo: the embedded default from end to end."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from fusion.simulate import SimulationOptions, simulate
from landmarks.options import MODES
from poet_loc.cli.estimates import FUSIONS, StageOptions, estimate_log, refuse_one_estimator, steps
from poet_loc.cli.run import show
from poet_loc.cli.run_folder import WRITING_STEPS, write_run
from poet_loc.cli.terminal import progress
from poet_loc.cli.unread import refuse_unread
from poet_loc.io.log_folder import Log, write_log
from poet_loc.io.whole_folder import whole_folder

DEMO_VIDEO = 12
"""Number of the video that is shown: the first one beyond the twelve test videos."""
_VIDEO_S = 15.0


@dataclass(frozen=True)
class Arguments:
    """A video is rendered, the embedded network sees its objects, and the log goes through every stage: localised,
    fused, evaluated, drawn and recorded; nothing is needed."""

    out: Path = Path("demo")
    """Folder that gets log/, which every other command reads, and run/."""
    simulated: bool = False
    """Instead of images and a network: a minute of a simulated table top, whose object poses are drawn at random."""
    duration_s: float | None = None
    """Length of what is seen, s; none: 15 of video, at 30 images per second, or 60 simulated."""
    seed: int = 0
    """Another seed is another world."""
    pictures: bool = True
    """Draw the figures and write the recording for rerun."""
    paper: bool = False
    """Write the figures as vector PDF, too: 8 pt, as wide as two columns of a paper."""
    overwrite: bool = False
    """Replace a folder that has results."""
    options: StageOptions = field(default_factory=StageOptions)


def execute(arguments: Arguments) -> None:
    """Make the log, run all stages, print the tables and name the files."""
    refuse_one_estimator(arguments.options.fusion)
    place, run = arguments.out / "log", arguments.out / "run"
    with whole_folder(arguments.out, arguments.overwrite) as folder:
        log = replace(_simulated(folder, arguments) if arguments.simulated else _seen(folder, arguments), path=place)
        refuse_unread(arguments.options, [log], MODES, FUSIONS)
    with whole_folder(run) as folder, progress(steps() + WRITING_STEPS) as report:
        estimates = estimate_log(log, None, arguments.options, report)
        write_run(folder, estimates, arguments, report, arguments.pictures, arguments.paper)
    show(estimates, run)
    print(f"\nThe log: {place}\nLook at it: poet-loc view {run}")


def _simulated(folder: Path, arguments: Arguments) -> Log:
    options = SimulationOptions(seed=arguments.seed)
    seconds = options.duration_s if arguments.duration_s is None else arguments.duration_s
    log = simulate(replace(options, duration_s=seconds))
    (folder / "log").mkdir()
    write_log(folder / "log", log)
    return log


def _seen(folder: Path, arguments: Arguments) -> Log:
    from poet_loc.videos import VideoOptions, log_from_pixels

    seconds = _VIDEO_S if arguments.duration_s is None else arguments.duration_s
    video = VideoOptions(folder, duration_s=(seconds, seconds), seed=arguments.seed)
    return log_from_pixels(video, DEMO_VIDEO, folder=folder / "log")
