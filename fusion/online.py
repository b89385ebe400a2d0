"""The filter as a robot runs it: fed sample by sample, in any order within a horizon, asked for its state at any time.

No threads, no waiting: each call returns when everything that can be said by then has been worked out, in one compiled
call. A pose waits until the IMU has reached its stamp. What comes late is put in its place (`fusion/replay.py`), so the
numbers are those of `fuse.run_filter` on the whole log, whatever the order of arrival.

    estimator = Estimator(calibration, landmark_map)
    estimator.feed_imu(stamp_ns, angular_velocity, specific_force)
    estimator.feed_object_poses(stamp_ns, object_ids, positions, q_xyzw)
    state = estimator.state()  # None until it has started
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import memory, replay, replay_memory
from fusion.bias_spread import white_part
from fusion.calibrated import Calibrated, calibrated
from fusion.health import Mode, ObjectHealth, mode_of
from fusion.known_errors import known_errors
from fusion.measurements import (
    BEFORE_POSES,
    CAMERA_POSE,
    OBJECT_POSE,
    ODOMETRY_STEP,
    Measurements,
    ray_aligned_covariance,
)
from fusion.motion_source import odometry_spread, scaled_noise
from fusion.nav_state import ACCEL_BIAS, CORE, GYRO_BIAS, POSITION, VELOCITY, StateLayout
from fusion.noise_scale import widening
from fusion.online_input import ImuClock, OnlineOptions, shaped, vector, whole_numbers
from fusion.options import FuseOptions
from fusion.place_watch import (
    IN_A_ROW,
    LONGEST,
    ON_MAP,
    POSES,
    POSITION_USED,
    RATIO,
    ROTATION_USED,
    STATUS,
    TESTED,
)
from fusion.prepare import NEAREST_OBJECT, Problem, fill_memory, layout_for
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, ImuSamples, LandmarkMap
from poet_loc.io.pose_columns import not_positive_definite

Array = NDArray[np.float64]
_NO_OBJECT = np.array([-1])


@dataclass(frozen=True)
class OnlineState:
    """What the filter knows at the stamp of the newest IMU sample."""

    stamp_ns: int
    R_world_imu: Array
    """(3, 3)"""
    position: Array
    """(3,) p_world_imu, m."""
    velocity: Array
    """(3,) in world axes, m/s."""
    gyroscope_bias: Array
    """(3,) rad/s."""
    accelerometer_bias: Array
    """(3,) m/s^2."""
    covariance: Array
    """(15, 15) of [attitude (imu axes), position, velocity (world axes), gyroscope bias, accelerometer bias]."""
    mode: Mode
    """tracking, coasting or lost; how each object fares is said by `Estimator.health`."""

    @property
    def T_world_imu(self) -> RigidTransform:
        """Pose of the imu in the world."""
        return make_pose(Rotation.from_matrix(self.R_world_imu), self.position)

    @property
    def sigmas(self) -> Array:
        """(15,) 1-sigma of the error state."""
        return np.sqrt(np.diag(self.covariance).clip(min=0.0))


@dataclass(frozen=True)
class Health:
    """What became of the input so far."""

    mode: Mode
    restarts: int
    """How often the filter was lost and started again."""
    waiting: int
    """Poses that wait for the IMU to reach their stamp."""
    duplicates: int
    """Samples and poses that were there already: ignored."""
    too_late: int
    """Older than the horizon: refused."""
    too_early: int
    """Further ahead of the IMU than allowed: refused."""
    malformed: int
    """With numbers that are not finite, or a covariance that is not positive definite: refused."""
    overflowed: int
    """Did not fit into the buffers: refused."""
    not_in_map: int
    """Of objects that are not in the map, or behind the camera: ignored."""
    replays: int
    """How often something late was put in its place."""
    clock_jumps: int
    """How often the IMU's clock was set back and all before forgotten, these counts too."""
    noise_scale: tuple[float, float]
    """How many times larger than stated the poses' 1-sigma of rotation and of position is taken now."""
    objects: dict[tuple[int, int], ObjectHealth]
    """By (object_id, instance); (-1, 0) for camera poses."""


class Estimator:
    """The error-state filter on an IMU, fed one sample at a time.

    options.measurements says whether poses of objects (needs the map) or of the camera come in, options.motion
    (imu+odometry) whether odometry comes in beside the IMU; layout switches states
    on beyond what the options ask for. Raises InputError where calibration or map lack what the filter needs. It has no
    locks: calls from several threads need one around each.
    The first call compiles or loads the kernels: construct it, which does that, before the loop runs.
    """

    _estimator = "eskf"

    def __init__(
        self,
        calibration: Calibration | None,
        landmark_map: LandmarkMap | None = None,
        options: FuseOptions | None = None,
        online: OnlineOptions | None = None,
        layout: StateLayout | None = None,
    ) -> None:
        self.options, self.online = options or FuseOptions(), online or OnlineOptions()
        calibration = calibration or Calibration()
        if self.options.estimator != self._estimator or self.options.smooth:
            what = f"{type(self).__name__} is no {'smoother' if self.options.smooth else self.options.estimator}"
            raise InputError(what, fix="Estimator is the filter (eskf), GraphEstimator the fixed-lag graph (graph)")
        if self.options.camera_noise.correlation_s > 0.0:
            fix = "feed covariances that are so much wider (docs/why_is_my_filter_wrong.md)"
            raise InputError("camera-noise.correlation-s is of whole logs, whose rate is known", fix=fix)
        problem = empty_problem(calibration, landmark_map, self.options, layout)
        self.layout, self.keys = problem.layout, problem.keys
        self._floats, self._integers = fill_memory(problem, self.options)
        self.memory = memory.views.py_func(self._floats, self._integers)
        self._problem, self._shift_ns = problem, calibration.timeshift_ns
        self._landmarks = _landmark_numbers(self.keys)
        self._known_errors = known_errors(self.options.bias, landmark_map)
        noise = self.options.camera_noise
        self._camera_covariance = np.diag(
            np.repeat(np.array([math.radians(noise.rotation_deg), noise.position]) ** 2, 3)
        )
        self._first_state = self._floats[: int(self._integers[memory.END_OF_STATE])].copy()
        self.reset()

    def reset(self) -> None:
        """Forget everything that was fed."""
        self._clock = ImuClock(round(self.online.horizon_s * 1e9), self.online.clock_set_s * 1e9)
        self._clock_jumps = 0
        self._begin()

    def _begin(self) -> None:
        o = self.online
        self._floats[: len(self._first_state)] = self._first_state
        self.memory.counters[:] = 0
        poses = int((2.0 * o.horizon_s + o.ahead_s) * o.max_pose_rate_hz) + 2 * replay_memory.BATCH
        self._ring_floats, self._ring_integers = replay_memory.allocate_ring(
            self._floats,
            self._integers,
            2 * int(o.horizon_s * o.max_imu_rate_hz) + 64,
            poses,
            round(o.horizon_s * 1e9),
            round(o.ahead_s * 1e9),
            max(1, round(o.snapshot_s * 1e9)),
        )
        self._look_into_ring()
        self._not_in_map = 0
        self._odometry: tuple[int, Array, Array] | None = None
        self._feed(replay.POSES, 0, 0)

    def _look_into_ring(self) -> None:
        self._ring = replay_memory.ring_views.py_func(self._ring_floats, self._ring_integers)
        self._rate, self._force = self._ring.sample[:3], self._ring.sample[3:]

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Look into the arrays of a copy: copied one by one, the views would show others."""
        self.__dict__.update(state)
        self.memory = memory.views.py_func(self._floats, self._integers)
        self._look_into_ring()

    def feed_imu(self, stamp_ns: SupportsIndex, angular_velocity: ArrayLike, specific_force: ArrayLike) -> None:
        """Take in one IMU sample: (3,) rad/s and (3,) m/s^2 in imu axes.

        Raises ValueError for other shapes, InputError at the hundredth sample where the stamps are no nanoseconds.
        """
        stamp = operator.index(stamp_ns)
        rate, force = vector("angular_velocity", angular_velocity), vector("specific_force", specific_force)
        finite = math.isfinite(rate.dot(force))  # a broken sample's stamp says nothing of the clock
        if finite and self._clock.was_set(stamp):
            self._clock_jumps += 1
            self._begin()
        self._feed_sample(stamp, rate, force)

    def _feed_sample(self, stamp: int, rate: Array, force: Array) -> None:
        self._rate[:], self._force[:] = rate, force
        self._feed(replay.IMU_SAMPLE, stamp, 1)

    def feed_object_poses(
        self,
        stamp_ns: SupportsIndex,
        object_ids: ArrayLike,
        positions: ArrayLike,
        q_xyzw: ArrayLike,
        covariances: ArrayLike | None = None,
        instances: ArrayLike | None = None,
    ) -> None:
        """Take in the object poses T_cam_obj of one frame.

        stamp_ns on the camera's clock; object_ids (N,), positions (N, 3) m, quaternions (N, 4) scalar last,
        covariances (N, 6, 6) of [e_r, e_t] in camera axes (None, or a row of NaN: from the options), instances (N,).
        Of one object, N may be left out. Objects that are not in the map are ignored and counted. Raises ValueError
        for a zero quaternion, other shapes and ids, InputError where options.measurements is camera.
        """
        if self.options.measurements != "objects":
            raise InputError("this estimator fuses camera poses", fix="choose FuseOptions(measurements='objects')")
        ids = whole_numbers("object_ids", object_ids)
        t, q = shaped("positions", positions, len(ids), 3), shaped("q_xyzw", q_xyzw, len(ids), 4)
        stated = None if covariances is None else shaped("covariances", covariances, len(ids), 6, 6)
        which = np.zeros(len(ids)) if instances is None else shaped("instances", instances, len(ids))
        landmarks = np.array(
            [self._landmarks.get((int(i), int(k)), self._landmarks.get((int(i), -1), -1)) for i, k in zip(ids, which)],
            dtype=np.int64,
        )
        usable = (landmarks >= 0) & ~(t[:, 2] <= NEAREST_OBJECT)
        self._not_in_map += int(len(ids) - np.count_nonzero(usable))
        if not usable.all():
            landmarks, q, t = landmarks[usable], q[usable], t[usable]
            stated = None if stated is None else stated[usable]
        q, t = self._without_known_errors(landmarks, q, t)
        self._feed_poses(stamp_ns, OBJECT_POSE, landmarks, q, t, self._detection_covariances(t, stated))

    def feed_camera_pose(
        self, stamp_ns: SupportsIndex, position: ArrayLike, q_xyzw: ArrayLike, covariance: ArrayLike | None = None
    ) -> None:
        """Take in a camera pose T_world_cam.

        stamp_ns on the camera's clock, position (3,) m, quaternion (4,) scalar last, covariance (6, 6) of [e_r, e_t]
        with R = R_true Exp(e_r), t = t_true + e_t (None: from the options). Raises ValueError for a zero quaternion
        and other shapes.
        """
        R = shaped("covariance", self._camera_covariance if covariance is None else covariance, 1, 6, 6)
        q, t = shaped("q_xyzw", q_xyzw, 1, 4), shaped("position", position, 1, 3)
        R = np.where(not_positive_definite(R)[:, None, None], np.nan, R)
        self._feed_poses(stamp_ns, CAMERA_POSE, _NO_OBJECT, q, t, R)

    def feed_odometry(self, stamp_ns: SupportsIndex, position: ArrayLike, q_xyzw: ArrayLike) -> None:
        """Take in a camera pose T_odom_cam of odometry, of which only the motion since earlier ones is used.

        stamp_ns on the camera's clock, position (3,) m, quaternion (4,) scalar last. Odometry must come in its own
        order: what is not newer than the last is ignored; against poses and IMU it may be late. Raises InputError
        unless options.motion is imu+odometry, ValueError for a zero quaternion and other shapes.
        """
        if not self.layout.clone:
            raise InputError("there is no state to measure odometry against", fix="choose --motion imu+odometry")
        stamp = operator.index(stamp_ns)
        t, q = shaped("position", position, 1, 3)[0], shaped("q_xyzw", q_xyzw, 1, 4)[0]
        if not (q != 0.0).any():
            raise ValueError("a quaternion is zero")
        if not np.isfinite(q).all():  # odometry that has lost its way: refused and counted below
            t, q = np.full(3, np.nan), np.array([0.0, 0.0, 0.0, 1.0])
        R = Rotation.from_quat(q).as_matrix()
        then_ns, R_then, t_then = self._odometry or (stamp - 10**9, R, t)
        seconds = (stamp - then_ns) * 1e-9
        if seconds <= 0.0 or (self._odometry is not None and seconds < self.options.odometry.step_s - 1e-6):
            return
        refused, spread = self._refused(), seconds * odometry_spread(self.options)
        turned = Rotation.from_matrix(R_then.T @ R).as_quat().reshape(1, 4)
        moved = turned, (R_then.T @ (t - t_then)).reshape(1, 3), spread.reshape(1, 6, 6)
        self._feed_poses(stamp, ODOMETRY_STEP, np.array([BEFORE_POSES]), *moved)
        if self._refused() == refused:  # else the next one is measured against the same pose as this
            self._odometry = stamp, R, t

    def _refused(self) -> int:
        h = self._ring.header
        refusals = (replay_memory.TOO_LATE, replay_memory.TOO_EARLY, replay_memory.MALFORMED, replay_memory.OVERFLOWED)
        return sum(int(h[each]) for each in refusals)

    def state(self) -> OnlineState | None:
        """Return what is known at the newest IMU sample, None before the start."""
        m = self.memory
        if m.counters[memory.MODE] != memory.TRACKING:
            return None
        x = m.x[: GYRO_BIAS + 6].copy()
        return OnlineState(
            int(m.counters[memory.NOW]),
            x[:9].reshape(3, 3),
            x[POSITION : POSITION + 3],
            x[VELOCITY : VELOCITY + 3],
            x[GYRO_BIAS : GYRO_BIAS + 3],
            x[ACCEL_BIAS : ACCEL_BIAS + 3],
            m.P[:CORE, :CORE].copy(),
            self._mode(),
        )

    def health(self) -> Health:
        """Return the counts of everything that was fed, and how each object's poses have fared since the start."""
        h, counters = self._ring.header, self.memory.counters
        return Health(
            self._mode(),
            int(counters[memory.RESTARTS]),
            int(h[replay_memory.COUNT] - h[replay_memory.NEXT]),
            int(h[replay_memory.DUPLICATES]),
            int(h[replay_memory.TOO_LATE]),
            int(h[replay_memory.TOO_EARLY]),
            int(h[replay_memory.MALFORMED]),
            int(h[replay_memory.OVERFLOWED]),
            self._not_in_map,
            int(h[replay_memory.REPLAYS]),
            self._clock_jumps,
            widening(self.memory),
            self._object_health(),
        )

    def calibrated(self) -> Calibrated | None:
        """Return what options.estimate switches on, as it is known at the newest IMU sample; None if nothing is."""
        return calibrated(self.memory, self._problem)

    def _mode(self) -> Mode:
        m, c = self.memory, self.memory.counters
        if c[memory.MODE] != memory.TRACKING:
            return "initialising"
        sigma = math.sqrt(max(m.P[3, 3], m.P[4, 4], m.P[5, 5]))
        silent_s = (c[memory.NOW] - c[memory.LAST_UPDATE]) * 1e-9
        return mode_of(silent_s, sigma, int(c[memory.REFUSED_ROW]), self.options.health)

    def _object_health(self) -> dict[tuple[int, int], ObjectHealth]:
        rows, places = self.memory.tallies, self.memory.places
        keys = enumerate(self.keys[: self.layout.n_objects])
        found = {key: _object_health(rows[k], bool(places[k, STATUS] != ON_MAP)) for k, key in keys}
        if rows[-1, POSES]:
            found[-1, 0] = _object_health(rows[-1], False)
        return found

    def _without_known_errors(self, landmarks: NDArray[np.int64], q: Array, t: Array) -> tuple[Array, Array]:
        if self._known_errors is None:
            return q, t
        rows = (q != 0.0).any(axis=1) & np.isfinite(q).all(axis=1)  # others are refused later
        q, t = q.copy(), t.copy()
        R, t[rows] = self._known_errors.taken_off(landmarks[rows], Rotation.from_quat(q[rows]), t[rows])
        q[rows] = R.as_quat()
        return q, t

    def _detection_covariances(self, t: Array, covariances: Array | None) -> Array:
        noise, places = self.options.noise, np.where(np.isfinite(t), t, 1.0)
        sigma = math.radians(noise.rotation_deg)
        if covariances is None:
            return ray_aligned_covariance(places, noise.across, noise.along, sigma, noise.floor)
        given = covariances.copy()
        stated = np.isfinite(given).all(axis=(1, 2))
        white = white_part(given[stated], places[stated], noise, self.options.bias)
        given[stated] = np.where(not_positive_definite(given[stated])[:, None, None], np.nan, white)
        if stated.all():
            return given
        R = ray_aligned_covariance(places, noise.across, noise.along, sigma, noise.floor)
        R[stated] = given[stated]
        return R

    def _feed_poses(
        self, stamp_ns: SupportsIndex, kind: int, landmarks: NDArray[np.int64], q: Array, t_m: Array, R: Array
    ) -> None:
        stamp, r = operator.index(stamp_ns) + self._shift_ns, self._ring
        if not (q != 0.0).any(axis=1).all():
            raise ValueError("a quaternion is zero")
        for first in range(0, len(landmarks), replay_memory.BATCH):
            rows = slice(first, first + replay_memory.BATCH)
            n = len(landmarks[rows])
            r.new_kinds[:n], r.new_objects[:n] = kind, landmarks[rows]
            r.new_rotations[:n, :4] = q[rows]
            r.new_translations[:n], r.new_covariances[:n] = t_m[rows], R[rows]
            self._feed(replay.POSES, stamp, n)

    def _feed(self, what: int, stamp: int, count: int) -> None:
        replay.feed(self._floats, self._integers, self._ring_floats, self._ring_integers, what, stamp, count)


def _object_health(row: Array, released: bool) -> ObjectHealth:
    poses, tested = row[POSES], row[TESTED]
    return ObjectHealth(
        int(poses),
        row[POSITION_USED] / poses if poses else math.nan,
        row[ROTATION_USED] / poses if poses else math.nan,
        float(row[RATIO]) if tested else math.nan,
        int(row[IN_A_ROW]),
        int(row[LONGEST]),
        released,
    )


def empty_problem(
    calibration: Calibration, landmark_map: LandmarkMap | None, options: FuseOptions, layout: StateLayout | None
) -> Problem:
    """Return the problem of an estimator that has been fed nothing yet."""
    if options.motion not in ("auto", "imu", "imu+odometry"):
        raise InputError(f"the online estimator moves by an IMU, not by {options.motion}", fix="leave --motion out")
    if calibration.imu is None or calibration.T_cam_imu is None:
        raise InputError("fusion needs T_cam_imu and the IMU's noise densities", fix="add them to the calibration")
    if options.measurements == "objects" and landmark_map is None:
        fix = (
            "give landmark_map (of a recorded log, poet-loc fuse --estimate.map unknown finds it), or fuse camera poses"
        )
        raise InputError("object poses need a map", fix=fix)
    layout = layout or layout_for(landmark_map, options)
    nothing, none = np.empty(0), np.empty(0, dtype=np.int64)
    return Problem(
        Path("online"),
        ImuSamples(none, nothing.reshape(0, 3), nothing.reshape(0, 3)),
        scaled_noise(calibration.imu, options),
        calibration,
        Measurements(none, none, none, nothing.reshape(0, 9), nothing.reshape(0, 3), nothing.reshape(0, 6, 6)),
        replace(layout, clone=options.motion == "imu+odometry"),
        landmark_map,
    )


def _landmark_numbers(keys: list[tuple[int, int]]) -> dict[tuple[int, int], int]:
    """Return landmark numbers by (object_id, instance), and by (object_id, -1) where a class has one landmark only."""
    numbers = {key: k for k, key in enumerate(keys)}
    ids = [object_id for object_id, _ in keys]
    return numbers | {(object_id, -1): k for k, object_id in enumerate(ids) if ids.count(object_id) == 1}
