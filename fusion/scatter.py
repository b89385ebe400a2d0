"""How much an object's detections differ from one to the next, and what that says of its biases.

A network that is unsure of an object is unsteady about it, and what it gets wrong for seconds and longer grows with
that: over objects and videos of YCB-V about as the square root, from one network to another less. So the biases of an
object whose detections state no covariance are larger or smaller than the options' by a power of how much more or less
these scatter than usual (`fit-noise` measures that of a network). They are compared by the filter's residuals, which
know how the camera moves; a running geometric mean makes of a flip one difference among hundreds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.compiled import njit
from fusion.memory import NOW, Memory
from fusion.options import DetectionBias

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

LONGEST_STEP_S = 0.3
"""Detections further apart differ by what varies between them, not by white noise alone."""
PRIOR_STEPS, MOST_STEPS = 30.0, 300.0
"""The usual scatter counts as so many differences, an object's own as at most so many: what it was longer ago fades."""
LARGEST_RATIO = 6.0
"""A difference counts as no more than so many times the variance that is expected."""

# Places in a row of `Memory.scatter`: 1-sigma of rotation (rad), across and along the ray (shares of the distance), how
# many differences they stand on, the stamp (ns) and the residual of the last detection.
SIGMAS, COUNT, LAST_NS, LAST = 0, 3, 4, 5
EXPONENT, MARGIN = 3, 4  # of `Memory.usual_scatter`, behind the three

# What makes the mean logarithm of a chi-square of 3, 2, 1 degrees of freedom over these zero, cut at the largest ratio.
_OF_ROTATION, _OF_ACROSS, _OF_ALONG = 1.447_552, 1.796_278, 4.100_431


def usual_scatter(bias: DetectionBias) -> Array:
    """Return the usual scatter [rotation (rad), across, along, 0: not known, the exponent, the margin] (5,)."""
    sigmas = (math.radians(bias.scatter_rotation_deg), bias.scatter_across, bias.scatter_along)
    return np.array([*sigmas, bias.scatter_exponent, bias.scatter_margin])


def scatter_of(stamps: Stamps, errors: Array) -> Array:
    """Return the scatter (3,) of an object's errors (N, 6) in a log, as a filter would find it in the end.

    Errors are [rotation (rad), across x, across y, along], places as shares of the distance, in order of time; of one
    stamp the first counts. NaN without a step.
    """
    stamps, first = np.unique(stamps, return_index=True)
    steps = np.diff(errors[first], axis=0)[np.diff(stamps) < LONGEST_STEP_S * 1e9]
    if len(steps) == 0:
        return np.full(3, np.nan)
    halves = (steps[:, :3], steps[:, 3:5], steps[:, 5:])
    corrections = (_OF_ROTATION, _OF_ACROSS, _OF_ALONG)
    variances = [c * np.mean(h**2, axis=1) / 2.0 for c, h in zip(corrections, halves, strict=True)]
    return np.array([_middle(each) for each in variances])


def _middle(variances: Array) -> float:
    """Return the 1-sigma at which the logarithms of ratios to its square, none beyond the largest, have mean zero."""
    logs = np.log(np.maximum(variances, 1e-30))
    middle = float(np.median(logs))
    for _ in range(100):
        middle += float(np.mean(np.minimum(logs - middle, math.log(LARGEST_RATIO))))
    return math.exp(0.5 * middle)


@njit(cache=True)
def is_usual_known(m: Memory) -> bool:
    """Tell whether the filter knows how much detections usually scatter."""
    return m.usual_scatter[0] + m.usual_scatter[1] + m.usual_scatter[2] > 0.0


@njit(cache=True)
def spread_by_scatter(m: Memory, k: int, i: int, scale: float) -> float:
    """Return by how much the biases of object k are larger in part i, where its noise is taken so much larger."""
    usual, margin = scale * m.usual_scatter[i], m.usual_scatter[MARGIN]
    if not usual > 0.0:
        return scale
    own = m.scatter[k, SIGMAS + i] / usual
    beyond = own / min(max(own, 1.0 / margin), margin)
    return float(scale * beyond ** m.usual_scatter[EXPONENT])


@njit(cache=True)
def follow_scatter(m: Memory, k: int, t: Array, residual: Array) -> None:
    """Take the residual (6,) of object k's detection at t (3,), m in camera axes, into its scatter: a stamp's first."""
    s, since = m.scatter[k], (m.counters[NOW] - m.scatter[k, LAST_NS]) * 1e-9
    if since == 0.0 or not is_usual_known(m):
        return
    if 0.0 < since < LONGEST_STEP_S:
        s[COUNT] = min(s[COUNT] + 1.0, MOST_STEPS)
        _take_step(s, t, residual)
    s[LAST_NS] = m.counters[NOW]
    for i in range(6):
        s[LAST + i] = residual[i]


@njit(cache=True)
def _take_step(s: Array, t: Array, residual: Array) -> None:
    squared = t[0] ** 2 + t[1] ** 2 + t[2] ** 2
    turned = moved = along = 0.0
    for i in range(3):
        turned += (residual[i] - s[LAST + i]) ** 2
        step = residual[3 + i] - s[LAST + 3 + i]
        moved += step * step
        along += step * t[i]
    along = along * along / (squared * squared)
    across = moved / squared - along
    gain = 0.5 / (s[COUNT] + PRIOR_STEPS)
    follow_mean(s, SIGMAS, _OF_ROTATION * turned / 6.0, gain, LARGEST_RATIO)
    follow_mean(s, SIGMAS + 1, _OF_ACROSS * across / 4.0, gain, LARGEST_RATIO)
    follow_mean(s, SIGMAS + 2, _OF_ALONG * along / 2.0, gain, LARGEST_RATIO)


@njit(cache=True)
def follow_mean(x: Array, i: int, variance: float, gain: float, largest: float) -> None:
    """Take a variance, no more than `largest` times that of 1-sigma x[i], into x[i], a running geometric mean."""
    if x[i] > 0.0 and 0.0 < variance < math.inf:
        x[i] *= min(variance / (x[i] * x[i]), largest) ** gain
