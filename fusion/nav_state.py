"""The state, its error, named slices, retract and local.

The nominal state is one flat float64 array, so that compiled loops, snapshots and the plain reference share it:

    core       R_world_imu (9, row-major), p_world_imu (3), v_world_imu (3), gyroscope bias (3), accelerometer bias (3)
    beside it  T_imu_cam (9 + 3), time offset (1), gravity in world axes (3), T_world_obj (12) and bias (6) per object,
               the clone (12): T_world_imu at the last odometry, and where there are biases, per object how far they
               spread (4): factors of rotation, across and along the ray, and how many detections these stand on

The error state holds the core's 15 components always, then what is switched on:
[attitude, position, velocity, gyroscope bias, accelerometer bias | extrinsics 6 | time offset 1 | gravity 2 |
 objects 6 each | biases 6 each | clone 6].
Rotation errors are on the right (R_true = R Exp(theta)), everything else is additive in the axes it is stored in; but
the clone's error, of the imu's pose at the last odometry, is in world axes about the world's origin
(R_true = Exp(xi) R, p_true = Exp(xi) p + rho), so that a correction of the attitude leaves its meaning as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose, pose_from_quaternion

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Places in the nominal array.
ROTATION, POSITION, VELOCITY, GYRO_BIAS, ACCEL_BIAS = 0, 9, 12, 15, 18
EXTRINSIC_ROTATION, EXTRINSIC_POSITION, TIME_OFFSET, GRAVITY, OBJECTS = 21, 30, 33, 34, 37
OBJECT_SIZE = 12
SPREAD_SIZE, SPREAD_COUNT = 4, 3

# Places in the error state.
POSITION_ERROR, VELOCITY_ERROR, GYRO_BIAS_ERROR, ACCEL_BIAS_ERROR = 3, 6, 9, 12  # the attitude's comes first
CORE = 15

# Places in the integer layout that the compiled loops read; -1 there means switched off.
(
    N_ERROR,
    N_NOMINAL,
    N_OBJECTS,
    AT_EXTRINSICS,
    AT_TIME_OFFSET,
    AT_GRAVITY,
    AT_OBJECTS,
    N_BIAS_KINDS,
    AT_BIASES,
    BIASES,
    AT_CLONE,
    CLONE,
    SPREADS,
    LAYOUT_SIZE,
) = range(14)


@dataclass(frozen=True)
class StateLayout:
    """Which states exist and where they stand."""

    n_objects: int = 0
    extrinsics: bool = False
    time_offset: bool = False
    gravity: bool = False
    objects: bool = False
    bias_kinds: int = 0
    """Bias states per object: 0 none, 1 slowly varying, 2 a constant one beside it."""
    clone: bool = False
    """The pose at the last odometry, which odometry beside an IMU measures against."""

    def _starts(self) -> dict[str, int]:
        starts, at = {}, CORE
        sizes = {
            "extrinsics": 6 * self.extrinsics,
            "time_offset": 1 * self.time_offset,
            "gravity": 2 * self.gravity,
            "objects": 6 * self.n_objects * self.objects,
            "biases": 6 * self.n_objects * self.bias_kinds,
            "clone": 6 * self.clone,
        }
        for name, size in sizes.items():
            starts[name] = at if size else -1
            at += size
        return starts | {"end": at}

    @property
    def n_error(self) -> int:
        """Size of the error state."""
        return self._starts()["end"]

    @property
    def n_nominal(self) -> int:
        """Size of the nominal array."""
        return self.spread_start + SPREAD_SIZE * self.n_objects * (self.bias_kinds > 0)

    @property
    def spread_start(self) -> int:
        """Where the factors of the objects' biases start in the nominal array."""
        return self.clone_start + 12 * self.clone

    @property
    def clone_start(self) -> int:
        """Where the clone starts in the nominal array."""
        return self.bias_start + 6 * self.n_objects * self.bias_kinds

    @property
    def bias_start(self) -> int:
        """Where the object biases start in the nominal array."""
        return OBJECTS + OBJECT_SIZE * self.n_objects

    def error_slice(self, name: str, index: int = 0, kind: int = 0) -> slice:
        """Return where an optional part stands in the error state.

        name: extrinsics, time_offset, gravity, objects, biases or clone; index: which object; kind: which bias.
        Raises KeyError for a part that is switched off.
        """
        start = self._starts()[name]
        if start < 0:
            raise KeyError(f"{name} is not in the state")
        size = {"time_offset": 1, "gravity": 2}.get(name, 6)
        return slice(start + size * (index + kind * self.n_objects), start + size * (index + kind * self.n_objects + 1))

    def nominal_bias(self, index: int, kind: int = 0) -> slice:
        """Return where an object's bias [rotation 3, translation 3] stands in the nominal array."""
        start = self.bias_start + 6 * (index + kind * self.n_objects)
        return slice(start, start + 6)

    def as_integers(self) -> Ints:
        """Return the layout as the compiled loops read it."""
        starts = self._starts()
        return np.array(
            [
                self.n_error,
                self.n_nominal,
                self.n_objects,
                starts["extrinsics"],
                starts["time_offset"],
                starts["gravity"],
                starts["objects"],
                self.bias_kinds,
                starts["biases"],
                self.bias_start,
                starts["clone"],
                self.clone_start,
                self.spread_start,
            ],
            dtype=np.int64,
        )


def pose_at(x: Array, start: int) -> RigidTransform:
    """Return the pose that stands in the nominal array as rotation (9) and position (3)."""
    rotation = Rotation.from_matrix(x[start : start + 9].reshape(3, 3))
    return RigidTransform.from_components(x[start + 9 : start + 12], rotation)


def put_pose(x: Array, start: int, T: RigidTransform) -> None:
    """Write a pose into the nominal array as rotation (9) and position (3)."""
    x[start : start + 9] = T.rotation.as_matrix().ravel()
    x[start + 9 : start + 12] = T.translation


def nominal_state(
    layout: StateLayout,
    *,
    T_world_imu: RigidTransform | None = None,
    T_imu_cam: RigidTransform | None = None,
    T_world_obj: RigidTransform | None = None,
    gravity: float = 9.81,
) -> Array:
    """Return a nominal array with the given poses, zero velocity, zero biases, gravity (0, 0, -g) m/s^2."""
    x = np.zeros(layout.n_nominal)
    identity = pose_from_quaternion(np.zeros(3), [0, 0, 0, 1])
    put_pose(x, ROTATION, identity if T_world_imu is None else T_world_imu)
    put_pose(x, EXTRINSIC_ROTATION, identity if T_imu_cam is None else T_imu_cam)
    x[GRAVITY : GRAVITY + 3] = (0.0, 0.0, -gravity)
    for k in range(layout.n_objects if T_world_obj is not None else 0):
        put_pose(x, OBJECTS + OBJECT_SIZE * k, T_world_obj[k])  # type: ignore[index]
    if layout.clone:
        put_pose(x, layout.clone_start, identity)
    if layout.bias_kinds:
        x[layout.spread_start :] = np.tile([1.0, 1.0, 1.0, 0.0], layout.n_objects)
    return x


def gravity_tangent(gravity: Array) -> Array:
    """Return the (3, 2) basis of the directions in which gravity may turn, scaled so that its errors are in rad.

    A gravity error e turns gravity g into g + B e to first order, with |g| kept.
    """
    g = np.asarray(gravity, dtype=float)
    norm = float(np.linalg.norm(g))
    down = g / norm
    helper = np.array([1.0, 0.0, 0.0]) if abs(down[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(down, helper)
    first /= np.linalg.norm(first)
    second = np.cross(down, first)
    return norm * np.stack([first, second], axis=1)


def retract_state(x: Array, error: Array, layout: StateLayout) -> Array:
    """Return the nominal array moved by an error state: rotations on the right, the rest added."""
    moved = x.copy()

    def turn(start: int, theta: Array) -> None:
        R = x[start : start + 9].reshape(3, 3) @ Rotation.from_rotvec(theta).as_matrix()
        moved[start : start + 9] = R.ravel()

    turn(ROTATION, error[:3])
    moved[POSITION:EXTRINSIC_ROTATION] += error[POSITION_ERROR:CORE]
    if layout.extrinsics:
        part = error[layout.error_slice("extrinsics")]
        turn(EXTRINSIC_ROTATION, part[:3])
        moved[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3] += part[3:]
    if layout.time_offset:
        moved[TIME_OFFSET] += error[layout.error_slice("time_offset")][0]
    if layout.gravity:
        g = x[GRAVITY : GRAVITY + 3]
        turned = g + gravity_tangent(g) @ error[layout.error_slice("gravity")]
        moved[GRAVITY : GRAVITY + 3] = turned * (np.linalg.norm(g) / np.linalg.norm(turned))
    for k in range(layout.n_objects):
        if layout.objects:
            part = error[layout.error_slice("objects", k)]
            turn(OBJECTS + OBJECT_SIZE * k, part[:3])
            moved[OBJECTS + OBJECT_SIZE * k + 9 : OBJECTS + OBJECT_SIZE * (k + 1)] += part[3:]
        for kind in range(layout.bias_kinds):
            moved[layout.nominal_bias(k, kind)] += error[layout.error_slice("biases", k, kind)]
    if layout.clone:
        xi, rho = np.split(error[layout.error_slice("clone")], 2)
        put_pose(moved, layout.clone_start, make_pose(Rotation.from_rotvec(xi), rho) * pose_at(x, layout.clone_start))
    return moved


def local_state(x_from: Array, x_to: Array, layout: StateLayout) -> Array:
    """Return the error state that takes one nominal array into another, the inverse of `retract_state`."""
    error = np.zeros(layout.n_error)

    def turn(start: int) -> Array:
        R = x_from[start : start + 9].reshape(3, 3).T @ x_to[start : start + 9].reshape(3, 3)
        return np.asarray(Rotation.from_matrix(R).as_rotvec())

    error[:3] = turn(ROTATION)
    error[POSITION_ERROR:CORE] = (x_to - x_from)[POSITION:EXTRINSIC_ROTATION]
    if layout.extrinsics:
        part = layout.error_slice("extrinsics")
        error[part] = np.r_[turn(EXTRINSIC_ROTATION), (x_to - x_from)[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3]]
    if layout.time_offset:
        error[layout.error_slice("time_offset")] = x_to[TIME_OFFSET] - x_from[TIME_OFFSET]
    if layout.gravity:
        g_from, g_to = x_from[GRAVITY : GRAVITY + 3], x_to[GRAVITY : GRAVITY + 3]
        basis = gravity_tangent(g_from)
        along = g_to @ g_from / (g_from @ g_from)
        error[layout.error_slice("gravity")] = np.linalg.pinv(basis) @ (g_to / along - g_from)
    for k in range(layout.n_objects):
        if layout.objects:
            start = OBJECTS + OBJECT_SIZE * k
            shift = (x_to - x_from)[start + 9 : start + OBJECT_SIZE]
            error[layout.error_slice("objects", k)] = np.r_[turn(start), shift]
        for kind in range(layout.bias_kinds):
            error[layout.error_slice("biases", k, kind)] = (x_to - x_from)[layout.nominal_bias(k, kind)]
    if layout.clone:
        moved = pose_at(x_to, layout.clone_start) * pose_at(x_from, layout.clone_start).inv()
        error[layout.error_slice("clone")] = np.r_[moved.rotation.as_rotvec(), moved.translation]
    return error
