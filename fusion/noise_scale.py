"""How many times larger than stated the errors of poses are, as the filter's innovations say.

What a network states of its own errors mostly is too little, above all away from what it was trained on, and a filter
that believes it refuses what is right and goes astray. So the 1-sigma of all rotations and of all positions, and with
it that of the objects' biases, is widened until a quarter of the innovations lie within the lower quartile that the
filter expects (stochastic approximation of a quantile, Robbins and Monro 1951). Gross errors lie at the other end:
where half of all are gross, that quartile is the median of the rest. One object that was moved or is grossly wrong for
long widens nothing while others are seen.
"""

from __future__ import annotations

import math

from fusion.compiled import njit
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP
from fusion.memory import Memory
from fusion.nav_state import Array

LOWER_QUARTILE = 1.212_533
"""Of a chi-square of three degrees of freedom, in units of which a part's NIS is judged."""
LEAST = 0.5
"""Innovations far smaller than expected count down to this factor, so that it takes many larger ones to widen noise."""
FIRST_RATE, OVER = 1.2, 24.0
"""The first poses move the factors at this rate, at half of it after so many."""

# Places in a row of `Memory.scales`: factors of the 1-sigma of rotation and position, and how many poses were followed.
TURN, PLACE, FOLLOWED = range(3)


@njit(cache=True)
def follow_scale(m: Memory, kind: int, k: int, nis: Array, rate: float, largest: float) -> None:
    """Take the NIS [both, rotation, position] of a pose into the factors of its kind.

    A rotation known but for a turn about an axis has two degrees of freedom: it says nothing here.
    """
    if not math.isfinite(nis[0]):  # of an object whose pose is not known yet
        return
    scales = m.scales[0 if kind == OBJECT_POSE else 1]
    gain = max(rate, FIRST_RATE / (1.0 + scales[FOLLOWED] / OVER))
    for part in range(1 if kind == OBJECT_POSE and m.orders[k] == 0 else 0, 2):
        step = 0.125 if nis[1 + part] > LOWER_QUARTILE else -0.375
        scales[part] = min(max(scales[part] * math.exp(gain * step), LEAST), largest)
    scales[FOLLOWED] += 1.0


@njit(cache=True)
def scale_of(m: Memory, kind: int, part: int) -> float:
    """Return by how much the 1-sigma of a kind's rotation (TURN) or position (PLACE) is widened now."""
    return 1.0 if kind == ODOMETRY_STEP else max(m.scales[0 if kind == OBJECT_POSE else 1, part], 1.0)


def widening(m: Memory) -> tuple[float, float]:
    """Return by how much the 1-sigma of rotation and of position of the poses, all of one kind, is widened now."""
    turn, place, _ = m.scales.max(axis=0)
    return max(float(turn), 1.0), max(float(place), 1.0)


@njit(cache=True)
def widen(m: Memory, kind: int, R: Array) -> None:
    """Widen the covariance (6, 6) of a pose of this kind, in place."""
    turn, place = scale_of(m, kind, TURN), scale_of(m, kind, PLACE)
    if turn == 1.0 and place == 1.0:
        return
    for i in range(6):
        for j in range(6):
            R[i, j] *= (turn if i < 3 else place) * (turn if j < 3 else place)
