"""Graduated non-convexity: least squares truncated at a limit, from a start that may be far off.

The truncated loss is approached from a convex one by a parameter mu that grows; each measurement's weight follows from
its residual. H. Yang, P. Antonante, V. Tzoumas, L. Carlone: Graduated non-convexity for robust spatial perception,
RA-L 2020, equations 13 and 14.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GROWTH = 1.4
_SETTLED = 30.0  # mu from which all weights but a few are 0 or 1
_FIRST_STEPS, _STEPS = 5, 2  # of the optimiser before there is a mu, and at each

Optimise = Callable[[gtsam.NonlinearFactorGraph, gtsam.Values, int], tuple[gtsam.Values, Any]]


@dataclass
class Truncation:
    """A loss between a convex one (mu near 0) and least squares truncated at `limit` 1-sigma (mu large)."""

    limit: float
    mu: float = 0.0
    """0: least squares, truncated nowhere."""
    largest: float = field(default=0.0, init=False)
    """The largest residual whose loss was asked for, in 1-sigma."""

    def noise(self, covariance: Array) -> gtsam.noiseModel.Base:
        """Return the noise of a measurement under this loss, whatever mu then is."""
        estimator: Any = gtsam.noiseModel.mEstimator
        gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
        return gtsam.noiseModel.Robust.Create(estimator.Custom.Create(self.weight, self.loss), gaussian)

    def weight(self, distance: float) -> float:
        """Return what a residual of so many 1-sigma weighs (equation 14)."""
        squared, bound = distance * distance, self.limit * self.limit
        if self.mu == 0.0 or squared <= self.mu / (self.mu + 1.0) * bound:
            return 1.0
        if squared >= (self.mu + 1.0) / self.mu * bound:
            return 0.0
        return max(0.0, self.limit / distance * math.sqrt(self.mu * (self.mu + 1.0)) - self.mu)

    def loss(self, distance: float) -> float:
        """Return half the surrogate of equation 13."""
        self.largest = max(self.largest, distance)
        squared, bound = distance * distance, self.limit * self.limit
        if self.mu == 0.0 or squared <= self.mu / (self.mu + 1.0) * bound:
            return 0.5 * squared
        if squared >= (self.mu + 1.0) / self.mu * bound:
            return 0.5 * bound
        return self.limit * distance * math.sqrt(self.mu * (self.mu + 1.0)) - 0.5 * self.mu * (bound + squared)


def anneal(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, truncation: Truncation, optimise: Optimise
) -> gtsam.Values:
    """Return where least squares lead that are truncated more and more; measurements have the truncation's noise."""
    bound, truncation.mu = truncation.limit**2, 0.0
    values, _ = optimise(graph, values, _FIRST_STEPS)
    truncation.largest = 0.0
    graph.error(values)
    truncation.mu = bound / max(2.0 * truncation.largest**2 - bound, bound / _SETTLED)
    while truncation.mu < _SETTLED:
        values, _ = optimise(graph, values, _STEPS)
        truncation.mu *= _GROWTH
    return values
