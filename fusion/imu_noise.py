"""How noisy an IMU is where it flies, from its own samples.

Data sheets know an IMU at rest; motors and steps shake it, and sampling folds what is faster than the samples into
them. Fourth differences of neighbouring samples hold hardly any motion (of 5 Hz at 200 Hz 1e-3 of its size), but all
noise that is white over the samples, times sqrt(70). A running mean of their squares travels with the samples, so that
whatever steps through them knows it, and a sample that came late changes what follows as if it had been in time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.compiled import njit
from poet_loc.core.records import ImuSamples

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Places in a row of an IMU's samples, behind angular velocity and specific force: sums of squares and their weight.
GYRO_SQUARES, ACCEL_SQUARES, WEIGHT, SAMPLE_SIZE = 6, 7, 8, 9

REACH = 4  # samples that the differences reach back
_GAIN = 70.0  # the squares of the binomial coefficients 1 4 6 4 1
_MEMORY_S = 5.0
_UNEVEN = 2.0  # intervals that differ by more are a hole, across which there is no difference to take


def imu_rows(samples: ImuSamples) -> Array:
    """Return rows (N, 9): angular velocity (rad/s), specific force (m/s^2), and how noisy they are up to there."""
    values = np.zeros((len(samples), SAMPLE_SIZE))
    values[:, :3], values[:, 3:6] = samples.angular_velocity, samples.specific_force
    follow_noise(samples.stamps_ns, values, 0, len(values))
    return values


@njit(cache=True)
def follow_noise(stamps: Ints, values: Array, first: int, end: int) -> None:
    """Write the noise places of the rows first..end-1; each depends on four rows before it and the noise there."""
    for k in range(first, end):
        row = values[k]
        for i in range(GYRO_SQUARES, SAMPLE_SIZE):
            row[i] = values[k - 1, i] if k > 0 else 0.0
        if k < REACH:
            continue
        shortest = longest = stamps[k] - stamps[k - 1]
        for j in range(k - 3, k):
            interval = stamps[j] - stamps[j - 1]
            shortest, longest = min(shortest, interval), max(longest, interval)
        if longest > _UNEVEN * shortest:
            continue
        dt = (stamps[k] - stamps[k - REACH]) * 1e-9 / REACH
        fading = math.exp(-dt / _MEMORY_S)
        for part in range(2):
            total = 0.0
            for i in range(3 * part, 3 * part + 3):
                ends, inner = row[i] + values[k - 4, i], values[k - 1, i] + values[k - 3, i]
                total += (ends - 4.0 * inner + 6.0 * values[k - 2, i]) ** 2
            row[GYRO_SQUARES + part] = fading * row[GYRO_SQUARES + part] + total * dt / (3.0 * _GAIN)
        row[WEIGHT] = fading * row[WEIGHT] + 1.0


@njit(cache=True)
def density_squared(stated: float, row: Array, place: int, share: float) -> float:
    """Return the square of the larger of a stated noise density and that of a row's samples, times share (0 or 1).

    A row of angular velocity and specific force alone says nothing of noise.
    """
    if share == 0.0 or len(row) < SAMPLE_SIZE or row[WEIGHT] == 0.0:
        return stated * stated
    return max(stated * stated, share * row[place] / row[WEIGHT])
