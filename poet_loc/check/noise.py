"""Checks of the noise densities: against what such sensors have, and against what the data show at their quietest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from poet_loc.check.finding import Evidence, Finding
from poet_loc.io.log_folder import Log

Array = NDArray[np.float64]

_PLAUSIBLE = {
    "gyroscope_noise_density": (1e-6, 5e-2),
    "accelerometer_noise_density": (1e-5, 0.5),
    "gyroscope_random_walk": (1e-9, 2e-2),
    "accelerometer_random_walk": (1e-8, 0.5),
}
_UNITS = {
    "gyroscope_noise_density": "rad/s/sqrt(Hz)",
    "accelerometer_noise_density": "m/s^2/sqrt(Hz)",
    "gyroscope_random_walk": "rad/s^2/sqrt(Hz)",
    "accelerometer_random_walk": "m/s^3/sqrt(Hz)",
}
_TOO_SMALL = 20.0  # vibration and quantisation reach ten times the data sheet on good hardware
_REAL_GYROSCOPE = 1e-5  # below it the samples are simulated without noise, or filtered
_WINDOW = 50


def check_noise(log: Log) -> Iterator[Finding]:
    """Yield noise densities that no IMU has, and ones that the samples contradict."""
    if log.calibration is None or log.calibration.imu is None:
        return
    for name, (low, high) in _PLAUSIBLE.items():
        value = float(getattr(log.calibration.imu, name))
        if value != 0.0 and not low <= value <= high:
            what = f"{name} is implausible for any IMU"
            fix = f"its unit is {_UNITS[name]}: data sheets give deg/s or ug and the discrete value x sqrt(rate)"
            evidence: Evidence = {"stated": value, "least_plausible": low, "largest_plausible": high}
            yield Finding("noise-implausible", "error", "calibration.yaml", what, fix, evidence)
    if log.imu is None or len(log.imu) < 4 * _WINDOW:
        return
    rate = 1e9 / float(np.median(np.diff(log.imu.stamps_ns)))
    for name, samples in (
        ("gyroscope_noise_density", log.imu.angular_velocity),
        ("accelerometer_noise_density", log.imu.specific_force),
    ):
        stated = float(getattr(log.calibration.imu, name))
        low, high = _PLAUSIBLE[name]
        if low <= stated <= high:
            yield from _against_data(name, stated, samples, rate)


def _against_data(name: str, stated: float, samples: Array, rate: float) -> Iterator[Finding]:
    measured = float(_quiet_sigma(samples) / np.sqrt(rate))
    if measured == 0.0:
        return
    evidence: Evidence = {
        "stated": stated,
        "quietest_second_in_the_data": measured,
        "data_over_stated": measured / stated,
        "sqrt_rate": float(np.sqrt(rate)),
    }
    if measured / stated > _TOO_SMALL:
        what = f"{name} is smaller than the noise in the data: the filter will believe the IMU too much"
        fix = "take the density from the data at rest (Allan deviation), ten times larger when the IMU shakes"
        yield Finding("noise-too-small", "error", "calibration.yaml", what, fix, evidence)
        return
    ratio = stated / measured
    if 0.6 < ratio / np.sqrt(rate) < 1.6 and ratio > 5.0:
        what = f"{name} is sqrt(rate) times the noise in the data: a discrete sigma in place of a density"
        fix = f"divide it by sqrt(rate) = {np.sqrt(rate):.1f}; the unit is {_UNITS[name]}"
        yield Finding("noise-too-large", "warning", "calibration.yaml", what, fix, evidence)
    elif name.startswith("gyroscope") and measured > _REAL_GYROSCOPE and 40.0 < ratio < 80.0:
        what = f"{name} is 57 times the noise in the data: degrees in place of radians"
        fix = f"multiply it by pi/180; the unit is {_UNITS[name]}"
        yield Finding("noise-too-large", "warning", "calibration.yaml", what, fix, evidence)


def _quiet_sigma(samples: Array) -> float:
    """Return the white noise of one sample, from second differences of the quietest windows, (N, 3) -> mean axis."""
    bend = (samples[2:] - 2.0 * samples[1:-1] + samples[:-2]) / np.sqrt(6.0)  # motion cancels to second order
    count = len(bend) // _WINDOW
    sigma = np.sqrt(np.mean(bend[: count * _WINDOW].reshape(count, _WINDOW, 3) ** 2, axis=1)).mean(axis=1)
    return float(np.percentile(sigma, 10))
