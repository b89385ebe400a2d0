"""poet-loc train-refiner: a refiner for a trained pose network."""

from __future__ import annotations

from dataclasses import dataclass

from poet_loc.cli.arguments import Flat
from poet_loc.train.add_refiner import RESULT, AddRefinerOptions, add_refiner


@dataclass(frozen=True)
class Arguments:
    """Train a refiner, which corrects poses by comparing the image with views of the objects' models."""

    options: Flat[AddRefinerOptions]


def execute(arguments: Arguments) -> None:
    """Train and say where the network is, or how far it is."""
    options = arguments.options
    done = add_refiner(options)
    if done < options.steps:
        print(f"{options.out}: {done} of {options.steps} steps; the same command goes on")
    else:
        print(options.out / RESULT)
