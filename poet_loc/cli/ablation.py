"""poet-loc ablation: what each part of the pose network is worth, on the rendered world."""

from __future__ import annotations

from dataclasses import dataclass

from poet_loc.cli.arguments import Flat
from poet_loc.train.ablation import AblationOptions, ablate, ablation_table


@dataclass(frozen=True)
class Arguments:
    """Train the paper's networks and ours with equal small budgets and print the table; run it again to go on."""

    options: Flat[AblationOptions]


def execute(arguments: Arguments) -> None:
    """Train what is missing and print Markdown."""
    print(ablation_table(ablate(arguments.options)))
