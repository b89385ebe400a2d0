"""Errors of a pose sensor: white, or like those of a real network; (F, O, 6) for F frames and O objects.

An error is [e_r, e_t] in **ray axes** (across, across, along the viewing ray), rad and m; `to_camera_axes` turns it.
The structure and its figures are those measured on a real network's predictions on real videos: a bias per object, a
part correlated over seconds, a white part, depth dominating, gross errors and flips in runs, dropouts in runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class WhiteErrors:
    """One-sigma of one detection's error; white noise has nothing else."""

    across_m: float = 0.005
    """1-sigma across the viewing ray, m."""
    along_of_depth: float = 0.02
    """1-sigma along the viewing ray as a share of the distance."""
    rotation_deg: float = 2.0
    """1-sigma of the rotation about each axis, deg."""

    def sigmas(self, distances: Array) -> Array:
        """Return the 1-sigma of [e_r, e_t] in ray axes for any shape of distances (m): (..., 6)."""
        sigma = np.empty((*distances.shape, 6))
        sigma[..., :3] = np.radians(self.rotation_deg)
        sigma[..., 3:5] = self.across_m
        sigma[..., 5] = self.along_of_depth * distances
        return sigma


@dataclass(frozen=True)
class NetworkErrors:
    """How a network-like error is put together; shares are of the variance, the rest of it is white."""

    across_m: float = 0.007
    """1-sigma of the whole inlier error across the viewing ray, m."""
    along_of_depth: float = 0.03
    """1-sigma of the whole inlier error along the viewing ray as a share of the distance."""
    rotation_deg: float = 2.5
    """1-sigma of the whole inlier rotation error about each axis, deg."""
    bias_share: float = 0.40
    """Share of the variance that is a constant bias of the object in this log."""
    correlated_share: float = 0.37
    """Share of the variance that is a first-order Gauss-Markov process."""
    correlation_time_s: float = 3.5
    """Correlation time of that process, s."""
    gross_share: float = 0.06
    """Share of the frames in which an object's pose is grossly wrong (depth blunder, half turn, any rotation)."""
    gross_run_s: float = 0.8
    """Mean length of a run of gross errors, s."""
    flip_share: float = 0.15
    """Share of the frames in which a symmetric object is seen as one of its look-alikes."""
    flip_run_s: float = 2.0
    """Mean length of a run of such flips, s."""
    dropout_share: float = 0.07
    """Share of the frames in which an object in view is not detected."""
    dropout_run_s: float = 0.4
    """Mean length of a run of dropouts, s."""

    def sigmas(self, distances: Array) -> Array:
        """Return the 1-sigma of the whole inlier [e_r, e_t] in ray axes: (..., 6)."""
        return WhiteErrors(self.across_m, self.along_of_depth, self.rotation_deg).sigmas(distances)

    def slow_part(self, frames: int, objects: int, interval_s: float, rng: np.random.Generator) -> Array:
        """Return bias plus Gauss-Markov part in units of the whole 1-sigma, (F, O, 6)."""
        bias = np.sqrt(self.bias_share) * rng.standard_normal((1, objects, 6))
        return bias + np.sqrt(self.correlated_share) * gauss_markov(
            frames, (objects, 6), interval_s / self.correlation_time_s, rng
        )

    @property
    def white_sigma(self) -> float:
        """1-sigma of the white part in units of the whole 1-sigma."""
        return float(np.sqrt(max(0.0, 1.0 - self.bias_share - self.correlated_share)))


def gauss_markov(steps: int, shape: tuple[int, ...], step_over_tau: float, rng: np.random.Generator) -> Array:
    """Return a stationary first-order Gauss-Markov process of unit variance, (steps, *shape)."""
    decay = float(np.exp(-step_over_tau))
    values = rng.standard_normal((steps, *shape))
    values[1:] *= np.sqrt(1.0 - decay**2)
    for step in range(1, steps):
        values[step] += decay * values[step - 1]
    return values


def runs(steps: int, columns: int, share: float, mean_length: float, rng: np.random.Generator) -> Mask:
    """Return a two-state Markov chain per column that is on for `share` of the steps, in runs of mean_length steps."""
    if share <= 0.0:
        return np.zeros((steps, columns), dtype=bool)
    stop = min(1.0, 1.0 / max(mean_length, 1.0))
    start = stop * share / max(1.0 - share, 1e-12)
    draws = rng.random((steps, columns))
    state = np.empty((steps, columns), dtype=bool)
    state[0] = draws[0] < share
    for step in range(1, steps):
        state[step] = np.where(state[step - 1], draws[step] >= stop, draws[step] < start)
    return state


def run_numbers(mask: Mask) -> NDArray[np.int64]:
    """Number the runs of a mask (F, O) from 0 through all columns; -1 where it is off."""
    starts = mask & ~np.vstack([np.zeros((1, mask.shape[1]), bool), mask[:-1]])
    numbers = np.cumsum(starts.T.ravel()).reshape(mask.T.shape).T - 1
    return np.where(mask, numbers, -1)


def ray_axes(points: Array) -> Array:
    """Return rotations R_cam_ray (..., 3, 3) whose third axis points from the camera to the points (..., 3)."""
    along = points / np.linalg.norm(points, axis=-1, keepdims=True)
    helper = np.where(np.abs(along[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    first = np.cross(helper, along)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(along, first), along], axis=-1)


def to_camera_axes(errors_in_ray: Array, R_cam_ray: Array) -> Array:
    """Return errors [e_r, e_t] (..., 6) in camera axes."""
    halves = errors_in_ray.reshape(*errors_in_ray.shape[:-1], 2, 3)
    return np.einsum("...ij,...kj->...ki", R_cam_ray, halves).reshape(errors_in_ray.shape)


def covariance_in_camera_axes(sigmas_in_ray: Array, R_cam_ray: Array) -> Array:
    """Return covariances (..., 6, 6) in camera axes of independent errors in ray axes with these 1-sigmas (..., 6)."""
    result = np.zeros((*sigmas_in_ray.shape, 6))
    for half in (slice(0, 3), slice(3, 6)):
        scaled = R_cam_ray * sigmas_in_ray[..., None, half]
        result[..., half, half] = scaled @ np.swapaxes(scaled, -1, -2)
    return result
