"""How far a detection's biases spread, where the network says how sure it is of each object.

A network that states a covariance states its whole error, of which most is biased and not white. The bias model splits
an error into white, varying and steady parts, so a stated covariance is split by the same shares: the white share is
the measurement's noise, and the object's biases are so many times larger or smaller than the model's as the stated
errors of that object have been, in the mean, than the model's. Where nothing is stated the factor is one.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.columns import Columns
from fusion.compiled import njit
from fusion.lasting_share import bias_scale
from fusion.measurements import OBJECT_POSE, viewing_axes
from fusion.memory import Memory
from fusion.nav_state import N_BIAS_KINDS, SPREAD_COUNT, SPREAD_SIZE, SPREADS
from fusion.noise_scale import PLACE, TURN, scale_of
from fusion.options import DetectionBias, DetectionNoise
from fusion.scatter import follow_mean, spread_by_scatter

Array = NDArray[np.float64]

LEAST_VARIANCE = 1e-10
"""A detection that calls itself more exact than this, rad^2 and m^2, has this added: its rows would be singular."""

ROUNDING = 1e-6
"""A detection whose noise is the options' to within this share states none of its own."""

# Places in what the filter knows of the white noise of detections that state none, and how many make a mean.
WHITE_ROTATION, WHITE_ACROSS, WHITE_ALONG, WHITE_FLOOR, MEAN_OVER = range(5)


def spread_model(noise: DetectionNoise) -> Array:
    """Return the figures (5,) that `follow_spreads` reads."""
    return np.array([math.radians(noise.rotation_deg), noise.across, noise.along, noise.floor, noise.stated_over])


def white_part(covariances: Array, translations: Array, noise: DetectionNoise, bias: DetectionBias) -> Array:
    """Return what is white of stated covariances (N, 6, 6), of [e_r, e_t] in camera axes at translations (N, 3), m.

    Rotation, and position across and along the ray, keep the share of their variance that is white in the model.
    Without biases all is white.
    """
    S = covariances * noise.stated_scale**2
    S[np.linalg.eigvalsh(S)[:, 0] < LEAST_VARIANCE] += LEAST_VARIANCE * np.eye(6)
    if not bias.use:
        return S
    squared = np.sum(translations**2, axis=1)
    across = _share(noise.across, bias.across, bias.steady_across, squared, noise.floor)
    along = _share(noise.along, bias.along, bias.steady_along, squared, noise.floor)
    rotation = _share(noise.rotation_deg, bias.rotation_deg, bias.steady_rotation_deg, np.ones_like(squared))
    axes = viewing_axes(translations)
    scale = np.zeros_like(S)
    scale[:, :3, :3] = np.sqrt(rotation)[:, None, None] * np.eye(3)
    roots = np.sqrt(np.stack([across, across, along], axis=1))
    scale[:, 3:, 3:] = (axes * roots[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return np.asarray(scale @ S @ scale)


def _share(white: float, varying: float, steady: float, squared: Array, floor: float = 0.0) -> Array:
    of_white = white**2 * squared + floor**2
    return np.asarray(of_white / (of_white + (varying**2 + steady**2) * squared))


@njit(cache=True)
def follow_spreads(m: Memory, log: Columns, first: int, last: int) -> None:
    """Take the white noise of detections first..last-1 into their objects' factors in the nominal array.

    These are geometric means over an object's last detections: a moment's doubt is no moment's bias. Of an object
    whose detections state nothing, the scatter tells (`scatter.py`).
    """
    for j in range(first, last if m.layout[N_BIAS_KINDS] > 0 else first):
        if log.kinds[j] == OBJECT_POSE:
            _follow_spread(m, log.objects[j], log.covariances[j], log.translations[j])


@njit(cache=True)
def _follow_spread(m: Memory, k: int, R: Array, t: Array) -> None:
    x, model, stated, at = m.x, m.spread_model, m.stated[k], m.layout[SPREADS] + SPREAD_SIZE * k
    squared, along = t[0] ** 2 + t[1] ** 2 + t[2] ** 2, 0.0
    for i in range(3):
        for j in range(3):
            along += t[i] * R[3 + i, 3 + j] * t[j]
    along /= squared
    across = 0.5 * (R[3, 3] + R[4, 4] + R[5, 5] - along)
    floor = model[WHITE_FLOOR] ** 2
    x[at + SPREAD_COUNT] = min(x[at + SPREAD_COUNT] + 1.0, model[MEAN_OVER])
    gain = 0.5 / x[at + SPREAD_COUNT]
    turn = (R[0, 0] + R[1, 1] + R[2, 2]) / (3.0 * model[WHITE_ROTATION] ** 2)
    across /= model[WHITE_ACROSS] ** 2 * squared + floor
    along /= model[WHITE_ALONG] ** 2 * squared + floor
    placing = scale_of(m, OBJECT_POSE, PLACE) ** 2
    follow_mean(stated, 0, scale_of(m, OBJECT_POSE, TURN) ** 2 * turn, gain, math.inf)
    follow_mean(stated, 1, placing * across, gain, math.inf)
    follow_mean(stated, 2, placing * along, gain, math.inf)
    states_nothing = max(abs(turn - 1.0), abs(across - 1.0), abs(along - 1.0)) < ROUNDING
    for i in range(3):
        x[at + i] = bias_scale(m) * (spread_by_scatter(m, k, i, stated[i]) if states_nothing else stated[i])
