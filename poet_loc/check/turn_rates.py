"""Turn rates of the gyroscope beside turn rates from poses: how well two streams of rotations belong together.

For poses of a body, w = Log(R_world_body(t)^T R_world_body(t + dt)) / dt; for detections the object takes the world's
place, R_cam_obj(t) R_cam_obj(t + dt)^T, and no map is needed. The gyroscope is averaged over the same interval.
Two streams w_imu = R w_pose + b belong together as well as the correlation of R w_pose with w_imu over R in SO(3)
says, found from the singular values of their cross covariance (Umeyama 1991, eq. 40-43).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.check.streams import trajectories_of
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import ImuSamples
from poet_loc.io.log_folder import Log, object_poses_file

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

Reading = Literal["as is", "wxyz", "inverse"]
"""How the rotations of a file are meant: as the format says, with the scalar first, or the other way round."""
READINGS: tuple[Reading, ...] = ("as is", "wxyz", "inverse")

_BASELINE_S = 0.2
_LONGEST_S = 1.0
_MOST_SAMPLES = 1000
_SEARCH_S, _COARSE_S, _FINE_S = 2.0, 0.02, 0.0025
_LEAST_SAMPLES = 25
_STRETCHES = 10


@dataclass(frozen=True)
class PoseSource:
    """A file of poses that turn with the camera or with the IMU."""

    file: str
    body: Literal["cam", "imu"]
    stamps_ns: Stamps
    groups: NDArray[np.int64]
    """(N,) rows of one group are poses of one body; detections: one group per object."""
    rotations: Rotation
    of_object: bool
    """The rotations are R_cam_obj, not R_world_body."""


@dataclass(frozen=True)
class TurnRates:
    """Mean turn rates (N, 3) rad/s in body axes between two stamps each."""

    start_ns: Stamps
    end_ns: Stamps
    rates: Array


@dataclass(frozen=True)
class Match:
    """How a source's turn rates fit the gyroscope at one offset."""

    offset_s: float
    """The pose of stamp t belongs to the IMU at t + offset."""
    correlation: float
    """-1 .. 1 under the best rotation."""
    R_imu_body: Rotation
    """That rotation."""
    mirrored: float
    """Correlation under the best reflection."""
    reflection: Array
    """(3, 3) that reflection."""
    gyroscope_scale: float
    """Gyroscope over poses: 1 where both are in rad/s."""
    background: float
    """Correlation that offsets far away reach by chance."""
    samples: int


def pose_sources(log: Log) -> Iterator[PoseSource]:
    """Yield every file of a log whose poses turn with the camera or with the IMU."""
    for name, poses in log.object_poses.items():
        keys = np.column_stack([poses.object_ids, poses.instances])
        groups = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
        yield PoseSource(object_poses_file(name), "cam", poses.stamps_ns, groups, poses.T_cam_obj.rotation, True)
    if log.camera_poses is not None:
        poses_ = log.camera_poses
        yield PoseSource("camera_poses.csv", "cam", poses_.stamps_ns, _one(poses_), poses_.T_world_cam.rotation, False)
    for file, trajectory in trajectories_of(log).items():
        body: Literal["cam", "imu"] = "imu" if file == "T_world_imu.tum" else "cam"
        rotation = trajectory.T_world_body.rotation
        yield PoseSource(file, body, trajectory.stamps_ns, _one(trajectory), rotation, False)


def reread(T: RigidTransform, reading: Reading) -> RigidTransform:
    """Return poses as they are under another reading of the file."""
    if reading == "inverse":
        return T.inv()
    return make_pose(reread_rotation(T.rotation, reading), T.translation)


def reread_rotation(rotation: Rotation, reading: Reading) -> Rotation:
    """Return rotations as they are under another reading of the file."""
    if reading == "inverse":
        return rotation.inv()
    if reading == "wxyz":
        return Rotation.from_quat(rotation.as_quat()[..., [1, 2, 3, 0]])
    return rotation


def turn_rates(source: PoseSource, reading: Reading = "as is") -> TurnRates:
    """Return the turn rates of a source about a fifth of a second apart; of several objects the median."""
    first, second = _pairs(source)
    rotations = reread_rotation(source.rotations, reading)
    one, two = rotations[first], rotations[second]
    turn = one * two.inv() if source.of_object else one.inv() * two
    start, end = source.stamps_ns[first], source.stamps_ns[second]
    rates = np.reshape(turn.as_rotvec(), (-1, 3)) / ((end - start) / 1e9)[:, None]
    intervals, row = np.unique(np.column_stack([start, end]), axis=0, return_inverse=True)
    if len(intervals) < len(rates):
        order = np.argsort(row.ravel(), kind="stable")
        parts = np.split(rates[order], np.flatnonzero(np.diff(row.ravel()[order])) + 1)
        rates = np.array([np.median(part, axis=0) for part in parts])
    thin = slice(None, None, max(1, -(-len(intervals) // _MOST_SAMPLES)))
    return TurnRates(intervals[thin, 0], intervals[thin, 1], rates[thin])


def match_turns(imu: ImuSamples, rates: TurnRates) -> Match | None:
    """Return the offset, up to two seconds either way, at which turn rates fit the gyroscope best.

    None where there is too little of them.
    """
    rates = _believable(imu, rates)
    if len(rates.rates) < _LEAST_SAMPLES:
        return None
    search = np.arange(-_SEARCH_S, _SEARCH_S + 1e-9, _COARSE_S)
    scores = _scores(imu, rates, search)
    coarse = float(search[np.argmax(scores)])
    far = np.abs(search - coarse) > 1.0
    background = float(scores[far].max()) if far.any() else 0.0
    offset = _refined(imu, rates, coarse)
    cross, variance = _cross_covariances(imu, rates, np.array([offset]))
    (score,), (rotation,) = _best_rotation(cross)
    u, _, vt = np.linalg.svd(cross[0])
    reflection = u @ np.diag([1.0, 1.0, -np.sign(np.linalg.det(u @ vt))]) @ vt
    return Match(
        offset_s=offset,
        correlation=float(score / variance[0]),
        R_imu_body=Rotation.from_matrix(rotation),
        mirrored=float(np.trace(reflection.T @ cross[0]) / variance[0]),
        reflection=reflection,
        gyroscope_scale=_scale(imu, rates, offset, rotation),
        background=background,
        samples=len(rates.rates),
    )


def correlation_under(imu: ImuSamples, rates: TurnRates, offset_s: float, R_imu_body: Rotation) -> float:
    """Return the correlation of the gyroscope with turn rates under a given rotation."""
    rates = _believable(imu, rates)
    if len(rates.rates) < _LEAST_SAMPLES:
        return 0.0
    cross, variance = _cross_covariances(imu, rates, np.array([offset_s]))
    return float(np.sum(R_imu_body.as_matrix() * cross[0]) / variance[0])


def advantage(imu: ImuSamples, rates: TurnRates, offset_s: float, other_s: float) -> float:
    """Return by how many standard errors the correlation at one offset exceeds that at another.

    The standard error is that of the mean over stretches of the log, each under the offset's best rotation.
    """
    rates = _believable(imu, rates)
    order = np.argsort(rates.start_ns, kind="stable")
    rates = replace(rates, start_ns=rates.start_ns[order], end_ns=rates.end_ns[order], rates=rates.rates[order])
    gain = _products(imu, rates, offset_s) - _products(imu, rates, other_s)
    gain = gain[~np.isnan(gain)]
    if len(gain) < _LEAST_SAMPLES:
        return 0.0
    means = np.array([part.mean() for part in np.array_split(gain, _STRETCHES)])
    return float(means.mean() / max(means.std(ddof=1) / np.sqrt(_STRETCHES), 1e-12))


def _products(imu: ImuSamples, rates: TurnRates, offset_s: float) -> Array:
    """Return each turn's part (N,) of the correlation; NaN where the gyroscope has none."""
    cross, scale = _cross_covariances(imu, rates, np.array([offset_s]))
    rotation = _best_rotation(cross)[1][0]
    gyroscope = _Turned.of(imu).mean_rate(rates, offset_s)
    there = ~np.isnan(gyroscope[:, 0])
    gyroscope = gyroscope - gyroscope[there].mean(axis=0)
    turned = (rates.rates - rates.rates[there].mean(axis=0)) @ rotation.T
    return np.asarray(np.sum(gyroscope * turned, axis=1) / scale[0])


def _scores(imu: ImuSamples, rates: TurnRates, offsets_s: Array) -> Array:
    cross, variance = _cross_covariances(imu, rates, offsets_s)
    return np.asarray(_best_rotation(cross)[0] / variance)


def _refined(imu: ImuSamples, rates: TurnRates, coarse_s: float) -> float:
    """Return the top of a parabola through the best of a fine search and its neighbours."""
    search = coarse_s + np.arange(-_COARSE_S, _COARSE_S + 1e-9, _FINE_S)
    scores = _scores(imu, rates, search)
    best = int(np.argmax(scores))
    if not 0 < best < len(search) - 1:
        return float(search[best])
    left, middle, right = scores[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    return float(search[best]) + (_FINE_S * 0.5 * float((left - right) / bend) if bend < 0 else 0.0)


def _one(record) -> NDArray[np.int64]:  # type: ignore[no-untyped-def]
    return np.zeros(len(record), np.int64)


def _pairs(source: PoseSource) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    order = np.lexsort((source.stamps_ns, source.groups))
    stamps = source.stamps_ns[order]
    intervals = np.diff(np.unique(source.stamps_ns)) / 1e9
    if not intervals.size:
        return order[:0], order[:0]
    wanted = max(_BASELINE_S, float(np.median(intervals)))
    step = max(1, round(wanted / float(np.median(intervals))))
    first, second = order[:-step], order[step:]
    apart = (stamps[step:] - stamps[:-step]) / 1e9
    good = (source.groups[first] == source.groups[second]) & (apart > 0) & (apart < min(2.0 * wanted, _LONGEST_S))
    return first[good], second[good]


def _believable(imu: ImuSamples, rates: TurnRates) -> TurnRates:
    """Leave out turns that no gyroscope reading comes near: flips of the pose sensor."""
    speed = np.linalg.norm(rates.rates, axis=1)
    centred = imu.angular_velocity - np.median(imu.angular_velocity, axis=0)
    fastest = max(3.0 * float(np.percentile(np.linalg.norm(centred, axis=1), 99)), 0.3)
    inside = (rates.start_ns >= imu.stamps_ns[0]) & (rates.end_ns <= imu.stamps_ns[-1]) & (speed < fastest)
    return replace(rates, start_ns=rates.start_ns[inside], end_ns=rates.end_ns[inside], rates=rates.rates[inside])


@dataclass(frozen=True)
class _Turned:
    """The integral of the gyroscope over time."""

    start_ns: int
    seconds: Array
    angle: Array

    @classmethod
    def of(cls, imu: ImuSamples) -> _Turned:
        seconds = (imu.stamps_ns - imu.stamps_ns[0]) / 1e9
        steps = 0.5 * (imu.angular_velocity[1:] + imu.angular_velocity[:-1]) * np.diff(seconds)[:, None]
        return cls(int(imu.stamps_ns[0]), seconds, np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]))

    def mean_rate(self, rates: TurnRates, offset_s: float) -> Array:
        """Return the gyroscope's mean over each interval moved by an offset, (N, 3); NaN outside its span."""
        start = (rates.start_ns - self.start_ns) / 1e9 + offset_s
        end = (rates.end_ns - self.start_ns) / 1e9 + offset_s
        mean = (self._at(end) - self._at(start)) / (end - start)[:, None]
        mean[(start < 0.0) | (end > self.seconds[-1])] = np.nan
        return mean

    def _at(self, seconds: Array) -> Array:
        after = np.clip(np.searchsorted(self.seconds, seconds), 1, len(self.seconds) - 1)
        before = after - 1
        share = (seconds - self.seconds[before]) / (self.seconds[after] - self.seconds[before])
        return self.angle[before] + share[:, None] * (self.angle[after] - self.angle[before])


def _cross_covariances(imu: ImuSamples, rates: TurnRates, offsets_s: Array) -> tuple[Array, Array]:
    """Return C (K, 3, 3) = cov(w_imu, w_pose) and sqrt(var w_imu var w_pose) (K,), at each offset."""
    cross, scale = np.zeros((len(offsets_s), 3, 3)), np.full(len(offsets_s), np.inf)
    turned = _Turned.of(imu)
    for k, offset in enumerate(offsets_s):
        gyroscope = turned.mean_rate(rates, float(offset))
        there = ~np.isnan(gyroscope[:, 0])
        if there.sum() < max(_LEAST_SAMPLES, 0.3 * len(there)):
            continue
        a, b = gyroscope[there], rates.rates[there]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        cross[k] = a.T @ b / len(a)
        scale[k] = max(np.sqrt(np.sum(a**2) * np.sum(b**2)) / len(a), 1e-12)
    return cross, scale


def _best_rotation(cross: Array) -> tuple[Array, Array]:
    """Return trace(R^T C) at its largest over rotations, (K,), and those rotations."""
    u, singular, vt = np.linalg.svd(cross)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    signs = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    return np.sum(singular * signs, axis=-1), (u * signs[:, None, :]) @ vt


def _scale(imu: ImuSamples, rates: TurnRates, offset_s: float, R_imu_body: Array) -> float:
    """Return the gyroscope over the turn rates; the regression on the gyroscope is not shrunk by the poses' noise."""
    gyroscope = _Turned.of(imu).mean_rate(rates, offset_s)
    there = ~np.isnan(gyroscope[:, 0])
    a, b = gyroscope[there], rates.rates[there] @ R_imu_body.T
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    slope = float(np.sum(a * b) / max(np.sum(a * a), 1e-12))
    return 1.0 / slope if slope > 1e-6 else float("inf")
