"""What can be measured: camera pose and object pose, each as rotation rows and position rows.

One vocabulary for filter and graph. A measurement is a row of `Measurements`; its residual is [rotation, translation]:

    object pose  R_measured = Exp(e_r) Exp(b_r) R_cam_obj, t_measured = p_cam_obj + D(p_cam_obj) b_t + e_t
                 R_cam_obj = R_ic^T R_wi^T R_wo,  p_cam_obj = R_ic^T (R_wi^T (p_wo - p_wi) - p_ic)
    camera pose  R_measured = R_world_cam Exp(e_r), t_measured = p_world_cam + e_t
                 R_world_cam = R_wi R_ic,  p_world_cam = p_wi + R_wi p_ic
    odometry     R_measured = R_then_cam Exp(e_r), t_measured = p_then_cam + e_t, of the camera now in that of the last
                 odometry, which the state keeps as a clone of the imu's pose

with white errors e and, for objects, slowly varying biases b, all in camera axes. A pose network errs in depth and in
where it sees the object, so b_t = (x, y, depth) shifts the image by x and y (rad) and stretches the distance:
D(p) b_t = (x p_z, y p_z, -x p_x - y p_y) + depth p. It is taken at the predicted position: at the measured one the
noise would correlate with its own Jacobian, and that drives the depth bias off without bound.
Position rows do not touch the object's rotation, so a wrong rotation can be refused alone.
Rotation only and position only are the same rows, taken by half; an object symmetric about an axis keeps the two
rotation rows across it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fusion.compiled import njit
from fusion.nav_state import (
    AT_BIASES,
    AT_CLONE,
    AT_EXTRINSICS,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    CLONE,
    EXTRINSIC_POSITION,
    EXTRINSIC_ROTATION,
    N_BIAS_KINDS,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    POSITION_ERROR,
    TIME_OFFSET,
    VELOCITY,
    VELOCITY_ERROR,
    Ints,
)
from fusion.object_rows import (
    bias_position_rows,
    put,
    sum_biases,
    transposed_times_skew,
    write_bias_columns,
    write_object_residual,
    write_position_rows,
    write_rotation_rows,
)
from fusion.so3_kernels import (
    apply,
    apply_transposed,
    exp_so3,
    left_jacobian_inverse,
    log_so3,
    multiply,
    multiply_transposed_left,
    multiply_transposed_right,
    times_skew,
)

Array = NDArray[np.float64]
CAMERA_POSE, OBJECT_POSE, ODOMETRY_STEP = 0, 1, 2
BEFORE_POSES = -2  # what odometry has in the place of a landmark: sorts it before the poses of its stamp
MAX_COLUMNS = 34  # attitude 3, position 3, extrinsics 6, object 6, two biases 12, velocity 3, time offset 1


@dataclass(frozen=True)
class Measurements:
    """Measurements in order of time, as columns."""

    stamps_ns: NDArray[np.int64]
    """(M,) on the IMU's clock, with the calibration's time shift already added."""
    kinds: NDArray[np.int64]
    """(M,) CAMERA_POSE, OBJECT_POSE or ODOMETRY_STEP; of one stamp, odometry comes first."""
    objects: NDArray[np.int64]
    """(M,) index of the landmark, -1 for a camera pose, BEFORE_POSES for odometry."""
    rotations: Array
    """(M, 9) row-major: R_cam_obj, R_world_cam or R_then_cam."""
    translations: Array
    """(M, 3) m."""
    covariances: Array
    """(M, 6, 6) of [e_r, e_t], rad^2 and m^2."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def merged(cls, first: Measurements, second: Measurements) -> Measurements:
        """Return two sets in order of time; of one stamp, those of the first set come first."""
        order = np.argsort(np.r_[first.stamps_ns, second.stamps_ns], kind="stable")
        names = [each.name for each in fields(cls)]
        return cls(*(np.concatenate([getattr(first, name), getattr(second, name)])[order] for name in names))


def viewing_axes(translations: Array) -> Array:
    """Return axes [across x, across y, along] of the rays to points in camera axes, (..., 3) -> (..., 3, 3)."""
    t = np.asarray(translations, dtype=float)
    along = t / np.linalg.norm(t, axis=-1, keepdims=True)
    across_x = np.stack([along[..., 2], np.zeros(t.shape[:-1]), -along[..., 0]], axis=-1)
    norm = np.linalg.norm(across_x, axis=-1, keepdims=True)
    across_x = np.where(norm > 1e-9, across_x / np.maximum(norm, 1e-9), [1.0, 0.0, 0.0])
    return np.stack([across_x, np.cross(along, across_x), along], axis=-1)


def ray_aligned_covariance(
    translations: Array, across: float, along: float, rotation: float, floor: float = 0.0
) -> Array:
    """Return (N, 6, 6) covariances of object poses that err mostly along the viewing ray.

    translations (N, 3) in m; across and along: 1-sigma as a share of the distance; rotation: 1-sigma in rad per axis;
    floor: 1-sigma (m) in every direction beside them.
    """
    axes = viewing_axes(translations)
    sigma = np.linalg.norm(translations, axis=-1)[:, None] * np.array([across, across, along])
    covariances = np.zeros((len(translations), 6, 6))
    covariances[:, :3, :3] = rotation**2 * np.eye(3)
    covariances[:, 3:, 3:] = (axes * (sigma[:, None, :] ** 2 + floor**2)) @ np.swapaxes(axes, 1, 2)
    return covariances


@njit(cache=True)
def write_bias_axes(p: Array, out: Array) -> None:
    """Write D(p), the (3, 3) derivative of a biased position by its translation bias, into out (9,)."""
    out[0], out[1], out[2] = p[2], 0.0, p[0]
    out[3], out[4], out[5] = 0.0, p[2], p[1]
    out[6], out[7], out[8] = -p[0], -p[1], p[2]


@njit(cache=True)
def camera_in_world(
    x: Array, seconds: float, angular_velocity: Array, R_wi: Array, p_wi: Array, R_wc: Array, work: Array
) -> None:
    """Write where imu and camera are, `seconds` after the state, moving on at constant velocity and turn rate."""
    exp_so3(seconds * angular_velocity[0], seconds * angular_velocity[1], seconds * angular_velocity[2], work)
    multiply(x, work, R_wi)
    for i in range(3):
        p_wi[i] = x[POSITION + i] + seconds * x[VELOCITY + i]
    multiply(R_wi, x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9], R_wc)


@njit(cache=True)
def object_in_world(
    x: Array, seconds: float, angular_velocity: Array, R_m: Array, t_m: Array, T_wo: Array, work: Array
) -> None:
    """Write where a detection, `seconds` after the state, shows its object: R_world_obj (9), p_world_obj (3).

    Leaves R_world_cam in work[9:18].
    """
    R_wi, R_wc, p_wi, lever, away = work[0:9], work[9:18], work[18:21], work[30:33], work[33:36]
    camera_in_world(x, seconds, angular_velocity, R_wi, p_wi, R_wc, work[21:30])
    multiply(R_wc, R_m, T_wo)
    apply(R_wi, x[EXTRINSIC_POSITION], x[EXTRINSIC_POSITION + 1], x[EXTRINSIC_POSITION + 2], lever)
    apply(R_wc, t_m[0], t_m[1], t_m[2], away)
    for i in range(3):
        T_wo[9 + i] = p_wi[i] + lever[i] + away[i]


@njit(cache=True)
def residual_and_jacobian(
    kind: int,
    k: int,
    R_m: Array,
    t_m: Array,
    x: Array,
    angular_velocity: Array,
    nominal_offset: float,
    layout: Ints,
    residual: Array,
    H: Array,
    columns: Ints,
    work: Array,
) -> int:
    """Write residual (6,), Jacobian blocks H (6, MAX_COLUMNS) and their error-state columns; return how many.

    The residual is measured minus predicted, H the derivative of the prediction: residual(x (+) d) = residual(x) - H d.
    k is the object, R_m (9,) and t_m (3,) the measurement, angular_velocity (3,) the unbiased rate at its stamp,
    nominal_offset the time offset (s) with which it was stamped.
    """
    R_wi, R_wc, p_wi = work[0:9], work[9:18], work[18:21]
    seconds = x[TIME_OFFSET] - nominal_offset
    camera_in_world(x, seconds, angular_velocity, R_wi, p_wi, R_wc, work[21:30])
    for i in range(6):
        for j in range(MAX_COLUMNS):
            H[i, j] = 0.0
    count = _columns(0, 0, 3, columns)
    count = _columns(count, POSITION_ERROR, 3, columns)
    if layout[AT_EXTRINSICS] >= 0:
        count = _columns(count, layout[AT_EXTRINSICS], 6, columns)
    if kind == ODOMETRY_STEP:  # both its ends move with the time offset
        _odometry_step(x, R_m, t_m, layout, count, residual, H, work)
        return _columns(count, layout[AT_CLONE], 6, columns)
    if kind == CAMERA_POSE:
        _camera_pose(x, R_m, t_m, R_wi, R_wc, p_wi, layout, residual, H, work[30:])
    else:
        if layout[AT_OBJECTS] >= 0:
            count = _columns(count, layout[AT_OBJECTS] + 6 * k, 6, columns)
        start = count
        for bias in range(layout[N_BIAS_KINDS]):
            at = layout[AT_BIASES] + 6 * (k + bias * layout[N_OBJECTS])
            count = _columns(count, at, 6, columns)
        _object_pose(x, k, R_m, t_m, R_wi, R_wc, p_wi, layout, start, residual, H, work[30:])
    if layout[AT_TIME_OFFSET] >= 0:
        count = _time_offset_columns(x, seconds, angular_velocity, layout, H, columns, count, work)
    return count


@njit(cache=True)
def _columns(count: int, first: int, size: int, columns: Ints) -> int:
    for i in range(size):
        columns[count + i] = first + i
    return count + size


@njit(cache=True)
def _time_offset_columns(
    x: Array, seconds: float, angular_velocity: Array, layout: Ints, H: Array, columns: Ints, count: int, work: Array
) -> int:
    """Add the columns of velocity and time offset, and refer the attitude columns to the state's own time."""
    turn = work[21:30]
    exp_so3(seconds * angular_velocity[0], seconds * angular_velocity[1], seconds * angular_velocity[2], turn)
    for i in range(6):
        total = 0.0
        for j in range(3):
            H[i, count + j] = seconds * H[i, 3 + j]
            total += H[i, j] * angular_velocity[j] + H[i, 3 + j] * x[VELOCITY + j]
        H[i, count + 3] = total
        # R Exp(theta) Exp(w s) = R Exp(w s) Exp(Exp(-w s) theta)
        h0, h1, h2 = H[i, 0], H[i, 1], H[i, 2]
        for j in range(3):
            H[i, j] = h0 * turn[3 * j] + h1 * turn[3 * j + 1] + h2 * turn[3 * j + 2]
    count = _columns(count, VELOCITY_ERROR, 3, columns)
    return _columns(count, layout[AT_TIME_OFFSET], 1, columns)


@njit(cache=True)
def _camera_pose(
    x: Array,
    R_m: Array,
    t_m: Array,
    R_wi: Array,
    R_wc: Array,
    p_wi: Array,
    layout: Ints,
    residual: Array,
    H: Array,
    work: Array,
) -> None:
    R_ic, p_ic = x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9], x[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3]
    difference, inverse, block, lever = work[0:9], work[9:18], work[18:27], work[27:30]
    multiply_transposed_left(R_wc, R_m, difference)
    log_so3(difference, residual)
    apply(R_wi, p_ic[0], p_ic[1], p_ic[2], lever)
    for i in range(3):
        residual[3 + i] = t_m[i] - p_wi[i] - lever[i]
        H[3 + i, 3 + i] = 1.0
    left_jacobian_inverse(residual[0], residual[1], residual[2], 1.0, inverse)
    multiply_transposed_right(inverse, R_ic, block)
    put(H, 0, 0, 1.0, block)
    times_skew(R_wi, p_ic[0], p_ic[1], p_ic[2], block)
    put(H, 3, 0, -1.0, block)
    if layout[AT_EXTRINSICS] >= 0:
        put(H, 0, 6, 1.0, inverse)
        put(H, 3, 9, 1.0, R_wi)


@njit(cache=True)
def _odometry_step(
    x: Array, R_m: Array, t_m: Array, layout: Ints, at_clone: int, residual: Array, H: Array, work: Array
) -> None:
    """Write residual and Jacobian of the camera's motion since the clone; C = R_world_cam then, s = p_world_cam now."""
    start = layout[CLONE]
    R_ic, p_ic = x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9], x[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3]
    C, R_wc, R_tc, block = work[0:9], work[9:18], work[18:27], work[27:36]
    inverse, s, then, t = work[36:45], work[45:48], work[48:51], work[51:54]
    multiply(x[start : start + 9], R_ic, C)
    multiply(x[0:9], R_ic, R_wc)
    multiply_transposed_left(C, R_wc, R_tc)
    apply(x[0:9], p_ic[0], p_ic[1], p_ic[2], s)
    apply(x[start : start + 9], p_ic[0], p_ic[1], p_ic[2], then)
    for i in range(3):
        s[i] += x[POSITION + i]
        then[i] += x[start + 9 + i]
    apply_transposed(C, s[0] - then[0], s[1] - then[1], s[2] - then[2], t)
    multiply_transposed_left(R_tc, R_m, block)
    log_so3(block, residual)
    for i in range(3):
        residual[3 + i] = t_m[i] - t[i]
    left_jacobian_inverse(residual[0], residual[1], residual[2], 1.0, inverse)
    multiply_transposed_right(inverse, R_ic, block)
    put(H, 0, 0, 1.0, block)
    multiply_transposed_right(inverse, R_wc, block)
    put(H, 0, at_clone, -1.0, block)
    transposed_times_skew(C, s, block)
    put(H, 3, at_clone, 1.0, block)
    for i in range(3):
        for j in range(3):
            H[3 + i, 3 + j] = C[3 * j + i]
            H[3 + i, at_clone + 3 + j] = -C[3 * j + i]
    multiply_transposed_left(C, x[0:9], R_wc)
    times_skew(R_wc, p_ic[0], p_ic[1], p_ic[2], block)
    put(H, 3, 0, -1.0, block)
    if layout[AT_EXTRINSICS] >= 0:
        multiply_transposed_right(inverse, R_tc, block)
        for i in range(3):
            for j in range(3):
                H[i, 6 + j] = inverse[3 * i + j] - block[3 * i + j]
                H[3 + i, 9 + j] = R_wc[3 * i + j] - R_ic[3 * j + i]
        H[3, 7], H[3, 8], H[4, 6] = -t[2], t[1], t[2]
        H[4, 8], H[5, 6], H[5, 7] = -t[0], -t[1], t[0]


@njit(cache=True)
def _object_pose(
    x: Array,
    k: int,
    R_m: Array,
    t_m: Array,
    R_wi: Array,
    R_wc: Array,
    p_wi: Array,
    layout: Ints,
    bias_start: int,
    residual: Array,
    H: Array,
    work: Array,
) -> None:
    """Write residual and Jacobian of an object's pose in the camera; p_io, p_co is the object from IMU and camera."""
    R_ic, p_ic = x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9], x[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3]
    at, at_object = OBJECTS + OBJECT_SIZE * k, 12 if layout[AT_EXTRINSICS] >= 0 else 6
    R_co, p_io, p_co, axes = work[0:9], work[36:39], work[39:42], work[42:51]
    inverse, bias, spread = work[51:60], work[60:66], work[66:69]
    multiply_transposed_left(R_wc, x[at : at + 9], R_co)
    apply_transposed(R_wi, x[at + 9] - p_wi[0], x[at + 10] - p_wi[1], x[at + 11] - p_wi[2], p_io)
    apply_transposed(R_ic, p_io[0] - p_ic[0], p_io[1] - p_ic[1], p_io[2] - p_ic[2], p_co)
    write_bias_axes(p_co, axes)
    sum_biases(x, k, layout, bias, spread)
    write_object_residual(R_m, t_m, R_co, p_co, axes, bias, residual, work)
    left_jacobian_inverse(residual[0], residual[1], residual[2], -1.0, inverse)
    write_rotation_rows(R_ic, R_co, inverse, layout, at_object, H, work)
    write_position_rows(R_ic, R_wc, p_io, p_co, layout, at_object, H, work)
    if layout[N_BIAS_KINDS] > 0:
        bias_position_rows(bias, bias_start, H)
        write_bias_columns(bias, spread, axes, inverse, layout[N_BIAS_KINDS], bias_start, H, work)
