"""The fixed-lag graph as a robot runs it: fed sample by sample, asked for its state at any time.

A pose that comes late by less than the lag is put in its place: filter and graph as they were before it are kept for so
long, and everything since is done again. So the numbers are those of `fuse` on the whole log, whatever the order of
arrival.

    estimator = GraphEstimator(calibration, landmark_map)
    estimator.feed_imu(stamp_ns, angular_velocity, specific_force)
    estimator.feed_object_poses(stamp_ns, object_ids, positions, q_xyzw)
    state = estimator.state()  # None until it has started
"""

from __future__ import annotations

import operator
from collections import deque
from dataclasses import dataclass, replace
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion import memory
from fusion.columns import Columns, Fitted
from fusion.fuse import loop_columns
from fusion.graph_fixed import new_builder
from fusion.graph_motion import MotionChain
from fusion.graph_smoother import FixedLagSmoother
from fusion.graph_walk import HERE, IMU_ROW, NEXT, ROWS, Walk
from fusion.imu_noise import REACH, follow_noise
from fusion.measurements import Measurements
from fusion.nav_state import StateLayout
from fusion.noise_scale import widening
from fusion.online import Estimator, Health
from fusion.online_input import OnlineOptions
from fusion.options import FuseOptions
from fusion.prepare import Problem
from poet_loc.core.records import Calibration, ImuSamples, LandmarkMap

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass
class _Kept:
    """Filter and graph at one stamp."""

    now: int
    floats: Array
    integers: Ints
    cursor: Ints
    fresh: Array
    first: int
    smoother: FixedLagSmoother | None


class GraphEstimator(Estimator):
    """The fixed-lag graph on an IMU, fed one sample at a time; the horizon for what comes late is `graph.lag_s`.

    Takes what `online.Estimator` takes; IMU samples must come in order. Raises InputError where calibration or map lack
    what the filter needs.
    """

    _estimator = "graph"

    def __init__(
        self,
        calibration: Calibration,
        landmark_map: LandmarkMap | None = None,
        options: FuseOptions | None = None,
        online: OnlineOptions | None = None,
        layout: StateLayout | None = None,
    ) -> None:
        options = options or FuseOptions()
        if options.estimator == "eskf":  # the default
            options = replace(options, estimator="graph")
        super().__init__(calibration, landmark_map, options, online, layout)

    def __getstate__(self) -> dict[str, Any]:
        raise TypeError("a GraphEstimator cannot be copied; construct another and feed it the same")

    def _begin(self) -> None:
        self._lag_ns = round(self.options.graph.lag_s * 1e9)
        self._snapshot_ns = max(1, round(self.online.snapshot_s * 1e9))
        self._ahead_ns = round(self.online.ahead_s * 1e9)
        self._walk = Walk(self._problem, self.options)
        self.memory = self._walk.memory
        seconds = 2.0 * self.options.graph.lag_s + self.online.ahead_s + 1.0
        poses = int(seconds * self.online.max_pose_rate_hz)
        samples = int(seconds * self.online.max_imu_rate_hz)
        self._room, self._walk.out = loop_columns(_room_for(self._problem, samples, poses))
        self._fitted = Fitted(np.zeros((poses, 9)), np.zeros((poses, 6, 6)), np.ones((poses, 3)), np.zeros(poses))
        self._samples = self._poses = 0
        self._chain = MotionChain.of(self._problem, self.options)
        self._smoother: FixedLagSmoother | None = None
        self._newest: FixedLagSmoother | None = None
        self._kept: deque[_Kept] = deque()
        self._not_in_map = self._duplicates = self._too_late = self._too_early = self._malformed = 0
        self._overflowed = self._replays = 0
        self._odometry: tuple[int, Array, Array] | None = None

    def _feed_sample(self, stamp: int, rate: Array, force: Array) -> None:
        newest = int(self._room.imu_stamps[self._samples - 1]) if self._samples else stamp - 1
        if not np.isfinite([*rate, *force]).all():
            self._malformed += 1
        elif stamp == newest:
            self._duplicates += 1
        elif stamp < newest:
            self._too_late += 1
        else:
            if self._samples == len(self._room.imu_stamps):
                self._trim()
            n = self._samples
            self._room.imu_stamps[n], self._room.imu_values[n, :3], self._room.imu_values[n, 3:6] = stamp, rate, force
            follow_noise(self._room.imu_stamps, self._room.imu_values, n, n + 1)
            self._samples += 1
            self._run()

    def health(self) -> Health:
        """Return the counts of everything that was fed, and how each object's poses have fared since the start."""
        return Health(
            self._mode(),
            int(self.memory.counters[memory.RESTARTS]),
            self._poses - int(self._walk.cursor[NEXT]),
            self._duplicates,
            self._too_late,
            self._too_early,
            self._malformed,
            self._overflowed,
            self._not_in_map,
            self._replays,
            self._clock_jumps,
            widening(self.memory),
            self._object_health(),
        )

    def _feed_poses(self, stamp_ns: SupportsIndex, kind: int, landmarks: Ints, q: Array, t_m: Array, R: Array) -> None:
        stamp = operator.index(stamp_ns) + self._shift_ns
        if not (q != 0.0).any(axis=1).all():
            raise ValueError("a quaternion is zero")
        sound = np.asarray(np.isfinite(np.hstack([q, t_m, R.reshape(-1, 36)])).all(axis=1))
        self._malformed += int(np.count_nonzero(~sound))
        R_m = Rotation.from_quat(np.where(sound[:, None], q, 1.0)).as_matrix().reshape(-1, 9)
        put = [self._put(stamp, kind, int(landmarks[i]), R_m[i], t_m[i], R[i]) for i in np.flatnonzero(sound)]
        if any(put) and self._walk.begun and stamp <= self.memory.counters[memory.NOW]:
            self._restore(stamp)
        self._run()

    def _refused(self) -> int:
        return self._too_late + self._too_early + self._malformed + self._overflowed

    def _put(self, stamp: int, kind: int, k: int, R_m: Array, t_m: Array, R: Array) -> bool:
        """Put a pose in its place by stamp and landmark; tell whether it is taken."""
        room, n = self._room, self._poses
        if self._samples and stamp - int(room.imu_stamps[self._samples - 1]) > self._ahead_ns:
            self._too_early += 1
            return False
        if self._kept and stamp <= self._kept[0].now:
            self._too_late += 1
            return False
        at = int(np.searchsorted(room.stamps[:n], stamp))
        while at < n and room.stamps[at] == stamp and room.objects[at] <= k:
            if self._is_at(at, kind, k, R_m, t_m):
                self._duplicates += 1
                return False
            at += 1
        if n == len(room.stamps):
            self._trim()
            at, n = at - (n - self._poses), self._poses
        if n == len(room.stamps):
            self._overflowed += 1
            return False
        columns: tuple[NDArray[Any], ...] = room[2:8]
        values: tuple[Any, ...] = (stamp, kind, k, R_m, t_m, R)
        for column, value in zip(columns, values, strict=True):
            column[at + 1 : n + 1] = column[at:n].copy()
            column[at] = value
        self._poses += 1
        return True

    def _is_at(self, at: int, kind: int, k: int, R_m: Array, t_m: Array) -> bool:
        """Tell whether the pose at a place is this one; a landmark may be seen twice at a stamp."""
        room = self._room
        same = room.kinds[at] == kind and room.objects[at] == k
        return same and np.array_equal(room.rotations[at], R_m) and np.array_equal(room.translations[at], t_m)

    def _run(self) -> None:
        """Do all that can be done with what has come."""
        if self._samples == 0:
            return
        walk, room, n, m = self._walk, self._room, self._samples, self._poses
        filled: list[Any] = [column[: n if i < 2 else m] for i, column in enumerate(room)]
        walk.columns = Columns(*filled)
        walk.fitted = Fitted(*(column[:m] for column in self._fitted))
        if not walk.begun:
            walk.begin()
            self._keep(taken_in=False)
        walk.cursor[ROWS] = 0
        while (keyframe := walk.next_keyframe(to_the_end=False)) is not None:
            chain = replace(self._chain, stamps_ns=room.imu_stamps[:n], values=room.imu_values[:n])
            if keyframe.started or keyframe.found_again or self._smoother is None:
                builder = new_builder(self.layout, self.memory, chain, self.options.graph)
                self._smoother = FixedLagSmoother(builder, self.options.graph)
                self._smoother.start(keyframe, walk)
            else:
                self._smoother.builder.chain = chain
                self._smoother.extend(keyframe, walk)
            self._newest = self._smoother.kept()
            self._keep()
            walk.cursor[ROWS] = 0
        if self.memory.counters[memory.NOW] - self._kept[-1].now >= self._snapshot_ns:
            self._keep()

    def _keep(self, taken_in: bool = True) -> None:
        """Keep filter and graph as they are, and drop what no late pose can ask for.

        taken_in: a pose at this very stamp would come late.
        """
        walk, now = self._walk, int(self.memory.counters[memory.NOW]) - (not taken_in)
        whole = walk.floats.copy(), walk.integers.copy()  # with the votes and what was used of them
        kept = _Kept(now, *whole, walk.cursor.copy(), walk.fresh.copy(), walk.first, self._newest)
        self._kept.append(kept)
        while len(self._kept) > 1 and self._kept[1].now <= now - self._lag_ns:
            self._kept.popleft()

    def _restore(self, before_ns: int) -> None:
        """Go back to the newest that was kept before a stamp."""
        while self._kept[-1].now >= before_ns:
            self._kept.pop()
        kept, walk = self._kept[-1], self._walk
        walk.floats[:], walk.integers[:] = kept.floats, kept.integers
        walk.cursor[:], walk.fresh[:] = kept.cursor, kept.fresh
        walk.first = kept.first
        if kept.smoother is not self._newest:  # keyframes are undone
            self._newest = kept.smoother
            self._smoother = None if kept.smoother is None else kept.smoother.revived()
        self._replays += 1

    def _trim(self) -> None:
        """Drop samples and poses from before everything that is kept."""
        if not self._kept:
            return
        room, oldest, imu_at = self._room, self._kept[0], int(self._walk.integers[memory.AT_COUNTERS]) + memory.IMU_AT
        since = oldest.now if oldest.smoother is None else min(oldest.now, oldest.smoother.builder.stamp_ns)
        samples = max(0, int(np.searchsorted(room.imu_stamps[: self._samples], since)) - REACH)
        poses = int(oldest.cursor[NEXT]) if oldest.smoother is None else oldest.first
        for i, column in enumerate((*room, *self._fitted)):
            gone = samples if i < 2 else poses
            column[: len(column) - gone] = column[gone:].copy()
        self._samples, self._poses = self._samples - samples, self._poses - poses
        self._walk.first = max(0, self._walk.first - poses)
        for kept in self._kept:
            kept.first = max(0, kept.first - poses)
        for cursor in (self._walk.cursor, *(kept.cursor for kept in self._kept)):
            cursor[[IMU_ROW, NEXT, HERE]] -= (samples, poses, poses)
        for integers in (self._walk.integers, *(kept.integers for kept in self._kept)):
            integers[imu_at] -= samples


def _room_for(problem: Problem, samples: int, poses: int) -> Problem:
    """Return the problem with room for so many samples and poses."""
    imu = ImuSamples(np.zeros(samples, dtype=np.int64), np.zeros((samples, 3)), np.zeros((samples, 3)))
    whole, rows = np.zeros(poses, dtype=np.int64), (np.zeros((poses, 9)), np.zeros((poses, 3)), np.zeros((poses, 6, 6)))
    measured = Measurements(whole, whole.copy(), whole.copy(), *rows)
    return replace(problem, imu=imu, measurements=measured)
