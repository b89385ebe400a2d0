"""Temperature calibration: the spread that a network claims, scaled until held-out errors agree with it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from poet_loc.data.packed import PackedImages
from poet_loc.model.poet import PoET
from poet_loc.train.embedded import Boxes, pose_errors, predict

Array = NDArray[np.float64]

ONE_SIGMA = 0.6827
"""Share of a Gaussian within one sigma."""
BOXES: tuple[Boxes, ...] = ("bb", "gt")

_LEAST_DETECTED = 100  # a detector that finds less has learned nothing yet: the true boxes then stand in for its own


def temperatures(error: Array, log_variance: Array) -> Array:
    """Return the factor on sigma of each column at which ONE_SIGMA of the errors lie within one sigma.

    error and log_variance (K, 6) -> (6,).  Robust where errors have heavy tails: a few flips do not count.
    """
    return np.asarray(np.quantile(np.abs(error) / np.exp(0.5 * log_variance), ONE_SIGMA, axis=0))


def coverage(error: Array, log_variance: Array) -> Array:
    """Return the share within one sigma of each column."""
    return np.asarray((np.abs(error) < np.exp(0.5 * log_variance)).mean(axis=0))


@torch.no_grad()
def scale_sigmas(network: PoET, factors: Array) -> None:
    """Multiply the sigmas of the refiner, else of the last decoder layer, by (6,) factors, translation first.

    The factors go into the biases.  Raises ValueError for a network without aleatoric heads.
    """
    if network.refiner is not None:
        network.refiner.get_parameter("spread.2.bias").add_(torch.from_numpy(2.0 * np.log(factors)).float())
        return
    if network.options.uncertainty != "aleatoric":
        raise ValueError(f"uncertainty {network.options.uncertainty} has no log variances to scale")
    shift = torch.from_numpy(2.0 * np.log(factors)).float()
    for name, part in (("translation_head_aleatoric", shift[:3]), ("rotation_head_aleatoric", shift[3:])):
        bias: Tensor = network.get_parameter(f"{name}.{network.options.decoder_layers - 1}.layers.2.bias")
        bias += part.repeat(network.options.slots)


def calibrate(network: PoET, images: PackedImages) -> dict[str, object]:
    """Scale a network's sigmas until those of images that it has not seen agree with the errors; tell what was found.

    For the detector's boxes, since those are what a log brings.
    """
    seen = {kind: _errors(network.float(), images, kind) for kind in BOXES}
    used: Boxes = "bb" if len(seen["bb"][0]) >= _LEAST_DETECTED else "gt"
    factors = temperatures(*seen[used])
    assert np.all(np.isfinite(factors))
    scale_sigmas(network, factors)
    inside = {kind: coverage(e, s + 2.0 * np.log(factors)) for kind, (e, s) in seen.items() if len(e)}
    return {
        "images": len(images),
        "calibrated_for": used,
        "temperatures": [round(float(value), 4) for value in factors],
        "coverage": {kind: [round(float(share), 3) for share in shares] for kind, shares in inside.items()},
    }


def _errors(network: PoET, images: PackedImages, boxes: Boxes) -> tuple[Array, Array]:
    """Return (K, 6) errors and log variances."""
    t, R, log_variance, truth = predict(network, images, len(images), images.models, boxes)
    return pose_errors(t, R, truth).double().numpy(), log_variance.double().numpy()
