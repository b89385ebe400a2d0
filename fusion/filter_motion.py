"""The filter between measurements: the start of its motion, and integrating up to a stamp."""

from __future__ import annotations

import math

from fusion.ballot import FEW_VOTES, LONGEST_WINDOW_S, LOST_SIGMA, LOST_WINDOW_S, MIN_VOTES, START_WINDOW_S
from fusion.compiled import njit
from fusion.imu import (
    GUESSED,
    mean_until,
    propagate_covariance,
    propagate_nominal,
    transition_blocks,
    write_gravity_basis,
)
from fusion.memory import (
    BIAS_TIME,
    FIRST_VOTE,
    IMU_AT,
    INITIALISING,
    LAST_STAMP,
    MODE,
    NOW,
    RESTARTS,
    TRACKING,
    UNHELD_ROW,
    UNHELD_SINCE,
    UNSURE_AT,
    UP_COUNT,
    VOTE_HEAD,
    Memory,
    Work,
)
from fusion.nav_state import ACCEL_BIAS, AT_CLONE, AT_GRAVITY, AT_OBJECTS, GRAVITY, GYRO_BIAS, POSITION, Array, Ints
from fusion.odometry import IS_ODOMETRY, move_by_odometry, spread_by_odometry
from fusion.tape import note_odometry, note_step

_NEVER = -(2**63)


@njit(cache=True)
def begin(m: Memory, stamp: int, specific_force: Array, imu_index: int) -> None:
    """Begin to integrate: level attitude from the first specific force, heading, position and velocity zero."""
    ax, ay, az = specific_force[0], specific_force[1], specific_force[2]
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    ux, uy, uz = (ax / norm, ay / norm, az / norm) if norm > 0.0 else (0.0, 0.0, 1.0)
    # Rows of R_world_imu: any x axis across up, then y, then up in imu axes.
    hx, hy, hz = (-ux * uy, 1.0 - uy * uy, -uy * uz) if abs(ux) > 0.9 else (1.0 - ux * ux, -ux * uy, -ux * uz)
    scale = math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx / scale, hy / scale, hz / scale
    rows = (hx, hy, hz, uy * hz - uz * hy, uz * hx - ux * hz, ux * hy - uy * hx, ux, uy, uz)
    for i in range(9):
        m.x[i] = rows[i]
    for i in range(6):
        m.x[POSITION + i] = 0.0
    m.up[0], m.up[1], m.up[2] = 0.0, 0.0, 1.0
    c = m.counters
    c[NOW], c[IMU_AT], c[MODE], c[BIAS_TIME], c[UP_COUNT] = stamp, imu_index, INITIALISING, stamp, 0
    c[LAST_STAMP], c[UNSURE_AT], c[FIRST_VOTE] = stamp - 1, _NEVER, c[VOTE_HEAD]


@njit(cache=True)
def advance(m: Memory, w: Work, imu_stamps: Ints, imu_values: Array, until: int) -> None:
    """Integrate the IMU from where the filter is up to a stamp, which the samples must reach."""
    c = m.counters
    rate, force = w.scratch[0:3], w.scratch[3:6]
    while c[NOW] < until:
        k = c[IMU_AT]
        start, end = imu_stamps[k], imu_stamps[k + 1]
        stop = mean_until(imu_stamps, imu_values, k, c[NOW], until, w.scratch)
        dt = (stop - c[NOW]) * 1e-9
        if m.noise[IS_ODOMETRY] > 0.0:
            _advance_by_odometry(m, w, dt, imu_values[k])
        elif c[MODE] == TRACKING:
            _advance_by_imu(m, w, dt, (end - start) * 1e-9, rate, force, imu_values[k + 1])
        else:
            propagate_nominal(m.x, dt, rate, force, w.step)
            watch_gravity(m, w, dt)
        c[NOW] = stop
        if stop == end:
            c[IMU_AT] = k + 1
    give_up_where_lost(m, imu_values[c[IMU_AT], 3:6])


@njit(cache=True)
def give_up_where_lost(m: Memory, specific_force: Array) -> None:
    """Wait for a new start where the camera may by now look anywhere, or where the filter has shut itself out.

    What a filter makes of detections there is a turn and a speed that nobody saw, which then carry it further away.
    """
    if m.counters[MODE] == TRACKING and (_looks_anywhere(m) or _is_shut_out(m)):
        last = m.counters[LAST_STAMP]
        begin(m, m.counters[NOW], specific_force, m.counters[IMU_AT])
        m.counters[LAST_STAMP] = last
        m.counters[RESTARTS] += 1
        for i in range(3):
            m.x[ACCEL_BIAS + i] = 0.0
            if m.noise[GUESSED] > 0.0:
                m.x[GYRO_BIAS + i] = 0.0


@njit(cache=True)
def _looks_anywhere(m: Memory) -> bool:
    """Tell whether the motion is but a guess and nothing is known of the attitude."""
    return m.noise[GUESSED] > 0.0 and not m.P[0, 0] + m.P[1, 1] + m.P[2, 2] < math.pi**2


@njit(cache=True)
def _is_shut_out(m: Memory) -> bool:
    """Tell whether nothing that was seen for long has held a state that needs it: it would go on so."""
    c, known_map = m.counters, m.layout[AT_OBJECTS] < 0
    few, many = c[UNHELD_ROW] >= m.start[FEW_VOTES], c[UNHELD_ROW] >= m.start[MIN_VOTES]
    if not known_map or not few:
        return False
    seconds, drifts = (c[NOW] - c[UNHELD_SINCE]) * 1e-9, m.layout[AT_CLONE] < 0 and m.noise[IS_ODOMETRY] == 0.0
    unsure = max(m.P[3, 3], m.P[4, 4], m.P[5, 5]) > m.start[LOST_SIGMA] ** 2
    return (seconds > m.start[LOST_WINDOW_S] and unsure) or (seconds > m.start[LONGEST_WINDOW_S] and drifts and many)


@njit(cache=True)
def _advance_by_imu(m: Memory, w: Work, dt: float, interval: float, rate: Array, force: Array, sample: Array) -> None:
    if m.layout[AT_GRAVITY] >= 0:
        write_gravity_basis(m.x, w.basis)
    propagate_nominal(m.x, dt, rate, force, w.step)
    transition_blocks(dt, w.step, w.blocks)
    propagate_covariance(m.P, w.blocks, dt, interval, m.noise, sample, w.basis, m.layout, w.core, w.rows)
    if len(m.tape) > 0:
        note_step(m, w, dt)


@njit(cache=True)
def _advance_by_odometry(m: Memory, w: Work, dt: float, twist: Array) -> None:
    R_before = w.scratch[6:15]
    for i in range(9):
        R_before[i] = m.x[i]
    move_by_odometry(m.x, dt, twist[0:3], twist[3:6], w.step)
    if m.counters[MODE] == TRACKING:
        spread_by_odometry(m.P, R_before, dt, m.noise, twist, m.layout, w.step)
        if len(m.tape) > 0:
            note_odometry(m, w)


@njit(cache=True)
def watch_gravity(m: Memory, w: Work, dt: float) -> None:
    """Average the specific force in the integrated motion's axes over about the start's window: it points up."""
    m.counters[UP_COUNT] += 1
    gain = max(1.0 / m.counters[UP_COUNT], min(1.0, dt / m.start[START_WINDOW_S]))
    for i in range(3):
        upward = w.step[24 + i] - m.x[GRAVITY + i]
        m.up[i] += gain * (upward - m.up[i])


@njit(cache=True)
def find_rate(m: Memory, w: Work, imu_stamps: Ints, imu_values: Array) -> None:
    """Write the unbiased angular velocity and specific force at the filter's stamp into w.rate and w.force."""
    k = m.counters[IMU_AT]
    share = 0.0
    following = k
    if m.counters[NOW] > imu_stamps[k]:
        following = k + 1
        share = (m.counters[NOW] - imu_stamps[k]) / (imu_stamps[following] - imu_stamps[k])
    for i in range(3):
        value = imu_values[k, i] + share * (imu_values[following, i] - imu_values[k, i])
        w.rate[i] = value - m.x[GYRO_BIAS + i]
        value = imu_values[k, 3 + i] + share * (imu_values[following, 3 + i] - imu_values[k, 3 + i])
        w.force[i] = value - m.x[ACCEL_BIAS + i]
