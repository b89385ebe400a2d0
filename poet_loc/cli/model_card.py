"""poet-loc model-card: what a checkpoint does on the rendered test videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from poet_loc.cli.arguments import Flat
from poet_loc.train.model_card import MeasureOptions, card_table, full_card, measure


@dataclass(frozen=True)
class Arguments:
    """Run a checkpoint over rendered videos and print the figures of its model card."""

    options: Flat[MeasureOptions]
    curve: Path | None = None
    """log.jsonl of the joint training: print the whole card, with how it was trained and its curve."""


def execute(arguments: Arguments) -> None:
    """Measure and print Markdown."""
    figures = measure(arguments.options)
    if arguments.curve is None:
        print(card_table(figures))
    else:
        print(full_card(arguments.options, figures, arguments.curve), end="")
