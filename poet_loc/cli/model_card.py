"""poet-loc model-card: what a checkpoint does on the rendered test videos."""

from __future__ import annotations

from dataclasses import dataclass

from poet_loc.cli.arguments import Flat
from poet_loc.train.model_card import MeasureOptions, card_table, measure


@dataclass(frozen=True)
class Arguments:
    """Run a checkpoint over rendered videos and print the figures of its model card."""

    options: Flat[MeasureOptions]


def execute(arguments: Arguments) -> None:
    """Measure and print Markdown."""
    print(card_table(measure(arguments.options)))
