"""The compiled half of the graph's factors: motion between stamps, a detection's error and Jacobian; no gtsam here."""

from __future__ import annotations

import numpy as np

from fusion.compiled import njit
from fusion.imu import mean_until, propagate_nominal
from fusion.measurements import MAX_COLUMNS, OBJECT_POSE, residual_and_jacobian, write_bias_axes
from fusion.nav_state import (
    AT_EXTRINSICS,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    BIASES,
    EXTRINSIC_POSITION,
    EXTRINSIC_ROTATION,
    GRAVITY,
    GYRO_BIAS,
    N_BIAS_KINDS,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    SPREAD_SIZE,
    SPREADS,
    TIME_OFFSET,
    VELOCITY,
    Array,
    Ints,
)
from fusion.object_biases import BIAS_JUMP, BIAS_MODEL_SIZE, bias_phi, bias_sigma, fades
from fusion.odometry import move_by_odometry
from fusion.so3_kernels import apply, apply_transposed, copy, multiply

# Places in a motion between two stamps: seconds, R_first_second, displacement and velocity free of gravity.
SECONDS, TURN, SHIFT, SPEED, MOTION_SIZE = 0, 1, 10, 13, 16

# Columns of a detection's Jacobian: pose, velocity, extrinsics, object, time offset, then six per bias.
VELOCITY_COLUMNS, EXTRINSIC_COLUMNS, OBJECT_COLUMNS, OFFSET_COLUMN, BIAS_COLUMNS = 6, 9, 15, 21, 22


@njit(cache=True)
def imu_between(
    imu_stamps: Ints, imu_values: Array, start: int, end: int, biases: Array, longest_s: float, out: Array
) -> tuple[int, float]:
    """Write the IMU between two stamps as steps [seconds, rate, force] (7 columns); return how many, and s^2 in gaps.

    Rate and force are means of each step; the force is turned by half of the step's turn (biases: gyroscope,
    accelerometer), so that an integrator that holds the attitude of a step's start sees the middle's. The sum over
    gaps is of step times interval, in intervals longer than longest_s.
    """
    x, work, mean = np.zeros(OBJECTS), np.zeros(64), np.zeros(6)
    k = np.searchsorted(imu_stamps, start, side="right") - 1
    now, count, gaps = start, 0, 0.0
    while now < end:
        stop, interval = mean_until(imu_stamps, imu_values, k, now, end, mean), imu_stamps[k + 1] - imu_stamps[k]
        dt = (stop - now) * 1e-9
        for i in range(9):
            x[i] = 1.0 if i % 4 == 0 else 0.0
        for i in range(6):
            x[GYRO_BIAS + i] = biases[i]
            out[count, 1 + i] = mean[i]
        propagate_nominal(x, dt, mean[0:3], mean[3:6], work)
        out[count, 0] = dt
        for i in range(3):
            out[count, 4 + i] = work[24 + i] + biases[3 + i]
        if interval * 1e-9 > longest_s:
            gaps += dt * interval * 1e-9
        now, count, k = stop, count + 1, k + 1
    return count, gaps


@njit(cache=True)
def motion_between(stamps: Ints, values: Array, start: int, end: int, biases: Array, odometry: bool) -> Array:
    """Return the motion (MOTION_SIZE,) between two stamps, without gravity and first velocity, as the samples saw it.

    values (N, 6): the IMU's, or odometry's twists.
    """
    x, work, motion, mean = np.zeros(OBJECTS), np.zeros(64), np.zeros(MOTION_SIZE), np.zeros(6)
    for i in range(9):
        x[i] = 1.0 if i % 4 == 0 else 0.0
    for i in range(6):
        x[GYRO_BIAS + i] = biases[i]
    k = np.searchsorted(stamps, start, side="right") - 1
    now = start
    while now < end:
        stop = mean_until(stamps, values, k, now, end, mean)
        dt = (stop - now) * 1e-9
        if odometry:
            move_by_odometry(x, dt, values[k, 0:3], values[k, 3:6], work)
        else:
            propagate_nominal(x, dt, mean[0:3], mean[3:6], work)
        now, k = stop, k + 1
    motion[SECONDS] = 0.0 if odometry else (end - start) * 1e-9
    copy(x, motion[TURN : TURN + 9])
    copy(x[POSITION:], motion[SHIFT : SHIFT + 3])
    if not odometry:
        copy(x[VELOCITY:], motion[SPEED : SPEED + 3])
    return motion


@njit(cache=True)
def seen_at(k: int, motion: Array, x: Array) -> Array:
    """Return where (3,) an object is in the camera a motion after the nominal array x."""
    then, p_io, p_co, at = np.copy(x), np.zeros(3), np.zeros(3), OBJECTS + OBJECT_SIZE * k
    move(then, motion)
    p_wi, p_wo = then[POSITION : POSITION + 3], x[at + 9 : at + 12]
    apply_transposed(then, p_wo[0] - p_wi[0], p_wo[1] - p_wi[1], p_wo[2] - p_wi[2], p_io)
    for i in range(3):
        p_io[i] -= x[EXTRINSIC_POSITION + i]
    apply_transposed(x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9], p_io[0], p_io[1], p_io[2], p_co)
    return p_co


@njit(cache=True)
def rate_at(stamps: Ints, values: Array, stamp: int, gyro_bias: Array) -> Array:
    """Return the unbiased angular velocity (3,) at a stamp."""
    k = int(np.searchsorted(stamps, stamp, side="right")) - 1
    k = k - 1 if k == len(stamps) - 1 else k
    share = (stamp - stamps[k]) / (stamps[k + 1] - stamps[k])
    rate = np.empty(3)
    for i in range(3):
        rate[i] = values[k, i] + share * (values[k + 1, i] - values[k, i]) - gyro_bias[i]
    return rate


@njit(cache=True)
def bias_step(bias_model: Array, kind: int, mean: Array, seconds: float, left: Array, sigma: Array) -> None:
    """Write by what factor and 1-sigma, each (6,), a bias with this mean changes in some seconds."""
    model = kind * BIAS_MODEL_SIZE
    for i in range(6):
        phi = bias_phi(bias_model, kind, i, seconds)
        stays = phi < 1.0 and not fades(mean, 0, i - i % 3, kind, bias_model)
        left[i] = 1.0 if stays else phi
        sigma[i] = np.sqrt(1.0 - phi * phi) * bias_sigma(bias_model, kind, i)
        sigma[i] *= bias_model[model + BIAS_JUMP] if stays else 1.0


@njit(cache=True, _nrt=True)
def detection_error(
    kind: int,
    k: int,
    first: int,
    size: int,
    R_m: Array,
    t_m: Array,
    rate: Array,
    motion: Array,
    T_world_imu: Array,
    velocity: Array,
    T_imu_cam: Array,
    T_world_obj: Array,
    time_offset: float,
    biases: Array,
    place: Array,
    x: Array,
    layout: Ints,
) -> tuple[Array, Array]:
    """Return predicted minus measured (rows first..first+size of [rotation, translation]) and its Jacobian.

    Seen `motion` after the pose (4, 4) with its velocity (3,), at an angular velocity rate (3,); extrinsics and object
    (4, 4), time offset (s) and biases (kinds, 6) as they are now; x: a nominal array, scratch but for gravity
    and spreads.
    Jacobian columns as named above; poses in gtsam's tangent [rotation, translation in body axes].

    A bias shifts the position by D(place) b (`measurements`), place (3,) p_cam_obj as it was when the factor was made.
    At the position that is estimated, a bias of the same size explains more the further the object is, so that whatever
    maximises the joint probability of both pushes objects away: on real logs by 3 %.
    """
    axes, shifted = np.zeros(9), np.copy(t_m)
    put(x, 0, T_world_imu)
    put(x, EXTRINSIC_ROTATION, T_imu_cam)
    x[TIME_OFFSET] = time_offset
    for i in range(3):
        x[VELOCITY + i] = velocity[i]
    if kind == OBJECT_POSE:
        put(x, OBJECTS + OBJECT_SIZE * k, T_world_obj)
        write_bias_axes(place, axes)
        spread = layout[SPREADS] + SPREAD_SIZE * k
        for i in range(9 if len(biases) else 0):
            axes[i] *= x[spread + (2 if i % 3 == 2 else 1)]
        for i in range(len(biases)):
            at, b = layout[BIASES] + 6 * (k + i * layout[N_OBJECTS]), biases[i]
            for j in range(3):
                x[at + j], x[at + 3 + j] = b[j], 0.0
                shifted[j] -= axes[3 * j] * b[3] + axes[3 * j + 1] * b[4] + axes[3 * j + 2] * b[5]
    e, J = error_and_jacobian(kind, k, first, size, R_m, shifted, rate, motion, x, layout)
    for i in range(3 * len(biases)):
        for r in range(max(0, 3 - first), size):
            J[r, BIAS_COLUMNS + 6 * (i // 3) + 3 + i % 3] = axes[3 * (first + r - 3) + i % 3]
    return e, J


@njit(cache=True, _nrt=True)
def error_and_jacobian(
    kind: int, k: int, first: int, size: int, R_m: Array, t_m: Array, rate: Array, motion: Array, x: Array, layout: Ints
) -> tuple[Array, Array]:
    """Return error and Jacobian as `detection_error` does, of a nominal array, which the motion then has carried on.

    Biases act at the object's position, as in the filter: for a graph that linearises nothing twice.
    """
    work, residual, H = np.zeros(256), np.zeros(6), np.zeros((6, MAX_COLUMNS))
    columns, biases = np.zeros(MAX_COLUMNS, dtype=np.int64), 6 * layout[N_BIAS_KINDS]
    R_k = np.copy(x[0:9])
    move(x, motion)
    residual_and_jacobian(kind, k, R_m, t_m, x, rate, 0.0, layout, residual, H, columns, work)
    J = np.zeros((size, BIAS_COLUMNS + biases))
    at = 6
    if layout[AT_EXTRINSICS] >= 0:
        _body_columns(H, at, J, EXTRINSIC_COLUMNS, first, x, EXTRINSIC_ROTATION)
        at += 6
    if kind == OBJECT_POSE:
        if layout[AT_OBJECTS] >= 0:
            _body_columns(H, at, J, OBJECT_COLUMNS, first, x, OBJECTS + OBJECT_SIZE * k)
            at += 6
        for r in range(size):
            for c in range(biases):
                J[r, BIAS_COLUMNS + c] = H[first + r, at + c]
        at += biases
    _pose_columns(H, J, first, R_k, motion, at if layout[AT_TIME_OFFSET] >= 0 else -1)
    return -residual[first : first + size], J


@njit(cache=True)
def move(x: Array, motion: Array) -> None:
    """Carry the nominal state over a motion: R <- R D, p <- p + v dt + R s + g dt^2 / 2, v <- v + R u + g dt."""
    dt, R, step = motion[SECONDS], np.copy(x[0:9]), np.zeros(3)
    apply(R, motion[SHIFT], motion[SHIFT + 1], motion[SHIFT + 2], step)
    for i in range(3):
        x[POSITION + i] += dt * x[VELOCITY + i] + step[i] + 0.5 * dt * dt * x[GRAVITY + i]
    apply(R, motion[SPEED], motion[SPEED + 1], motion[SPEED + 2], step)
    for i in range(3):
        x[VELOCITY + i] += step[i] + dt * x[GRAVITY + i]
    multiply(R, motion[TURN : TURN + 9], x[0:9])


@njit(cache=True)
def put(x: Array, at: int, T: Array) -> None:
    """Write a (4, 4) pose into the nominal array."""
    for i in range(3):
        for j in range(3):
            x[at + 3 * i + j] = T[i, j]
        x[at + 9 + i] = T[i, 3]


@njit(cache=True)
def _body_columns(H: Array, source: int, J: Array, to: int, first: int, x: Array, pose: int) -> None:
    """Copy six columns of a pose whose translation part is taken in its own axes from here on: dp = R rho."""
    for r in range(len(J)):
        for c in range(3):
            J[r, to + c] = H[first + r, source + c]
            total = 0.0
            for i in range(3):
                total += H[first + r, source + 3 + i] * x[pose + 3 * i + c]
            J[r, to + 3 + c] = total


@njit(cache=True)
def _pose_columns(H: Array, J: Array, first: int, R: Array, motion: Array, velocity_at: int) -> None:
    """Refer the columns at the detection's stamp to the keyframe's pose and velocity.

    theta_t = D^T theta, dp_t = R rho + dt dv - R [s]x theta, dv_t = dv - R [u]x theta (see `move`). velocity_at is
    where H has the columns of velocity and time offset, -1 where it has none.
    """
    dt, body = motion[SECONDS], np.zeros(3)
    for r in range(len(J)):
        h, row = H[first + r], J[r]
        for c in range(3):
            for i in range(3):
                row[c] += h[i] * motion[TURN + 3 * c + i]
            row[3 + c] = h[3] * R[c] + h[4] * R[3 + c] + h[5] * R[6 + c]
            row[VELOCITY_COLUMNS + c] = dt * h[3 + c]
        _minus_cross(row, row[3:6], motion[SHIFT : SHIFT + 3])
        if velocity_at >= 0:
            for c in range(3):
                row[VELOCITY_COLUMNS + c] += h[velocity_at + c]
                body[c] = h[velocity_at] * R[c] + h[velocity_at + 1] * R[3 + c] + h[velocity_at + 2] * R[6 + c]
            _minus_cross(row, body, motion[SPEED : SPEED + 3])
            row[OFFSET_COLUMN] = h[velocity_at + 3]


@njit(cache=True, inline="always")
def _minus_cross(row: Array, a: Array, s: Array) -> None:
    row[0] -= a[1] * s[2] - a[2] * s[1]
    row[1] -= a[2] * s[0] - a[0] * s[2]
    row[2] -= a[0] * s[1] - a[1] * s[0]
