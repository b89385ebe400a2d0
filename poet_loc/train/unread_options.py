"""Options of `train` that nothing reads, with the preset and the start that were chosen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from poet_loc.core import unread_options
from poet_loc.core.input_error import InputError
from poet_loc.core.unread_options import Rule, changed
from poet_loc.train.options import DataOptions, TrainOptions

OF_EMBEDDED = ("recipe.batch", "seed", "max_steps")
"""What the preset `embedded` reads, beside the folders."""


def refuse_unread(options: TrainOptions, embedded: bool = False) -> None:
    """Raise InputError for an option that is not at its default although nothing reads it."""
    usual = TrainOptions(options.out, DataOptions(options.data.train))
    if embedded:
        others = [name for name in changed(options, usual) if name not in OF_EMBEDDED]
        if others:
            what = f"{others[0].replace('_', '-')} changes nothing with the preset embedded"
            raise InputError(what, fix="leave it out, or leave out --preset")
        return
    usual = replace(usual, resume=options.resume)
    unread_options.refuse_unread(options, usual, [options], RULES)


def _is_split(path: Path | None) -> bool:
    return path is not None and path.suffix != ".json"


RULES: tuple[Rule[TrainOptions], ...] = (
    Rule("network.* backbone backbone_weights", "a training without --start", lambda options: options.start is None),
    Rule(
        "network.map_channels network.map_strides network.class_count",
        "the detector and the data, which decide it",
        lambda options: False,
    ),
    Rule(
        "backbone",
        "weights that do not tell it themselves",
        lambda options: options.backbone_weights is None or options.backbone_weights.suffix != ".safetensors",
    ),
    Rule("uncertainty", "--start", lambda options: options.start is not None),
    Rule("models_info", "loss.symmetry-aware", lambda options: options.loss.symmetry_aware),
    Rule(
        "data.validation_images data.keyframes validate_every",
        "data.validation",
        lambda options: options.data.validation is not None,
    ),
    Rule("data.least_visible", "a BOP split", lambda o: _is_split(o.data.train) or _is_split(o.data.validation)),
)
"""Who reads what."""
