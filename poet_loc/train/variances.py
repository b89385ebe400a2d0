"""Temperature calibration on held-out images: the stage behind `poet-loc calibrate`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError, at_least
from poet_loc.core.reliability import LEVELS, reliability, squared_mahalanobis, variance_factor
from poet_loc.data.batches import EpochBatches, Samples, loader
from poet_loc.data.open_dataset import open_dataset
from poet_loc.io.whole_folder import not_there
from poet_loc.model.checkpoint import load_model, save_model
from poet_loc.model.heads import covariance_matrices
from poet_loc.model.losses import rotation_vector
from poet_loc.model.matcher import BoxMode, match
from poet_loc.model.poet import PoET
from poet_loc.train.validation import asked_queries

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CalibrateOptions:
    """Which network, on which images."""

    weights: Path
    """Network with uncertainty heads (.safetensors)."""
    data: Path
    """Images that it was not trained on: BOP split folder or annotation file (.json)."""
    target: Path
    """File to write: the same weights with the factors in their configuration."""
    images: Path | None = None
    """Folder of an annotation file's images, if it does not lie as published."""
    boxes: BoxMode = "backbone"
    """Boxes that are asked about: the detector's, the true ones, or jittered ones."""
    robust: bool = True
    """By the median error, so that gross errors do not count; else by the mean squared error."""
    batch: int = 4
    workers: int = 0
    overwrite: bool = False
    """Replace what is there."""

    def __post_init__(self) -> None:
        at_least(1, self, "batch")
        at_least(0, self, "workers")


@dataclass(frozen=True)
class Calibration:
    """What was found; shares are those inside the ellipsoids of `levels`."""

    factors: tuple[float, float]
    """On the variances of translation and rotation."""
    objects: int
    levels: tuple[float, ...]
    before: dict[str, tuple[float, ...]]
    """Shares by quantity: translation, rotation."""
    after: dict[str, tuple[float, ...]]

    def gap(self, shares: dict[str, tuple[float, ...]]) -> dict[str, float]:
        """Return the mean distance between share and probability of each quantity."""
        return {name: float(np.mean(np.abs(np.subtract(row, self.levels)))) for name, row in shares.items()}


def calibrate(options: CalibrateOptions) -> Calibration:
    """Find the factors on the variances, write the network with them, and return how reliable it was and is.

    Raises InputError for a network without uncertainty heads and for data in which nothing matches.
    """
    not_there(options.target, options.overwrite)
    network, config = load_model(options.weights)
    if config.network.uncertainty == "none":
        raise InputError("the network tells no uncertainty", path=options.weights, fix="train its uncertainty heads")
    folder = options.data.suffix != ".json"
    dataset = open_dataset(options.data, options.images, config.object_ids if folder else ())
    samples = Samples(dataset, None, jitter=options.boxes == "jitter")
    batches = loader(
        samples,
        EpochBatches(len(samples), options.batch, shuffle=False),
        network.detector.shape().multiple,
        options.workers,
    )
    parts = list(_squared_errors(network, batches, options.boxes))
    if not parts:
        raise InputError("no detection matches an object", path=options.data)
    squared = dict(zip(("translation", "rotation"), map(np.concatenate, zip(*parts))))
    factors = {name: variance_factor(values, 3, options.robust) for name, values in squared.items()}
    scale = factors["translation"], factors["rotation"]
    save_model(options.target, network, replace(config, variance_scale=scale))
    return Calibration(
        scale,
        len(squared["translation"]),
        LEVELS,
        {name: tuple(reliability(values, 3).tolist()) for name, values in squared.items()},
        {name: tuple(reliability(values / factors[name], 3).tolist()) for name, values in squared.items()},
    )


@torch.no_grad()
def _squared_errors(network: PoET, batches, mode: BoxMode) -> Iterator[tuple[Array, Array]]:  # type: ignore[no-untyped-def]
    """Yield squared Mahalanobis distances of translation and rotation, (K,) each, batch by batch."""
    for batch in batches:
        output = network(batch.images, asked_queries(network, batch, mode))
        pairs = match(output.queries, batch.targets, mode, network.options.class_mode == "specific")
        index = pairs.images, pairs.queries
        rows = list(zip(pairs.images.tolist(), pairs.targets.tolist()))
        if not rows:
            continue
        true_t = torch.stack([batch.targets[image].translation[row] for image, row in rows])
        true_r = torch.stack([batch.targets[image].rotation[row] for image, row in rows])
        errors = output.translation[index] - true_t, rotation_vector(output.rotation[index] @ true_r.mT)
        numbers = output.translation_uncertainty, output.rotation_uncertainty
        squared = [
            squared_mahalanobis(e.double().numpy(), covariance_matrices(n[index].double()).numpy())
            for e, n in zip(errors, numbers)
            if n is not None
        ]
        yield squared[0], squared[1]
