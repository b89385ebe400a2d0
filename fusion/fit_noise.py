"""Fit the noise of detections to logs with ground truth: what is white, what lasts for seconds, what stays.

The errors of each object (rotation in rad; image shift and stretch of the distance as shares of it, as in
`fusion/measurements.py`) have the autocovariance  w^2 [lag = 0] + v^2 exp(-lag / tau) + s^2, whose parts are the white
noise, the varying and the steady bias. Gross errors are left out and counted: the gate and the jumps deal with them.

What an object's errors have in common from log to log is its mean error, which a filter can take off beforehand; it
is shrunk towards zero by what the scatter between logs leaves uncertain of it (random effects, variances by the method
of moments). The three parts are then those of what the other logs' mean error leaves of each: what a new log brings.
How much detections scatter from one to the next says by how much an object's own biases differ (`fusion/scatter.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fusion.options import DetectionBias, DetectionNoise
from fusion.prepare import NEAREST_OBJECT, landmark_of_detection
from fusion.scatter import scatter_of
from poet_loc.core.input_error import InputError, within
from poet_loc.core.records import ObjectPoses
from poet_loc.io.log_folder import Log

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Track = tuple[Stamps, Array]

PARTS = {"rotation": slice(0, 3), "across": slice(3, 5), "along": slice(5, 6)}


@dataclass(frozen=True)
class FitNoiseOptions:
    """What counts as a gross error, and how far correlation is looked at."""

    gross_distance: float = 0.15
    """A position error beyond this share of the distance is gross."""
    gross_angle_deg: float = 25.0
    """A rotation error beyond this is gross, deg."""
    longest_lag_s: float = 8.0
    """Autocovariances are fitted up to this lag, s."""
    min_detections: int = 100
    """An object with fewer good detections in a log is left out."""

    def __post_init__(self) -> None:
        within("(0, inf]", self, "gross_distance", "gross_angle_deg")
        within("(0, inf)", self, "longest_lag_s")
        within("[2, inf]", self, "min_detections")


@dataclass(frozen=True)
class FittedPart:
    """The three parts of one kind of error, 1-sigma: rad for rotation, shares of the distance for the others."""

    white: float
    varying: float
    correlation_s: float
    steady: float


@dataclass(frozen=True)
class FittedNoise:
    """What a set of logs says of its detections."""

    parts: dict[str, FittedPart]
    """rotation, across, along."""
    gross_share: float
    """Share of the detections that are gross errors."""
    detections: int
    """How many the fit stands on."""
    scatter: Array
    """How much an object's detections usually scatter: 1-sigma (3,) of rotation (rad), across, along (`scatter.py`)."""
    means: dict[int, Array] = field(default_factory=dict)
    """By object id, of objects in two logs or more: the mean error (6,) that a new log will have too."""

    def options(self) -> tuple[DetectionNoise, DetectionBias]:
        """Return the options that a filter needs to know of it; the noise floor near an object stays the default."""
        rotation, across, along = (self.parts[name] for name in PARTS)
        noise = DetectionNoise(across=across.white, along=along.white, rotation_deg=math.degrees(rotation.white))
        bias = DetectionBias(
            across=across.varying,
            along=along.varying,
            rotation_deg=math.degrees(rotation.varying),
            correlation_across_s=across.correlation_s,
            correlation_along_s=along.correlation_s,
            correlation_rotation_s=rotation.correlation_s,
            steady_across=across.steady,
            steady_along=along.steady,
            steady_rotation_deg=math.degrees(rotation.steady),
            scatter_rotation_deg=math.degrees(self.scatter[0]),
            scatter_across=float(self.scatter[1]),
            scatter_along=float(self.scatter[2]),
            scatter_exponent=0.5,
            scatter_margin=1.0,
            means=tuple(_row_of_means(object_id, mean) for object_id, mean in sorted(self.means.items())),
        )
        return noise, bias


def fit_noise(
    logs: Iterable[Log], detections: str | None = None, options: FitNoiseOptions | None = None
) -> FittedNoise:
    """Fit the noise of one set of detections (by name) to logs with T_world_cam.tum and a map.

    Raises InputError where a log lacks them, or where too few detections are good.
    """
    options = options or FitNoiseOptions()
    lags = (np.arange(1, max(2, round(options.longest_lag_s / _STEP_S))) * _STEP_S).astype(np.float64)
    sums, counts = np.zeros((6, len(lags) + 1)), np.zeros(len(lags) + 1)
    found, gross_share, scatters = _good_errors(logs, detections, options)
    good = sum(len(stamps) for tracks in found.values() for stamps, _ in tracks)
    if good == 0:
        raise InputError(f"no object has {options.min_detections} good detections", fix="give longer logs")
    averages = {key: np.array([errors.mean(axis=0) for _, errors in tracks]) for key, tracks in found.items()}
    believed = _shrinkage(averages)
    for key, tracks in found.items():
        for i, (stamps, errors) in enumerate(tracks):
            others = np.delete(averages[key], i, axis=0)
            known = believed[key] * others.mean(axis=0) if len(others) else 0.0
            _add_autocovariance(stamps, errors - known, sums, counts)
    means = {key: believed[key] * each.mean(axis=0) for key, each in averages.items() if len(each) > 1}
    covariance = sums / np.maximum(counts, 1)
    usable = np.r_[True, counts[1:] > options.min_detections]
    parts = {name: _fit_part(covariance[part], lags, usable) for name, part in PARTS.items()}
    return FittedNoise(parts, gross_share, good, _usual_scatter(scatters), means)


def _row_of_means(object_id: int, mean: Array) -> tuple[int, float, float, float, float, float, float]:
    x, y, z, *place = (round(float(value), 6) + 0.0 for value in np.r_[np.degrees(mean[:3]), mean[3:]])
    return object_id, x, y, z, place[0], place[1], place[2]


def _good_errors(
    logs: Iterable[Log], detections: str | None, options: FitNoiseOptions
) -> tuple[dict[int, list[Track]], float, list[Array]]:
    """Return by object id what is no gross error, log by log, what share of all is one, and how they scatter."""
    found: dict[int, list[Track]] = {}
    seen, gross, scatters = 0, 0, []
    for log in logs:
        poses = log.detections(detections)[1]
        for object_id, stamps, errors in object_errors(log, poses):
            keep = is_good(errors, options)
            seen += len(keep)
            gross += int(np.count_nonzero(~keep))
            if np.count_nonzero(keep) >= options.min_detections:
                found.setdefault(object_id, []).append((stamps[keep], errors[keep]))
                if poses.covariances is None:  # else what they state sizes their biases
                    scatters.append(scatter_of(stamps, errors))
    return found, gross / max(seen, 1), scatters


def _usual_scatter(scatters: list[Array]) -> Array:
    """Return the geometric mean over objects and logs, zeros (not known) where no detections follow closely."""
    known = [each for each in scatters if np.isfinite(each).all()]
    return np.exp(np.mean(np.log(known), axis=0)) if known else np.zeros(3)


def _shrinkage(means: dict[int, Array]) -> dict[int, Array]:
    """Return by object what of its mean over logs (n, 6) is to be believed, (6,): tau^2 / (tau^2 + s^2 / n).

    s^2 is the variance of an object's means between logs, tau^2 that of the objects' own means about zero.
    Source: B. Efron and C. Morris, "Stein's estimation rule and its competitors", JASA 68 (1973), section 2.
    """
    several = [each for each in means.values() if len(each) > 1]
    if not several:
        return {key: np.zeros(6) for key in means}
    between = np.mean([each.var(axis=0, ddof=1) for each in several], axis=0)
    own = np.mean([each.mean(axis=0) ** 2 - between / len(each) for each in several], axis=0)
    own = np.maximum(own, 0.0)
    return {key: own / np.maximum(own + between / len(each), 1e-30) for key, each in means.items()}


_STEP_S = 0.1


def object_errors(log: Log, poses: ObjectPoses) -> Iterator[tuple[int, Stamps, Array]]:
    """Yield id, stamps (N,) and errors (N, 6) [rotation, across x, across y, along] of each object of a log."""
    if log.T_world_cam is None or log.landmark_map is None:
        raise InputError("fitting needs T_world_cam.tum and landmarks.json", path=log.path, fix="choose another log")
    T_world_cam, valid = log.T_world_cam.interpolate(poses.stamps_ns, max_gap_ns=200_000_000)
    landmark = landmark_of_detection(poses, log.landmark_map)
    valid &= poses.T_cam_obj.translation[:, 2] > NEAREST_OBJECT
    for k, thing in enumerate(log.landmark_map):
        mine = (landmark == k) & valid
        if thing.symmetry is not None or not mine.any():
            continue
        truth = T_world_cam[mine].inv() * thing.T_world_obj
        measured = poses.T_cam_obj[mine]
        rotation = (measured.rotation * truth.rotation.inv()).as_rotvec()
        p, shift = truth.translation, measured.translation - truth.translation
        along = np.sum(p * shift, axis=1) / np.sum(p * p, axis=1)
        across = (shift - along[:, None] * p)[:, :2] / p[:, 2:]
        yield thing.object_id, poses.stamps_ns[mine], np.column_stack([rotation, across, along])


def is_good(errors: Array, options: FitNoiseOptions) -> NDArray[np.bool_]:
    """Tell which errors (N, 6) are no gross ones."""
    near = np.linalg.norm(errors[:, 3:], axis=1) < options.gross_distance
    return near & (np.linalg.norm(errors[:, :3], axis=1) < math.radians(options.gross_angle_deg))


def _add_autocovariance(stamps: Stamps, errors: Array, sums: Array, counts: Array) -> None:
    """Add products of errors a lag apart to the bins: bin 0 is lag zero, bin i the lags around i steps."""
    sums[:, 0] += np.sum(errors**2, axis=0)
    counts[0] += len(errors)
    seconds = (stamps - stamps[0]) * 1e-9
    for i in range(1, len(counts)):
        j = np.searchsorted(seconds, seconds + i * _STEP_S)
        inside = j < len(seconds)
        first, second = np.flatnonzero(inside), j[inside]
        near = np.abs(seconds[second] - seconds[first] - i * _STEP_S) < _STEP_S / 2
        sums[:, i] += np.sum(errors[first[near]] * errors[second[near]], axis=0)
        counts[i] += np.count_nonzero(near)


def _fit_part(covariances: Array, lags: Array, usable: NDArray[np.bool_]) -> FittedPart:
    """Fit v^2 exp(-lag / tau) + s^2 to the components' mean beyond lag zero; what lag zero has more is white."""
    covariance = np.asarray(covariances.mean(axis=0), dtype=np.float64)
    total, values = max(float(covariance[0]), 1e-18), covariance[1:][usable[1:]]
    t = lags[usable[1:]]
    if len(t) < 3:
        return FittedPart(math.sqrt(total), 0.0, 1.0, 0.0)

    def misfit(parameters: Array, /) -> Array:
        v, tau, s = parameters
        return np.asarray(v * np.exp(-t / tau) + s - values / total)

    found = least_squares(misfit, np.array([0.4, 2.0, 0.3]), bounds=([0.0, 0.2, 0.0], [2.0, 60.0, 2.0]))
    v, tau, s = (float(value) for value in found.x)
    white = max(total * (1.0 - v - s), 0.0)
    return FittedPart(math.sqrt(white), math.sqrt(total * v), tau, math.sqrt(total * s))
