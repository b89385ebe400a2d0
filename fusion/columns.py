"""What a loop over a whole log reads and writes, as columns, and a measurement as the filter uses it."""

from __future__ import annotations

from typing import NamedTuple

from fusion.compiled import njit
from fusion.measurements import OBJECT_POSE, camera_in_world
from fusion.memory import Memory, Work
from fusion.nav_state import OBJECT_SIZE, OBJECTS, TIME_OFFSET, Array, Ints
from fusion.noise_scale import widen
from fusion.so3_kernels import multiply_transposed_left
from fusion.symmetry import fit_symmetry

OUT_CORE, OUT_SIGMA, OUT_COVARIANCE = 21, 15, 36


class Columns(NamedTuple):
    """Samples and measurements (`Measurements`) in order of time, and what became of each measurement."""

    imu_stamps: Ints
    imu_values: Array  # (N, 9) rows of `imu_noise.imu_rows`
    stamps: Ints
    kinds: Ints
    objects: Ints
    rotations: Array
    translations: Array
    covariances: Array
    decisions: Ints  # (M,) places in eskf.py, and place_watch.RELEASED
    nis: Array  # (M, 3) both, rotation, position


class Fitted(NamedTuple):
    """Each measurement as the filter used it (symmetry chosen, noise scaled), and what a robust kernel gives it."""

    rotations: Array  # (M, 9)
    covariances: Array  # (M, 6, 6)
    spreads: Array  # (M, 3) of its object's biases
    weights: Array  # (M,) at the state that knows the measurement


class Rows(NamedTuple):
    """What the filter knew over time."""

    stamps: Ints
    core: Array  # (R, OUT_CORE)
    sigma: Array  # (R, OUT_SIGMA) of the core's errors
    covariance: Array  # (R, OUT_COVARIANCE) of attitude and position


@njit(cache=True)
def read(m: Memory, w: Work, log: Columns, j: int) -> None:
    """Write measurement j into w.measured and w.R, its noise scaled."""
    for i in range(9):
        w.measured[i] = log.rotations[j, i]
    for i in range(3):
        w.measured[9 + i] = log.translations[j, i]
    for r in range(6):
        for c in range(6):
            w.R[r, c] = log.covariances[j, r, c]
    widen(m, log.kinds[j], w.R)


@njit(cache=True)
def read_fitted(m: Memory, w: Work, log: Columns, j: int) -> None:
    """Write measurement j into w.measured and w.R as the filter uses it: of look-alikes, the one that fits best."""
    read(m, w, log, j)
    k = log.objects[j]
    if log.kinds[j] == OBJECT_POSE and m.orders[k] != 1:
        R_wi, R_wc, p_wi, R_co = w.step[0:9], w.step[9:18], w.step[18:21], w.step[30:39]
        camera_in_world(m.x, m.x[TIME_OFFSET] - w.offset[0], w.rate, R_wi, p_wi, R_wc, w.step[21:30])
        at = OBJECTS + OBJECT_SIZE * k
        multiply_transposed_left(R_wc, m.x[at : at + 9], R_co)
        fit_symmetry(w.measured[0:9], R_co, m.axes[k], m.orders[k], w.R, w.scratch)
