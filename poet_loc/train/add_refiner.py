"""The stage behind `poet-loc train-refiner`: a trained pose network gets a refiner, with calibrated variances."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

from poet_loc.core.input_error import InputError, at_least
from poet_loc.data.packed import AugmentOptions, scenes_of
from poet_loc.io.bop_models import models_of
from poet_loc.io.whole_folder import write_whole_file
from poet_loc.model.checkpoint import checksum, load_model, save_model
from poet_loc.model.refiner import RefinerOptions
from poet_loc.train.calibration import calibrate
from poet_loc.train.refiner import (
    RefinerLossOptions,
    StartOptions,
    TrainRefinerOptions,
    packed_validation,
    train_refiner,
)
from poet_loc.train.run_files import plain
from poet_loc.train.steps import Precision, StepOptions, last_row

RESULT = "network.safetensors"
MAY_CHANGE = ("weights", "out", "max_steps")


@dataclass(frozen=True)
class AddRefinerOptions:
    """Train a refiner for a trained pose network and write both in one file; run it again to go on."""

    weights: Path
    """Trained network with its detector (.safetensors). It stays as it is; a refiner that it has is replaced."""
    train: Path
    """BOP split folder to learn from."""
    validation: Path
    """BOP split folder of images that neither saw: for the figures in log.jsonl, and to calibrate the variances."""
    out: Path
    """Folder of network.safetensors, log.jsonl and what a run goes on from: packed images, the network's estimates, a
    checkpoint."""
    models: Path | None = None
    """BOP models folder with textures or colours; without it models/ beside the split."""
    steps: int = 4000
    """Optimiser steps."""
    batch: int = 16
    """Images per step."""
    learning_rate: float = 1.5e-3
    """Peak of the one-cycle schedule."""
    points: int = RefinerOptions.points
    """Coloured points per model; they become part of the weights."""
    rounds: int = RefinerOptions.rounds
    """Comparisons, one after the other; `detect --rounds` may choose others."""
    starts: StartOptions = field(default_factory=StartOptions)
    loss: RefinerLossOptions = field(default_factory=RefinerLossOptions)
    augment: AugmentOptions = field(default_factory=AugmentOptions)
    val_images: int = TrainRefinerOptions.val_images
    """Images of the validation split that are looked at, evenly spread."""
    precision: Precision = StepOptions.precision
    """auto: bfloat16 where the CPU has matrix units for it, else float32."""
    seed: int = 0
    max_steps: int | None = None
    """Stop, resumable, after so many steps of this call."""

    def __post_init__(self) -> None:
        at_least(1, self, "steps", "batch", "points", "rounds", "val_images")
        at_least(1, self, *([] if self.max_steps is None else ["max_steps"]))
        at_least(0, self, "learning_rate")


def add_refiner(options: AddRefinerOptions) -> int:
    """Train, or go on training, and return how many steps are done; after the last the network is written.

    Raises InputError for a network without a detector, data that cannot be read, and a folder with another run.
    """
    network, config = load_model(options.weights)
    if config.detector is None:
        raise InputError("has no detector", path=options.weights, fix="give the file of a whole network")
    network.refiner = None
    asked = _asked(options, config.object_ids or tuple(range(1, config.network.class_count + 1)))
    scenes_of(asked.train)
    scenes_of(asked.validation)
    models_of(asked.models / "models_info.json", asked.object_ids)
    _same_run(options, checksum(network.state_dict()))
    network.refiner = train_refiner(asked, network)
    last = last_row(options.out)
    if last["step"] < options.steps:
        return int(last["step"])
    found = calibrate(network, packed_validation(asked))
    source = {**config.source, "refiner": {key: last[key] for key in ("step", "cpu_minutes")}, **found}
    config = replace(config, refiner=asked.refiner, variance_scale=(1.0, 1.0), source=source)
    save_model(options.out / RESULT, network, config)
    return options.steps


def _asked(options: AddRefinerOptions, object_ids: tuple[int, ...]) -> TrainRefinerOptions:
    return TrainRefinerOptions(
        options.train,
        options.validation,
        options.models or options.train.parent / "models",
        options.out / "packed",
        StepOptions(
            options.out,
            options.steps,
            options.batch,
            options.learning_rate,
            "muon",
            precision=options.precision,
            seed=options.seed,
            max_steps=options.max_steps,
        ),
        RefinerOptions(class_count=len(object_ids), points=options.points, rounds=options.rounds),
        options.loss,
        options.augment,
        options.starts,
        options.val_images,
        object_ids,
    )


def _same_run(options: AddRefinerOptions, network: str) -> None:
    """Write what was asked.  Raises InputError where the folder holds a run of something else."""
    path = options.out / "options.json"
    asked = {key: value for key, value in plain(options).items() if key not in MAY_CHANGE} | {"network": network}
    if path.exists():
        before = json.loads(path.read_text())
        other = sorted(key for key in asked if asked[key] != before.get(key))
        if other:
            what = f"the run had other options: {', '.join(other)}"
            raise InputError(what, path=path, fix="give the same, or another folder")
        return
    if options.out.is_dir() and any(options.out.iterdir()):
        raise InputError("holds something else", path=options.out, fix="name an empty folder")
    options.out.mkdir(parents=True, exist_ok=True)
    write_whole_file(path, [json.dumps(asked, indent=1), "\n"])
