"""poet-loc train: a pose network from images with poses."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from poet_loc.cli.arguments import Flat
from poet_loc.train.options import RECIPES, TrainOptions


@dataclass(frozen=True)
class Arguments:
    """Train a pose network on BOP data or an annotation file; torchrun runs it on several processes."""

    options: Flat[TrainOptions]
    preset: Literal["paper", "code", "ycbv"] | None = None
    """Published recipe: of the paper, of the official code, or what its authors gave for YCB-V.  It replaces the
    optimiser's and the loss's options that were left at their defaults."""


def execute(arguments: Arguments) -> None:
    """Train and say where the weights are."""
    from poet_loc.train.pose_training import train

    options = arguments.options
    if arguments.preset is not None:
        recipe, loss = RECIPES[arguments.preset]
        options = replace(options, recipe=_over(options.recipe, recipe), loss=_over(options.loss, loss))
    out = train(options)
    names = [name for name in ("best.safetensors", "network.safetensors", "last.pt") if (out / name).exists()]
    print(f"{out}: {', '.join(names)}")


def _over(given: Any, preset: Any) -> Any:
    """Return the preset with the fields that were not left at their defaults."""
    default = type(given)()
    chosen = {f.name: getattr(given, f.name) for f in fields(given)}
    return replace(preset, **{name: value for name, value in chosen.items() if value != getattr(default, name)})
