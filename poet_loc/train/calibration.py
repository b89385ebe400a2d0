"""Temperature calibration: the spread that a network claims, scaled until held-out errors agree with it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from poet_loc.model.poet import PoET

Array = NDArray[np.float64]

ONE_SIGMA = 0.6827
"""Share of a Gaussian within one sigma."""


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
