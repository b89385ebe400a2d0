"""The compiled half of the graph: the filter between keyframes, motion between stamps, a detection's error.

Nothing here knows gtsam.
"""

from __future__ import annotations

import numpy as np

from fusion.compiled import njit
from fusion.eskf import fit_symmetry
from fusion.filter_loop import advance, angular_velocity_at, begin, emit, measure
from fusion.imu import propagate_nominal
from fusion.measurements import MAX_COLUMNS, OBJECT_POSE, camera_in_world, residual_and_jacobian
from fusion.memory import MODE, NOW, RESTARTS, TRACKING, Memory, Work, views, work_views
from fusion.nav_state import (
    AT_BIASES,
    AT_EXTRINSICS,
    AT_OBJECTS,
    BIASES,
    EXTRINSIC_ROTATION,
    GYRO_BIAS,
    N_BIAS_KINDS,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    VELOCITY,
    Array,
    Ints,
)
from fusion.so3_kernels import apply, multiply, multiply_transposed_left

# Places in the cursor: next IMU row, next measurement, rows written, stamp of the newest keyframe.
IMU_ROW, NEXT, ROWS, KEYFRAME_NS, CURSOR_SIZE = range(5)

END, KEYFRAME, STARTED = range(3)  # why filter_until_keyframe returned

# Places in a motion between two stamps: seconds, R_first_second, displacement and velocity free of gravity.
SECONDS, TURN, SHIFT, SPEED, MOTION_SIZE = 0, 1, 10, 13, 16


@njit(cache=True)
def begin_log(floats: Array, integers: Ints, cursor: Ints, imu_stamps: Ints, imu_values: Array, stamps: Ints) -> None:
    """Put the filter at the first IMU sample and the cursor behind the measurements before it."""
    m = views(floats, integers)
    while cursor[NEXT] < len(stamps) and stamps[cursor[NEXT]] < imu_stamps[0]:
        cursor[NEXT] += 1
    begin(m, imu_stamps[0], imu_values[0, 3:6], 0)


@njit(cache=True)
def filter_until_keyframe(
    floats: Array,
    integers: Ints,
    cursor: Ints,
    spacing_ns: int,
    idle_ns: int,
    imu_stamps: Ints,
    imu_values: Array,
    stamps: Ints,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    translations: Array,
    covariances: Array,
    decisions: Ints,
    nis: Array,
    fitted_rotations: Array,
    fitted_covariances: Array,
    fresh: Ints,
    out_stamps: Ints,
    out_core: Array,
    out_sigma: Array,
    out_covariance: Array,
) -> int:
    """Filter up to the next keyframe and return KEYFRAME, STARTED where the filter (re)started there, or END.

    A keyframe is due at the first stamp with measurements spacing_ns after the last one, where an object's bias jumped,
    and at an IMU sample idle_ns after the last one. Its own measurements are taken in. fitted_rotations and
    fitted_covariances get each measurement as it was used (symmetry chosen, noise scaled); fresh (kinds * objects * 2
    halves) tells which biases nothing ties to the motion: those that are 1 and were 0 have just been forgotten.
    """
    m = views(floats, integers)
    w = work_views(m.work, len(m.P))
    rate = np.zeros(3)
    while cursor[IMU_ROW] < len(imu_stamps):
        k, j = cursor[IMU_ROW], cursor[NEXT]
        if j < len(stamps) and stamps[j] <= imu_stamps[k]:
            last, restarts, tracked = j, m.counters[RESTARTS], m.counters[MODE] == TRACKING
            while last < len(stamps) and stamps[last] == stamps[j]:
                last += 1
            advance(m, w, imu_stamps, imu_values, stamps[j])
            angular_velocity_at(m, imu_stamps, imu_values, rate)
            measure(m, w, j, last, kinds, objects, rotations, translations, covariances, rate, decisions, nis)
            cursor[NEXT] = last
            if m.counters[MODE] != TRACKING:
                continue
            _write_row(m, cursor, out_stamps, out_core, out_sigma, out_covariance)
            for i in range(j, last):
                _keep_fitted(m, w, i, kinds, objects, rotations, covariances, fitted_rotations, fitted_covariances)
            jumped = _find_fresh(m, fresh)
            if not tracked or m.counters[RESTARTS] != restarts:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return STARTED
            if jumped or m.counters[NOW] - cursor[KEYFRAME_NS] >= spacing_ns:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return KEYFRAME
            continue
        advance(m, w, imu_stamps, imu_values, imu_stamps[k])
        cursor[IMU_ROW] += 1
        if m.counters[MODE] == TRACKING:
            if cursor[ROWS] == 0 or out_stamps[cursor[ROWS] - 1] != m.counters[NOW]:
                _write_row(m, cursor, out_stamps, out_core, out_sigma, out_covariance)
            if m.counters[NOW] - cursor[KEYFRAME_NS] >= idle_ns:
                cursor[KEYFRAME_NS] = m.counters[NOW]
                return KEYFRAME
    return END


@njit(cache=True)
def _write_row(
    m: Memory, cursor: Ints, out_stamps: Ints, out_core: Array, out_sigma: Array, out_covariance: Array
) -> None:
    emit(m, cursor[ROWS], out_stamps, out_core, out_sigma, out_covariance)
    cursor[ROWS] += 1


@njit(cache=True)
def rewrite_row(
    floats: Array,
    integers: Ints,
    cursor: Ints,
    out_stamps: Ints,
    out_core: Array,
    out_sigma: Array,
    out_covariance: Array,
) -> None:
    """Write the newest row again, after the graph has corrected the filter's state."""
    emit(views(floats, integers), cursor[ROWS] - 1, out_stamps, out_core, out_sigma, out_covariance)


@njit(cache=True)
def _keep_fitted(
    m: Memory,
    w: Work,
    i: int,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    covariances: Array,
    fitted_rotations: Array,
    fitted_covariances: Array,
) -> None:
    for j in range(9):
        fitted_rotations[i, j] = rotations[i, j]
    scale = m.scales[objects[i]] if kinds[i] == OBJECT_POSE else 1.0
    for r in range(6):
        for c in range(6):
            w.R[r, c] = scale * covariances[i, r, c]
    if kinds[i] == OBJECT_POSE and m.orders[objects[i]] != 1:
        fit_to_state(m, w, objects[i], fitted_rotations[i])
    for r in range(6):
        for c in range(6):
            fitted_covariances[i, r, c] = w.R[r, c]


@njit(cache=True)
def fit_to_state(m: Memory, w: Work, k: int, R_m: Array) -> None:
    """Turn a symmetric object's measured rotation to where it fits the state, with its noise in w.R."""
    R_wi, R_wc, p_wi, R_co = w.step[0:9], w.step[9:18], w.step[18:21], w.step[30:39]
    camera_in_world(m.x, 0.0, w.step[48:51], R_wi, p_wi, R_wc, w.step[21:30])
    at = OBJECTS + OBJECT_SIZE * k
    multiply_transposed_left(R_wc, m.x[at : at + 9], R_co)
    fit_symmetry(R_m, R_co, m.axes[k], m.orders[k], w.R, w.scratch)


@njit(cache=True)
def _find_fresh(m: Memory, fresh: Ints) -> bool:
    """Mark the bias halves (rotation, translation) that nothing ties to the motion: new, or just forgotten."""
    found = False
    for half in range(2 * m.layout[N_BIAS_KINDS] * m.layout[N_OBJECTS]):
        at = m.layout[AT_BIASES] + 3 * half
        tied = False
        for r in range(3):
            for c in range(6):
                tied = tied or m.P[at + r, c] != 0.0
        if not tied and fresh[half] == 0:
            found = True
        fresh[half] = 0 if tied else 1
    return found


@njit(cache=True)
def imu_between(imu_stamps: Ints, imu_values: Array, start: int, end: int, biases: Array, out: Array) -> int:
    """Write the IMU between two stamps as steps [seconds, rate, force] (7 columns); return how many.

    Rate and force are means of each step; the force is turned by half of the step's turn (biases: gyroscope,
    accelerometer), so that an integrator that holds the attitude of a step's start sees the middle's.
    """
    x = np.zeros(OBJECTS)
    work = np.zeros(64)
    k = np.searchsorted(imu_stamps, start, side="right") - 1
    now, count = start, 0
    while now < end:
        stop = min(imu_stamps[k + 1], end)
        share = 0.5 * ((now - imu_stamps[k]) + (stop - imu_stamps[k])) / (imu_stamps[k + 1] - imu_stamps[k])
        dt = (stop - now) * 1e-9
        for i in range(9):
            x[i] = 1.0 if i % 4 == 0 else 0.0
        for i in range(6):
            x[GYRO_BIAS + i] = biases[i]
            out[count, 1 + i] = imu_values[k, i] + share * (imu_values[k + 1, i] - imu_values[k, i])
        propagate_nominal(x, dt, out[count, 1:4], out[count, 4:7], work)
        out[count, 0] = dt
        for i in range(3):
            out[count, 4 + i] = work[24 + i] + biases[3 + i]
        now, count, k = stop, count + 1, k + 1
    return count


@njit(cache=True)
def move_on(imu_stamps: Ints, imu_values: Array, start: int, end: int, biases: Array) -> Array:
    """Return the motion (MOTION_SIZE,) between two stamps as the IMU saw it, without gravity and first velocity."""
    x, work, motion = np.zeros(OBJECTS), np.zeros(64), np.zeros(MOTION_SIZE)
    for i in range(9):
        x[i] = 1.0 if i % 4 == 0 else 0.0
    for i in range(6):
        x[GYRO_BIAS + i] = biases[i]
    k = np.searchsorted(imu_stamps, start, side="right") - 1
    now = start
    while now < end:
        stop = min(imu_stamps[k + 1], end)
        share = 0.5 * ((now - imu_stamps[k]) + (stop - imu_stamps[k])) / (imu_stamps[k + 1] - imu_stamps[k])
        values = imu_values[k] + share * (imu_values[k + 1] - imu_values[k])
        propagate_nominal(x, (stop - now) * 1e-9, values[0:3], values[3:6], work)
        now, k = stop, k + 1
    motion[SECONDS] = (end - start) * 1e-9
    motion[TURN : TURN + 9] = x[0:9]
    motion[SHIFT : SHIFT + 6] = x[POSITION : VELOCITY + 3]
    return motion


@njit(cache=True)
def detection_error(
    kind: int,
    k: int,
    first: int,
    size: int,
    R_m: Array,
    t_m: Array,
    motion: Array,
    T_world_imu: Array,
    velocity: Array,
    T_imu_cam: Array,
    T_world_obj: Array,
    biases: Array,
    x: Array,
    layout: Ints,
) -> tuple[Array, Array]:
    """Return predicted minus measured (rows first..first+size of [rotation, translation]) and its Jacobian.

    Seen `motion` after the pose (4, 4) with its velocity (3,); extrinsics and object (4, 4) and biases (kinds, 6) as
    they are now. Jacobian columns: pose 6, velocity 3, extrinsics 6, object 6, biases 6 each, poses in gtsam's tangent
    [rotation, translation in body axes].
    """
    work, residual, H = np.zeros(256), np.zeros(6), np.zeros((6, MAX_COLUMNS))
    columns = np.zeros(MAX_COLUMNS, dtype=np.int64)
    _place(x, EXTRINSIC_ROTATION, T_imu_cam)
    _place(x, 0, T_world_imu)
    dt, R_k = motion[SECONDS], work[128:137]
    if kind == OBJECT_POSE:
        _place(x, OBJECTS + OBJECT_SIZE * k, T_world_obj)
        for i in range(len(biases)):
            for j in range(6):
                x[layout[BIASES] + 6 * (k + i * layout[N_OBJECTS]) + j] = biases[i, j]
    if dt > 0.0:
        R_k[:] = x[0:9]
        multiply(R_k, motion[TURN : TURN + 9], work)
        x[0:9] = work[0:9]
        apply(R_k, motion[SHIFT], motion[SHIFT + 1], motion[SHIFT + 2], work)
        for i in range(3):
            x[POSITION + i] += dt * velocity[i] + work[i]
        x[POSITION + 2] -= 0.5 * dt * dt * GRAVITY_NORM
    residual_and_jacobian(kind, k, R_m, t_m, x, work[192:195], 0.0, layout, residual, H, columns, work)
    J = np.zeros((size, 9 + 6 + 6 + 6 * len(biases)))
    _pose_columns(H, J, first, size, x, motion, dt)
    at = 6
    if layout[AT_EXTRINSICS] >= 0:
        _body_columns(H, at, J, 9, first, size, x, EXTRINSIC_ROTATION)
        at += 6
    if kind == OBJECT_POSE:
        if layout[AT_OBJECTS] >= 0:
            _body_columns(H, at, J, 15, first, size, x, OBJECTS + OBJECT_SIZE * k)
            at += 6
        for r in range(size):
            for c in range(6 * len(biases)):
                J[r, 21 + c] = H[first + r, at + c]
    return -residual[first : first + size], J


GRAVITY_NORM = 9.81
"""m/s^2, as in `nav_state.nominal_state`."""


@njit(cache=True, inline="always")
def _place(x: Array, at: int, T: Array) -> None:
    for i in range(3):
        for j in range(3):
            x[at + 3 * i + j] = T[i, j]
        x[at + 9 + i] = T[i, 3]


@njit(cache=True, inline="always")
def _body_columns(H: Array, source: int, J: Array, to: int, first: int, size: int, x: Array, pose: int) -> None:
    """Copy six columns of a pose whose translation part is taken in its own axes from here on: dp = R rho."""
    for r in range(size):
        for c in range(3):
            J[r, to + c] = H[first + r, source + c]
            total = 0.0
            for i in range(3):
                total += H[first + r, source + 3 + i] * x[pose + 3 * i + c]
            J[r, to + 3 + c] = total


@njit(cache=True)
def _pose_columns(H: Array, J: Array, first: int, size: int, x: Array, motion: Array, dt: float) -> None:
    """Refer the columns of the pose at the detection's stamp to the keyframe's pose and velocity.

    With R_t = R D and p_t = p + v dt + R s + g dt^2 / 2: theta_t = D^T theta, dp_t = R rho + dt dv - R [s]x theta.
    """
    s = motion[SHIFT : SHIFT + 3]
    for r in range(size):
        h = H[first + r]
        row = J[r]
        if dt == 0.0:
            for c in range(3):
                row[c] = h[c]
                row[3 + c] = h[3] * x[c] + h[4] * x[3 + c] + h[5] * x[6 + c]
            continue
        for c in range(3):
            row[c] = 0.0
            row[3 + c] = 0.0
            for i in range(3):
                # R = R_t D^T, so R[j, c] = sum_i R_t[j, i] D[c, i].
                in_body = h[3] * x[i] + h[4] * x[3 + i] + h[5] * x[6 + i]
                row[3 + c] += in_body * motion[TURN + 3 * c + i]
                row[c] += h[i] * motion[TURN + 3 * c + i]
            row[6 + c] = dt * h[3 + c]
        a, b, c2 = row[3], row[4], row[5]
        row[0] -= b * s[2] - c2 * s[1]
        row[1] -= c2 * s[0] - a * s[2]
        row[2] -= a * s[1] - b * s[0]
