"""poet-loc calibrate: variances that agree with the errors on held-out images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from poet_loc.cli.arguments import Flat
from poet_loc.io.whole_folder import not_there
from poet_loc.train.variances import CalibrateOptions


@dataclass(frozen=True)
class Arguments:
    """Scale a network's variances until held-out errors agree with them."""

    options: Flat[CalibrateOptions]
    figure: Path | None = None
    """Reliability figure to write (.png, .pdf)."""


def execute(arguments: Arguments) -> None:
    """Calibrate and say by how much."""
    from poet_loc.train.variances import calibrate

    if arguments.figure is not None:
        not_there(arguments.figure, arguments.options.overwrite)
    found = calibrate(arguments.options)
    before, after = found.gap(found.before), found.gap(found.after)
    print(f"{arguments.options.target}: {found.objects} objects")
    for name, factor in zip(("translation", "rotation"), found.factors, strict=True):
        print(f"  {name}: variances times {factor:.3g}, reliability gap {before[name]:.3f} -> {after[name]:.3f}")
    if arguments.figure is not None:
        from poet_loc.report.reliability_figure import reliability_figure

        reliability_figure(found.levels, found.before, found.after).savefig(arguments.figure)
