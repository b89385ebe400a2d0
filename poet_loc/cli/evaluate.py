"""poet-loc evaluate: one trajectory against another."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat
from poet_loc.cli.terminal import print_tables
from poet_loc.io.tum import read_tum
from poet_loc.report.compare import CompareOptions, compare_trajectories
from poet_loc.report.error_tables import comparison_tables


@dataclass(frozen=True)
class Arguments:
    """Errors of a trajectory against a reference of the same body: per axis, APE and RPE."""

    estimate: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="EST.tum")]
    """TUM file."""
    reference: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REF.tum")]
    """TUM file."""
    options: Flat[CompareOptions] = field(default_factory=CompareOptions)


def execute(arguments: Arguments) -> None:
    """Print the tables."""
    estimate, reference = read_tum(arguments.estimate), read_tum(arguments.reference)
    print_tables(comparison_tables(compare_trajectories(estimate, reference, arguments.options)))
