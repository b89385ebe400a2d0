"""poet-loc train: a pose network from images with poses."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from poet_loc.cli.arguments import Flat
from poet_loc.core.input_error import InputError
from poet_loc.train.options import RECIPES, TrainOptions
from poet_loc.train.unread_options import refuse_unread


@dataclass(frozen=True)
class Arguments:
    """Train a pose network on BOP data or an annotation file; torchrun runs it on several processes."""

    options: Flat[TrainOptions]
    preset: Literal["paper", "code", "ycbv", "embedded"] | None = None
    """Published recipe: of the paper, of the official code, or what its authors gave for YCB-V.  It replaces the
    optimiser's and the loss's options that were left at their defaults.  embedded: the network that comes with the
    package, from rendering to calibration; it takes out, data.train (the split train of the rendered data set, made
    where it is missing), recipe.batch, seed and max_steps alone, and it always resumes."""


def execute(arguments: Arguments) -> None:
    """Train and say where the weights are."""
    from poet_loc.train.pose_training import train

    options = arguments.options
    refuse_unread(options, arguments.preset == "embedded")
    if arguments.preset == "embedded":
        print(_train_embedded(options))
        return
    if arguments.preset is not None:
        recipe, loss = RECIPES[arguments.preset]
        options = replace(options, recipe=_over(options.recipe, recipe), loss=_over(options.loss, loss))
    out = train(options)
    if os.environ.get("RANK", "0") != "0":
        return  # torchrun started several of us
    names = [name for name in ("best.safetensors", "network.safetensors", "last.pt") if (out / name).exists()]
    print(f"{out}: {', '.join(names)}")


def _train_embedded(options: TrainOptions) -> Path:
    from poet_loc.train.embedded_preset import EmbeddedPresetOptions, train_preset

    if options.data.train.name != "train":
        fix = "give --data.train FOLDER/train: FOLDER gets models/, train/ and val/"
        raise InputError("the preset embedded renders the split train", path=options.data.train, fix=fix)
    world, batch = options.data.train.parent, options.recipe.batch
    chosen = EmbeddedPresetOptions(
        options.out, batch=batch, seed=options.seed, max_steps=options.max_steps, world=world
    )
    return train_preset(chosen)


def _over(given: Any, preset: Any) -> Any:
    """Return the preset with the fields that were not left at their defaults."""
    default = type(given)()
    chosen = {f.name: getattr(given, f.name) for f in fields(given)}
    return replace(preset, **{name: value for name, value in chosen.items() if value != getattr(default, name)})
