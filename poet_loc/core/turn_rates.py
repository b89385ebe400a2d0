"""Turn rates: mean angular velocities between two stamps each, from poses and from a gyroscope.

For poses of a body, w = Log(R_world_body(t)^T R_world_body(t + dt)) / dt; for detections the object takes the world's
place, R_cam_obj(t) R_cam_obj(t + dt)^T, and no map is needed. The gyroscope is averaged over the same interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from poet_loc.core.records import CameraPoses, ImuSamples, ObjectPoses
from poet_loc.core.trajectory import Trajectory

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

_BASELINE_S, _LONGEST_S = 0.2, 1.0
_MOST_STAMPS = 2500
"""Of more, so many are taken, evenly: they tell an offset to milliseconds."""


@dataclass(frozen=True)
class TurnRates:
    """Mean turn rates (N, 3) rad/s in body axes between two stamps each, by their start."""

    start_ns: Stamps
    end_ns: Stamps
    rates: Array

    def __len__(self) -> int:
        return len(self.start_ns)

    def __getitem__(self, rows: slice | NDArray[np.bool_]) -> TurnRates:
        return TurnRates(self.start_ns[rows], self.end_ns[rows], self.rates[rows])


@dataclass(frozen=True)
class PoseStream:
    """Rotations that turn with a camera or another body."""

    stamps_ns: Stamps
    groups: NDArray[np.int64]
    """(N,) rows of one group are rotations of one body; detections: one group per object."""
    rotations: Rotation
    of_object: bool
    """The rotations are R_cam_obj, not R_world_body."""

    @classmethod
    def of_detections(cls, poses: ObjectPoses) -> PoseStream:
        """Take what objects seen by a camera say of its turning."""
        ids, instances = (np.unique(each, return_inverse=True)[1] for each in (poses.object_ids, poses.instances))
        return cls(poses.stamps_ns, ids * len(poses) + instances, poses.T_cam_obj.rotation, True)

    @classmethod
    def of_camera_poses(cls, poses: CameraPoses) -> PoseStream:
        """Take T_world_cam."""
        return cls(poses.stamps_ns, np.zeros(len(poses), np.int64), poses.T_world_cam.rotation, False)

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory) -> PoseStream:
        """Take T_world_body."""
        rotations = trajectory.T_world_body.rotation
        return cls(trajectory.stamps_ns, np.zeros(len(trajectory), np.int64), rotations, False)


def turn_rates(stream: PoseStream) -> TurnRates:
    """Return the turn rates of a stream about a fifth of a second apart; of several objects the median."""
    first, second = _pairs(stream.stamps_ns, stream.groups)
    if not len(first):
        return TurnRates(stream.stamps_ns[:0], stream.stamps_ns[:0], np.zeros((0, 3)))
    one, two = stream.rotations[first], stream.rotations[second]
    turn = one * two.inv() if stream.of_object else one.inv() * two
    start, end = stream.stamps_ns[first], stream.stamps_ns[second]
    rates = np.reshape(turn.as_rotvec(), (-1, 3)) / ((end - start) / 1e9)[:, None]
    frames = np.unique(stream.stamps_ns)
    intervals = np.searchsorted(frames, start) * len(frames) + np.searchsorted(frames, end)
    intervals, row = np.unique(intervals, return_inverse=True)
    rates = _medians(rates, row, len(intervals))
    return TurnRates(frames[intervals // len(frames)], frames[intervals % len(frames)], rates)


def believable(imu: ImuSamples, rates: TurnRates) -> TurnRates:
    """Leave out turns that no gyroscope reading comes near: flips of the pose sensor."""
    speed = np.linalg.norm(rates.rates, axis=1)
    centred = imu.angular_velocity - np.median(imu.angular_velocity, axis=0)
    fastest = max(3.0 * float(np.percentile(np.linalg.norm(centred, axis=1), 99)), 0.3)
    return rates[(rates.start_ns >= imu.stamps_ns[0]) & (rates.end_ns <= imu.stamps_ns[-1]) & (speed < fastest)]


def _pairs(stamps_ns: Stamps, groups: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows at the ends of each turn: of one body, and apart by the multiple of its interval that fits."""
    order = np.lexsort((stamps_ns, groups))
    stamps, change = stamps_ns[order], np.diff(groups[order]) != 0
    between = np.diff(stamps)[~change]
    if not (between > 0).any():
        return order[:0], order[:0]
    interval = float(np.median(between[between > 0])) / 1e9
    wanted = max(_BASELINE_S, interval)
    bodies = np.r_[0, np.cumsum(change)]
    line = bodies * (np.ptp(stamps) + round(_LONGEST_S * 1e9)) + stamps - stamps.min()  # one body behind the other
    second = np.searchsorted(line, line + round((wanted - 0.5 * interval) * 1e9))
    first = np.flatnonzero(second < len(line))
    first = first[line[second[first]] - line[first] < min(2.0 * wanted, _LONGEST_S) * 1e9]
    frames = np.unique(stamps)
    if len(frames) > _MOST_STAMPS:
        first = first[np.searchsorted(frames, stamps[first]) % -(-len(frames) // _MOST_STAMPS) == 0]
    return order[first], order[second[first]]


def _medians(values: Array, row: NDArray[np.int64], count: int) -> Array:
    """Return the median (count, 3) of the values (N, 3) that belong to each row."""
    sizes = np.bincount(row, minlength=count)
    begin = np.cumsum(sizes) - sizes
    found = np.empty((count, values.shape[1]))
    for axis in range(values.shape[1]):
        ordered = values[np.lexsort((values[:, axis], row)), axis]
        found[:, axis] = 0.5 * (ordered[begin + (sizes - 1) // 2] + ordered[begin + sizes // 2])
    return found


@dataclass(frozen=True)
class GyroscopeIntegral:
    """The integral of a gyroscope over time."""

    start_ns: int
    seconds: Array
    angle: Array
    """(N, 3) rad."""
    rate: Array
    """(N-1, 3) rad/s, between two samples."""

    @classmethod
    def of(cls, imu: ImuSamples) -> GyroscopeIntegral:
        """Integrate by the trapezoidal rule."""
        seconds = (imu.stamps_ns - imu.stamps_ns[0]) / 1e9
        rate = 0.5 * (imu.angular_velocity[1:] + imu.angular_velocity[:-1])
        angle = np.vstack([np.zeros(3), np.cumsum(rate * np.diff(seconds)[:, None], axis=0)])
        return cls(int(imu.stamps_ns[0]), seconds, angle, rate)

    def mean_rate(self, rates: TurnRates, offset_s: float) -> Array:
        """Return the gyroscope's mean over each interval moved by an offset, (N, 3); NaN outside its span."""
        return self.mean_rate_and_slope(rates, offset_s)[0]

    def mean_rate_and_slope(self, rates: TurnRates, offset_s: float) -> tuple[Array, Array]:
        """Return those means and their derivative by the offset, rad/s^2."""
        start = (rates.start_ns - self.start_ns) / 1e9 + offset_s
        end = (rates.end_ns - self.start_ns) / 1e9 + offset_s
        (angle_then, rate_then), (angle, rate) = self.at(start), self.at(end)
        seconds = (end - start)[:, None]
        mean, slope = (angle - angle_then) / seconds, (rate - rate_then) / seconds
        mean[(start < 0.0) | (end > self.seconds[-1])] = np.nan
        return mean, slope

    def at(self, seconds: Array) -> tuple[Array, Array]:
        """Return the integral and the rate, (N, 3) each, at times (N,) since its start."""
        before = np.clip(np.searchsorted(self.seconds, seconds), 1, len(self.seconds) - 1) - 1
        rate = self.rate[before]
        return self.angle[before] + (seconds - self.seconds[before])[:, None] * rate, rate


def around(imu: ImuSamples, rates: TurnRates, margin_s: float) -> ImuSamples:
    """Return the samples from margin_s before the first turn to margin_s after the last."""
    if not len(rates):
        return imu
    margin = round(margin_s * 1e9)
    first, last = np.searchsorted(imu.stamps_ns, [rates.start_ns.min() - margin, rates.end_ns.max() + margin])
    return imu[max(int(first) - 1, 0) : int(last) + 1]
