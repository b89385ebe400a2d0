"""poet-loc demo: the embedded default from end to end."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from fusion.simulate import SimulationOptions, simulate
from poet_loc.cli.estimates import StageOptions, estimate_log, refuse_one_estimator, steps
from poet_loc.cli.run import show
from poet_loc.cli.run_folder import WRITING_STEPS, write_run
from poet_loc.cli.terminal import progress
from poet_loc.io.log_folder import write_log
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class Arguments:
    """A simulated table-top log is written, localised, fused, evaluated, drawn and recorded; nothing is needed."""

    out: Path = Path("demo")
    """Folder that gets log/, which every other command reads, and run/."""
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
    """Simulate, run all stages, print the tables and name the files."""
    refuse_one_estimator(arguments.options.fusion)
    with whole_folder(arguments.out, arguments.overwrite) as folder, progress(1 + steps() + WRITING_STEPS) as report:
        report.step("simulate")
        log = replace(simulate(SimulationOptions(seed=arguments.seed)), path=arguments.out / "log")
        (folder / "log").mkdir()
        write_log(folder / "log", log)
        estimates = estimate_log(log, None, arguments.options, report)
        (folder / "run").mkdir()
        write_run(folder / "run", estimates, arguments, report, arguments.pictures, arguments.paper)
    show(estimates, arguments.out / "run")
    print(f"\nThe log: {arguments.out / 'log'}\nLook at it: poet-loc view {arguments.out / 'run'}")
