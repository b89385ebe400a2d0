"""A known motion as a smooth spline, and the IMU samples that it causes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import RigidTransform, Rotation, RotationSpline

from poet_loc.core.geometry import make_pose
from poet_loc.core.records import ImuSamples
from poet_loc.core.trajectory import Trajectory

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class Motion:
    """A twice differentiable motion of the imu: a quintic spline in position, scipy's C2 spline in rotation."""

    start_ns: int
    end_ns: int
    position: BSpline
    rotation: RotationSpline

    @classmethod
    def through(cls, trajectory: Trajectory) -> Motion:
        """Return the motion that passes exactly through six or more poses T_world_imu."""
        seconds = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
        poses = trajectory.T_world_body
        return cls(
            int(trajectory.stamps_ns[0]),
            int(trajectory.stamps_ns[-1]),
            make_interp_spline(seconds, poses.translation, k=5),
            RotationSpline(seconds, poses.rotation),
        )

    def _seconds(self, stamps_ns: Stamps) -> Array:
        return np.asarray((np.asarray(stamps_ns) - self.start_ns) * 1e-9, dtype=float)

    def pose(self, stamps_ns: Stamps) -> RigidTransform:
        """Return T_world_imu at N stamps."""
        seconds = self._seconds(stamps_ns)
        return make_pose(self.rotation(seconds), self.position(seconds))

    def velocity(self, stamps_ns: Stamps) -> Array:
        """Return (N, 3) velocities in world axes, m/s."""
        return np.asarray(self.position(self._seconds(stamps_ns), nu=1))

    def imu_samples(self, stamps_ns: Stamps) -> ImuSamples:
        """Return what a perfect IMU reads: the angular velocity and specific force *at* each stamp.

        The values are instantaneous, not means over the interval before the stamp; the specific force is
        R_world_imu^T (acceleration - gravity), so that a level IMU at rest reads +9.81 on z.
        """
        seconds = self._seconds(stamps_ns)
        rotation: Rotation = self.rotation(seconds)
        acceleration = self.position(seconds, nu=2)
        return ImuSamples(
            np.asarray(stamps_ns, dtype=np.int64),
            np.asarray(self.rotation(seconds, 1)),
            rotation.apply(acceleration - GRAVITY, inverse=True),
        )


def look_at(eyes: Array, targets: Array, roll: Array) -> RigidTransform:
    """Return N poses T_world_cam whose z axis points at the target and whose x axis is level before the roll.

    eyes and targets (N, 3) in m, roll (N,) in rad about the viewing axis.
    """
    z_axis = targets - eyes
    z_axis /= np.linalg.norm(z_axis, axis=1, keepdims=True)
    x_axis = np.cross(z_axis, [0.0, 0.0, 1.0])
    x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
    y_axis = np.cross(z_axis, x_axis)
    level = Rotation.from_matrix(np.stack([x_axis, y_axis, z_axis], axis=-1))
    return make_pose(level * Rotation.from_rotvec(roll[:, None] * [0.0, 0.0, 1.0]), eyes)


def hand_held_flight(
    start_ns: int, duration_s: float, rest_s: float, T_cam_imu: RigidTransform, rng: np.random.Generator
) -> Motion:
    """Return a hand-held flight around a table-top at the world's origin that starts with rest_s seconds at rest.

    The camera swings around the table at about 0.9 m and half a metre per second, looks at a point that wanders over
    it, and trembles by a few millimetres and a degree at 1-3 Hz.
    """
    seconds = np.arange(0.0, duration_s + 0.04, 0.04)
    own_time = _time_after_rest(seconds, rest_s)

    def wander(*amplitudes_and_periods: tuple[float, float]) -> Array:
        waves = [
            amplitude * np.sin(2.0 * np.pi * own_time / period + rng.uniform(0.0, 2.0 * np.pi))
            for amplitude, period in amplitudes_and_periods
        ]
        return np.asarray(np.sum(waves, axis=0))

    azimuth = rng.uniform(-np.pi, np.pi) + wander((1.2, 17.0), (0.35, 7.3), (0.004, 0.45))
    radius = 0.80 + wander((0.10, 11.0), (0.05, 4.1), (0.003, 0.38))
    height = 0.55 + wander((0.12, 13.0), (0.04, 5.3), (0.003, 0.52))
    eyes = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
    targets = np.stack(
        [wander((0.08, 9.1), (0.01, 0.7)), wander((0.08, 7.7), (0.01, 0.6)), 0.05 + wander((0.03, 8.3))], axis=1
    )
    T_world_cam = look_at(eyes, targets, wander((0.12, 6.1), (0.03, 2.3), (0.008, 0.5)))
    stamps_ns = start_ns + np.round(seconds * 1e9).astype(np.int64)
    return Motion.through(Trajectory(stamps_ns, T_world_cam * T_cam_imu))


def _time_after_rest(seconds: Array, rest_s: float, ease_s: float = 2.0) -> Array:
    """Return a clock that stands for rest_s and then runs up to normal speed over ease_s (quintic smoothstep)."""
    share = np.clip((seconds - rest_s) / ease_s, 0.0, 1.0)
    eased = ease_s * (share**6 - 3.0 * share**5 + 2.5 * share**4)
    return np.asarray(eased + np.maximum(seconds - rest_s - ease_s, 0.0))
