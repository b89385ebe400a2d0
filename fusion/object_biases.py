"""The biases of objects' detections: they relax, are forgotten where they jump, and gross errors do neither."""

from __future__ import annotations

import math

from fusion.compiled import njit
from fusion.memory import BIAS_TIME, NOW, Memory
from fusion.nav_state import AT_BIASES, BIASES, N_BIAS_KINDS, N_ERROR, N_OBJECTS, Array

# Places in the bias model, per kind: sigma of rotation (rad), across and along the ray (share of distance), and behind
# them the correlation times of these three (s).
BIAS_ROTATION, BIAS_ACROSS, BIAS_ALONG, BIAS_TAU = range(4)
BIAS_JUMP, BIAS_JUMP_AT, BIAS_MODEL_SIZE = range(6, 9)


@njit(cache=True)
def decay_biases(m: Memory) -> None:
    """Let the object biases relax since they last did: first-order Gauss-Markov, exact for any step.

    b <- phi b, P_b <- phi^2 P_b + (1 - phi^2) sigma^2 with phi = exp(-seconds / tau); an infinite tau stays put. A bias
    far outside its sigma is a gross error in a run: it does not fade, and it wanders as far as it jumps.
    Cross terms commute with the IMU's propagation, so this is done once per update and not once per sample.
    """
    seconds = (m.counters[NOW] - m.counters[BIAS_TIME]) * 1e-9
    m.counters[BIAS_TIME] = m.counters[NOW]
    for kind in range(m.layout[N_BIAS_KINDS]):
        for k in range(0 if is_steady(m.bias_model, kind) else m.layout[N_OBJECTS]):
            for first in (0, 3):
                _decay(m, k, kind, first, seconds)


@njit(cache=True)
def _decay(m: Memory, k: int, kind: int, first: int, seconds: float) -> None:
    x, P, n, shift = m.x, m.P, m.layout[N_ERROR], 6 * (k + kind * m.layout[N_OBJECTS])
    b, at = m.layout[BIASES] + shift, m.layout[AT_BIASES] + shift
    fading = fades(x, b, first, kind, m.bias_model)
    for i in range(first, first + 3):
        sigma, phi = bias_sigma(m.bias_model, kind, i), bias_phi(m.bias_model, kind, i, seconds)
        if fading:
            x[b + i] *= phi
            for j in range(n):
                P[at + i, j] *= phi
            for j in range(n):
                P[j, at + i] *= phi
        else:
            sigma *= m.bias_model[kind * BIAS_MODEL_SIZE + BIAS_JUMP]
        P[at + i, at + i] += (1.0 - phi * phi) * sigma * sigma


@njit(cache=True)
def fades(x: Array, b: int, first: int, kind: int, bias_model: Array) -> bool:
    """Tell whether half of the bias at x[b:] is no gross error, so that it relaxes."""
    furthest = 0.0
    for i in range(first, first + 3):
        furthest = max(furthest, abs(x[b + i]) / bias_sigma(bias_model, kind, i))
    return furthest <= bias_model[kind * BIAS_MODEL_SIZE + BIAS_JUMP_AT]


@njit(cache=True)
def forget_bias(m: Memory, k: int, kind: int, first: int, jumped: bool) -> None:
    """Forget an object's bias of rotation (first 0) or translation (3).

    Its mean becomes zero again and its sigma, if it jumped, a multiple of the stationary one; what it knew of other
    states is dropped.
    """
    shift = 6 * (k + kind * m.layout[N_OBJECTS])
    at, b = m.layout[AT_BIASES] + shift, m.layout[BIASES] + shift
    for i in range(first, first + 3):
        m.x[b + i] = 0.0
        for j in range(m.layout[N_ERROR]):
            m.P[at + i, j] = m.P[j, at + i] = 0.0
        scale = m.bias_model[BIAS_JUMP] if jumped else 1.0
        m.P[at + i, at + i] = (scale * bias_sigma(m.bias_model, kind, i)) ** 2


@njit(cache=True)
def bias_sigma(bias_model: Array, kind: int, component: int) -> float:
    """Return the stationary 1-sigma of one bias component: rotation (rad) 0-2, across x, across y, along 3-5."""
    return bias_model[kind * BIAS_MODEL_SIZE + _part(component)]


@njit(cache=True)
def bias_phi(bias_model: Array, kind: int, component: int, seconds: float) -> float:
    """Return what is left of such a component after some seconds, 1 where it never changes."""
    return math.exp(-seconds / bias_model[kind * BIAS_MODEL_SIZE + BIAS_TAU + _part(component)])


@njit(cache=True)
def is_steady(bias_model: Array, kind: int) -> bool:
    """Tell whether no part of a kind of bias ever changes."""
    at = kind * BIAS_MODEL_SIZE + BIAS_TAU
    return bias_model[at] == math.inf and bias_model[at + 1] == math.inf and bias_model[at + 2] == math.inf


@njit(cache=True)
def _part(component: int) -> int:
    if component < 3:
        return BIAS_ROTATION
    return BIAS_ALONG if component == 5 else BIAS_ACROSS


@njit(cache=True)
def is_fair(m: Memory, k: int) -> bool:
    """Tell whether an object's place is not grossly wrong, by its varying bias."""
    return m.layout[N_BIAS_KINDS] == 0 or fades(m.x, m.layout[BIASES] + 6 * k, 3, 0, m.bias_model)
