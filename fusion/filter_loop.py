"""The filter in time: integrate up to a stamp, take in what was measured there.

The whole-log call below and the online estimator (`fusion/online.py`) go through the same functions.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.compiled import njit
from fusion.consensus import (
    START_WINDOW_S,
)
from fusion.eskf import (
    ACCEPTED,
    POSITION_ONLY,
    REJECTED,
    ROTATION_ONLY,
    adopt_object,
    clone_pose,
    correct,
    decay_biases,
    fit_symmetry,
    forget_bias,
    gate,
    innovation,
)
from fusion.imu import propagate_covariance, propagate_nominal, transition_blocks, write_gravity_basis
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP, camera_in_world, residual_and_jacobian
from fusion.meeting import PUT, START_AGAIN, UNKNOWN_MAP, choose_anchor, forget_rivals, suppose
from fusion.memory import (
    BIAS_TIME,
    CLONED,
    DELAY,
    IMU_AT,
    INITIALISING,
    LAST_STAMP,
    LAST_UPDATE,
    LEAST_DELAY,
    MODE,
    NOW,
    REFUSED_ROW,
    REPLACED,
    RESTARTS,
    STARTED_AT,
    TRACKING,
    UP_COUNT,
    Memory,
    Work,
    views,
    work_views,
)
from fusion.nav_state import (
    AT_GRAVITY,
    AT_TIME_OFFSET,
    EXTRINSIC_POSITION,
    GRAVITY,
    GYRO_BIAS,
    GYRO_BIAS_ERROR,
    N_BIAS_KINDS,
    N_ERROR,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    TIME_OFFSET,
    Array,
    Ints,
)
from fusion.odometry import IS_ODOMETRY, move_by_odometry, spread_by_odometry
from fusion.place_watch import ON_MAP, RELEASE, RELEASED, TURNED, return_to_map, status_of, tally, watch
from fusion.so3_kernels import (
    apply,
    multiply,
    multiply_transposed_left,
)
from fusion.starting import adopt, cast_vote, restart_if_lost, try_to_start
from fusion.tape import (
    note_clone,
    note_correction,
    note_decay,
    note_forgetting,
    note_meeting,
    note_odometry,
    note_row,
    note_step,
)

# Places in the limits.
LIMIT_BOTH, LIMIT_ROTATION, LIMIT_POSITION, PARTIAL, NOMINAL_OFFSET, ADAPTATION, MAX_SCALE, JUMP_AFTER, SETTLED = range(
    9
)
PENDING = -1  # beside the decisions of the gate

OUT_CORE, OUT_SIGMA, OUT_COVARIANCE = 21, 15, 36

RETIMED_BEYOND_NS = 1_000_000


@njit(cache=True)
def begin(m: Memory, stamp: int, specific_force: Array, imu_index: int) -> None:
    """Begin to integrate: level attitude from the first specific force, heading, position and velocity zero."""
    ax, ay, az = specific_force[0], specific_force[1], specific_force[2]
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    ux, uy, uz = (ax / norm, ay / norm, az / norm) if norm > 0.0 else (0.0, 0.0, 1.0)
    # Rows of R_world_imu: any x axis across up, then y, then up in imu axes.
    hx, hy, hz = (0.0, uz, -uy) if abs(ux) > 0.9 else (1.0 - ux * ux, -ux * uy, -ux * uz)
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
    c[LAST_STAMP] = stamp - 1


@njit(cache=True)
def advance(m: Memory, w: Work, imu_stamps: Ints, imu_values: Array, until: int) -> None:
    """Integrate the IMU from where the filter is up to a stamp, which the samples must reach.

    Between two samples both signals are linear in time: the mean over a part of an interval is the value at its middle.
    """
    c = m.counters
    rate, force = w.scratch[0:3], w.scratch[3:6]
    while c[NOW] < until:
        k = c[IMU_AT]
        start, end = imu_stamps[k], imu_stamps[k + 1]
        stop = min(end, until)
        share = 0.5 * ((c[NOW] - start) + (stop - start)) / (end - start)
        for i in range(3):
            rate[i] = imu_values[k, i] + share * (imu_values[k + 1, i] - imu_values[k, i])
            force[i] = imu_values[k, 3 + i] + share * (imu_values[k + 1, 3 + i] - imu_values[k, 3 + i])
        dt = (stop - c[NOW]) * 1e-9
        if m.noise[IS_ODOMETRY] > 0.0:
            _advance_by_odometry(m, w, dt, imu_values[k])
        elif c[MODE] == TRACKING:
            if m.layout[AT_GRAVITY] >= 0:
                write_gravity_basis(m.x, w.basis)
            propagate_nominal(m.x, dt, rate, force, w.step)
            transition_blocks(dt, w.step, w.blocks)
            propagate_covariance(
                m.P, w.blocks, dt, (end - start) * 1e-9, m.noise, imu_values[k + 1], w.basis, m.layout, w.core, w.rows
            )
            if len(m.tape) > 0:
                note_step(m, w, dt)
        else:
            propagate_nominal(m.x, dt, rate, force, w.step)
            _watch_gravity(m, w, dt)
        c[NOW] = stop
        if stop == end:
            c[IMU_AT] = k + 1


@njit(cache=True)
def due(m: Memory, stamp: int) -> int:
    """Return when measurements of a stamp are taken in: as much later as the camera's clock is found to be early."""
    if m.layout[AT_TIME_OFFSET] < 0 or m.counters[MODE] != TRACKING:
        return stamp
    return max(stamp + m.counters[DELAY], m.counters[NOW] + 1)


@njit(cache=True)
def measure_at(
    m: Memory,
    w: Work,
    first: int,
    last: int,
    stamps: Ints,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    translations: Array,
    covariances: Array,
    imu_stamps: Ints,
    imu_values: Array,
    rate: Array,
    decisions: Ints,
    nis: Array,
) -> None:
    """Go to where the measurements first..last-1, all of one stamp, are due, and take them in."""
    c = m.counters
    advance(m, w, imu_stamps, imu_values, due(m, stamps[first]))
    angular_velocity_at(m, imu_stamps, imu_values, rate)
    m.limits[NOMINAL_OFFSET] = (c[NOW] - stamps[first]) * 1e-9
    measure(m, w, first, last, kinds, objects, rotations, translations, covariances, rate, decisions, nis)
    c[LAST_STAMP] = stamps[first]
    retime(m)


@njit(cache=True)
def retime(m: Memory) -> None:
    """Follow the estimated time offset, so that what is linear in it stays small.

    What was learnt of it while it was far off came through a motion taken for uniform: its variance takes that back.
    """
    at = m.layout[AT_TIME_OFFSET]
    if at < 0 or m.counters[MODE] != TRACKING:
        return
    error = round(m.x[TIME_OFFSET] * 1e9) - m.counters[DELAY]
    if abs(error) <= RETIMED_BEYOND_NS:
        return
    m.counters[DELAY] += error
    m.counters[LEAST_DELAY] = min(m.counters[LEAST_DELAY], m.counters[DELAY])
    m.counters[CLONED] = 0  # odometry from before is of another clock
    m.P[at, at] += (0.3e-9 * error) ** 2


@njit(cache=True)
def _advance_by_odometry(m: Memory, w: Work, dt: float, twist: Array) -> None:
    R_before = w.scratch[6:15]
    for i in range(9):
        R_before[i] = m.x[i]
    move_by_odometry(m.x, dt, twist[0:3], twist[3:6], w.step)
    if m.counters[MODE] == TRACKING:
        spread_by_odometry(m.P, R_before, dt, m.noise, m.layout, w.step)
        if len(m.tape) > 0:
            note_odometry(m, w)


@njit(cache=True)
def _watch_gravity(m: Memory, w: Work, dt: float) -> None:
    """Average the specific force in the integrated motion's axes over about the start's window: it points up."""
    m.counters[UP_COUNT] += 1
    gain = max(1.0 / m.counters[UP_COUNT], min(1.0, dt / m.start[START_WINDOW_S]))
    for i in range(3):
        upward = w.step[24 + i] - m.x[GRAVITY + i]
        m.up[i] += gain * (upward - m.up[i])


@njit(cache=True)
def angular_velocity_at(m: Memory, imu_stamps: Ints, imu_values: Array, out: Array) -> None:
    """Write the unbiased angular velocity at the filter's stamp."""
    k = m.counters[IMU_AT]
    share = 0.0
    following = k
    if m.counters[NOW] > imu_stamps[k]:
        following = k + 1
        share = (m.counters[NOW] - imu_stamps[k]) / (imu_stamps[following] - imu_stamps[k])
    for i in range(3):
        value = imu_values[k, i] + share * (imu_values[following, i] - imu_values[k, i])
        out[i] = value - m.x[GYRO_BIAS + i]


@njit(cache=True)
def measure(
    m: Memory,
    w: Work,
    first: int,
    last: int,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    translations: Array,
    covariances: Array,
    rate: Array,
    decisions: Ints,
    nis: Array,
) -> None:
    """Take in the measurements first..last-1, all at the filter's stamp; write decisions (M,) and nis (M, 3)."""
    c = m.counters
    odometry = first
    while first < last and kinds[first] == ODOMETRY_STEP:
        first += 1
    if odometry < first == last and c[MODE] != TRACKING:
        return
    if c[MODE] == TRACKING:
        if len(m.tape) > 0:
            note_decay(m, (c[NOW] - c[BIAS_TIME]) * 1e-9)
        decay_biases(m.x, m.P, (c[NOW] - c[BIAS_TIME]) * 1e-9, m.bias_model, m.layout)
        c[BIAS_TIME] = c[NOW]
    for j in range(odometry, first):
        decisions[j] = REJECTED
        if c[MODE] == TRACKING and c[CLONED] == 1:
            decisions[j] = _update(
                m, w, kinds[j], -1, rotations[j], translations[j], covariances[j], rate, nis[j], True
            )
    if odometry < first == last:
        _clone(m)
        return
    if m.meeting[UNKNOWN_MAP] > 0.0:
        choose_anchor(m, kinds, objects, first, last)
    accepted = False
    for j in range(first, last):
        decisions[j] = PENDING if c[MODE] == TRACKING else REJECTED
    if c[MODE] == TRACKING:
        _order(m, w, first, last, kinds, objects, rotations, translations, covariances, rate, nis)
        for _ in range(first, last):
            j = _next(first, last, decisions, nis)
            k, R_m, t_m = objects[j], rotations[j], translations[j]
            decisions[j] = _update(m, w, kinds[j], k, R_m, t_m, covariances[j], rate, nis[j], True)
            accepted = accepted or decisions[j] & ACCEPTED != 0
        for j in range(first, last if accepted else first):
            if decisions[j] == REJECTED:  # refused before the others had moved the state: ask again
                k, R_m, t_m = objects[j], rotations[j], translations[j]
                decisions[j] = _update(m, w, kinds[j], k, R_m, t_m, covariances[j], rate, nis[j], True)
        for j in range(first, last if len(m.supposed) > 0 else first):
            k, R_m, t_m = objects[j], rotations[j], translations[j]
            if kinds[j] == OBJECT_POSE and meet(m, w, k, R_m, t_m, rate) == PUT:
                _put_object(m, w, k, R_m, t_m, covariances[j], rate)
                decisions[j] = ACCEPTED
    account(m, w, first, last, kinds, objects, rotations, translations, covariances, rate, decisions, nis)
    if c[MODE] == INITIALISING:
        try_to_start(m, w)
    else:
        restart_if_lost(m, w)
    if odometry < first and c[MODE] == TRACKING:
        _clone(m)


@njit(cache=True)
def meet(m: Memory, w: Work, k: int, rotation: Array, translation: Array, rate: Array) -> int:
    """Take a detection into where its object may be; return PUT where it is to be put where this detection sees it.

    Where another pose of the object that anchors the world has come to lead, the world is moved so that this one is
    where the map says, and all other objects are unknown again.
    """
    found = suppose(m, w, k, rotation, translation, rate, m.limits[NOMINAL_OFFSET])
    if found == PUT and m.known[k] > 0.0:
        m.counters[REPLACED] += 1
        return_to_map(m, k)
    if found == START_AGAIN:
        m.inliers[:] = 0
        adopt(m, w, GYRO_BIAS_ERROR)
        for i in range(m.layout[N_OBJECTS]):
            m.known[i] = 1.0 if i == k else 0.0
        forget_rivals(m, True)
        m.counters[RESTARTS] += 1
        m.counters[STARTED_AT] = m.counters[NOW]
    return found


@njit(cache=True)
def _clone(m: Memory) -> None:
    """Keep the pose of now as what the next odometry is measured against."""
    clone_pose(m.x, m.P, m.layout)
    m.counters[CLONED] = 1
    if len(m.tape) > 0:
        note_clone(m)


@njit(cache=True)
def account(
    m: Memory,
    w: Work,
    first: int,
    last: int,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    translations: Array,
    covariances: Array,
    rate: Array,
    decisions: Ints,
    nis: Array,
) -> None:
    """Draw the conclusions of what became of the measurements of a stamp: jumps, votes, tallies, moved objects."""
    c, accepted, refused = m.counters, False, 0
    for j in range(first, last):
        _follow_jumps(m, kinds[j], objects[j], decisions[j])
        cast_vote(m, w, kinds[j], objects[j], rotations[j], translations[j], decisions[j])
        accepted = accepted or decisions[j] & ACCEPTED != 0
        refused += decisions[j] == REJECTED
        if c[MODE] == TRACKING:
            tally(m, kinds[j], objects[j], decisions[j], nis[j, 0], m.limits[LIMIT_BOTH])
    if c[MODE] != TRACKING:
        return
    c[REFUSED_ROW] = 0 if accepted else c[REFUSED_ROW] + refused
    if accepted:
        c[LAST_UPDATE] = c[NOW]
    for j in range(first, last if m.moved[RELEASE] > 0.0 else first):
        k = objects[j]
        if kinds[j] != OBJECT_POSE or m.known[k] == 0.0:
            continue
        if watch(m, w, k, rotations[j], translations[j], covariances[j], rate, m.limits[NOMINAL_OFFSET]) != 0:
            _forget_biases(m, k, True)


@njit(cache=True)
def _forget_biases(m: Memory, k: int, jumped: bool) -> None:
    """Forget every bias of an object that is put elsewhere; where its detections jumped, the varying one has too."""
    for kind in range(m.layout[N_BIAS_KINDS]):
        for first in (0, 3):
            forget_bias(m.x, m.P, k, first, m.bias_model, m.layout, kind, jumped and kind == 0)
            if len(m.tape) > 0:
                note_forgetting(m, k + kind * m.layout[N_OBJECTS], first)
    m.refused[k, 0] = m.refused[k, 1] = 0.0


@njit(cache=True)
def _order(
    m: Memory,
    w: Work,
    first: int,
    last: int,
    kinds: Ints,
    objects: Ints,
    rotations: Array,
    translations: Array,
    covariances: Array,
    rate: Array,
    nis: Array,
) -> None:
    """Write into nis[:, 0] what measurements of one stamp are taken in by, the least first.

    A state that is sure of itself takes them as they come. One that is not lets those that fit it best speak first:
    its gate is wide, and a gross error that came first would shut the others out.
    """
    unsettled = m.P[3, 3] + m.P[4, 4] + m.P[5, 5] > m.limits[SETTLED]
    for j in range(first, last):
        if unsettled:
            _update(m, w, kinds[j], objects[j], rotations[j], translations[j], covariances[j], rate, nis[j], False)
        else:
            nis[j, 0] = j


@njit(cache=True)
def _next(first: int, last: int, decisions: Ints, nis: Array) -> int:
    """Return the pending measurement with the least nis."""
    best = -1
    for j in range(first, last):
        if decisions[j] == PENDING and (best < 0 or nis[j, 0] < nis[best, 0]):
            best = j
    return best


@njit(cache=True)
def _update(
    m: Memory,
    w: Work,
    kind: int,
    k: int,
    rotation: Array,
    translation: Array,
    covariance: Array,
    rate: Array,
    nis: Array,
    correcting: bool,
) -> int:
    """Gate a measurement and, where correcting, take in what passes; write its NIS (3,), return what passed."""
    n = m.layout[N_ERROR]
    R_m, t_m = w.measured[0:9], w.measured[9:12]
    for i in range(9):
        R_m[i] = rotation[i]
    for i in range(3):
        t_m[i] = translation[i]
    scale = m.scales[k] if kind == OBJECT_POSE else 1.0
    for i in range(6):
        for j in range(6):
            w.R[i, j] = covariance[i, j] * scale
    if kind == OBJECT_POSE and m.known[k] == 0.0:
        nis[0] = np.inf
        return REJECTED
    if kind == OBJECT_POSE and m.orders[k] != 1:
        _fit_object_symmetry(m, w, k, R_m, rate)
    count = residual_and_jacobian(
        kind, k, R_m, t_m, m.x, rate, m.limits[NOMINAL_OFFSET], m.layout, w.residual, w.H, m.columns, w.step
    )
    innovation(m.P, w.H, m.columns, count, w.R, n, w.PHt, w.S)
    decision, status = gate(w.S, w.residual, m.limits, m.limits[PARTIAL], w.L, w.white, nis), status_of(m, kind, k)
    if not correcting:
        return decision
    if kind == OBJECT_POSE and m.limits[ADAPTATION] > 0.0:
        _adapt_scale(m, k, nis[0])
    if status != ON_MAP:
        decision = POSITION_ONLY if status == TURNED and nis[2] <= m.limits[LIMIT_POSITION] else REJECTED
    if decision != REJECTED:
        first, size = 3 if decision == POSITION_ONLY else 0, 6 if decision == ACCEPTED else 3
        correct(m.x, m.P, w.PHt, w.S, w.residual, first, size, m.layout, w.L, w.white, w.Z, w.error, w.scratch)
        if len(m.tape) > 0:
            note_correction(m, w, first, size, count)
    return decision if status == ON_MAP else decision | RELEASED


@njit(cache=True)
def _put_object(m: Memory, w: Work, k: int, R_m: Array, t_m: Array, covariance: Array, rate: Array) -> None:
    """Put an object whose pose in the world is unknown where a detection sees it."""
    for i in range(6):
        for j in range(6):
            w.R[i, j] = covariance[i, j] * m.scales[k]
    R_wi, R_wc, p_wi, away = w.step[0:9], w.step[9:18], w.step[18:21], w.step[30:33]
    camera_in_world(m.x, m.x[TIME_OFFSET] - m.limits[NOMINAL_OFFSET], rate, R_wi, p_wi, R_wc, w.step[21:30])
    at = OBJECTS + OBJECT_SIZE * k
    multiply(R_wc, R_m, m.x[at : at + 9])
    apply(R_wc, t_m[0], t_m[1], t_m[2], away)
    p_ic = m.x[EXTRINSIC_POSITION : EXTRINSIC_POSITION + 3]
    apply(R_wi, p_ic[0], p_ic[1], p_ic[2], w.step[33:36])
    for i in range(3):
        m.x[at + 9 + i] = p_wi[i] + w.step[33 + i] + away[i]
    _forget_biases(m, k, False)
    count = residual_and_jacobian(
        OBJECT_POSE, k, R_m, t_m, m.x, rate, m.limits[NOMINAL_OFFSET], m.layout, w.residual, w.H, m.columns, w.step
    )
    adopt_object(m.x, m.P, w.H, m.columns, count, w.R, k, m.layout, w.objects)
    m.known[k] = 1.0
    if len(m.tape) > 0:
        note_meeting(m, w, k, count)


@njit(cache=True)
def _follow_jumps(m: Memory, kind: int, k: int, decision: int) -> None:
    """Networks err in runs: an object refused often in a row has another bias now, so its old one is forgotten."""
    if kind != OBJECT_POSE or m.counters[MODE] != TRACKING or m.layout[N_BIAS_KINDS] == 0:
        return
    for part in range(status_of(m, kind, k), 2):  # what is released cannot jump
        used = decision & (POSITION_ONLY if part == 1 else ROTATION_ONLY)
        m.refused[k, part] = 0.0 if used else m.refused[k, part] + 1.0
        if m.refused[k, part] >= m.limits[JUMP_AFTER]:
            forget_bias(m.x, m.P, k, 3 * part, m.bias_model, m.layout, 0, True)
            if len(m.tape) > 0:
                note_forgetting(m, k, 3 * part)
            m.refused[k, part] = 0.0


@njit(cache=True)
def _adapt_scale(m: Memory, k: int, nis: float) -> None:
    """Follow how large an object's innovations are against their stated size, gross errors capped."""
    ratio = min(nis / 6.0, 4.0)
    scale = m.scales[k] * math.exp(m.limits[ADAPTATION] * (ratio - 1.0))
    m.scales[k] = min(max(scale, 1.0), m.limits[MAX_SCALE])


@njit(cache=True)
def _fit_object_symmetry(m: Memory, w: Work, k: int, R_m: Array, rate: Array) -> None:
    R_wi, R_wc, p_wi, R_co = w.step[0:9], w.step[9:18], w.step[18:21], w.step[30:39]
    camera_in_world(m.x, m.x[TIME_OFFSET] - m.limits[NOMINAL_OFFSET], rate, R_wi, p_wi, R_wc, w.step[21:30])
    at = OBJECTS + OBJECT_SIZE * k
    multiply_transposed_left(R_wc, m.x[at : at + 9], R_co)
    fit_symmetry(R_m, R_co, m.axes[k], m.orders[k], w.R, w.scratch)


@njit(cache=True)
def emit(m: Memory, row: int, out_stamps: Ints, out_core: Array, out_sigma: Array, out_covariance: Array) -> None:
    """Write the state of now: core (21,), 1-sigma of its errors (15,), covariance of attitude and position (36,)."""
    out_stamps[row] = m.counters[NOW]
    core, sigma, covariance, P = out_core[row], out_sigma[row], out_covariance[row], m.P
    for i in range(OUT_CORE):
        core[i] = m.x[i]
    for i in range(OUT_SIGMA):
        sigma[i] = math.sqrt(max(P[i, i], 0.0))
    for i in range(6):
        for j in range(6):
            covariance[6 * i + j] = P[i, j]
    if len(m.tape) > 0:
        note_row(m, row)


def run_log(
    floats: Array,
    integers: Ints,
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
    out_stamps: Ints,
    out_core: Array,
    out_sigma: Array,
    out_covariance: Array,
) -> int:
    """Filter a whole log in one call; return how many rows were written.

    A row for every IMU sample and every stamp with measurements, from the start on, each with what was known then.
    """
    measured = (stamps, kinds, objects, rotations, translations, covariances, decisions, nis)
    out = (out_stamps, out_core, out_sigma, out_covariance)
    return int(run_part(floats, integers, imu_stamps, imu_values, *measured, *out, 0, len(imu_stamps), 0, 0)[1])


@njit(cache=True)
def run_part(
    floats: Array,
    integers: Ints,
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
    out_stamps: Ints,
    out_core: Array,
    out_sigma: Array,
    out_covariance: Array,
    first: int,
    end: int,
    j: int,
    rows: int,
) -> tuple[int, int]:
    """Filter IMU samples first..end-1 from measurement j and row `rows` on; return where both then stand."""
    m = views(floats, integers)
    w = work_views(m.work, m.layout[N_ERROR])
    rate, total = np.zeros(3), len(stamps)
    if first == 0:
        while j < total and stamps[j] < imu_stamps[0]:
            j += 1
        begin(m, imu_stamps[0], imu_values[0, 3:6], 0)
    for k in range(first, end):
        emitted = False
        while j < total and due(m, stamps[j]) <= imu_stamps[k]:
            last = j
            while last < total and stamps[last] == stamps[j]:
                last += 1
            columns = (stamps, kinds, objects, rotations, translations, covariances)
            measure_at(m, w, j, last, *columns, imu_stamps, imu_values, rate, decisions, nis)
            j = last
            if m.counters[MODE] == TRACKING:
                emit(m, rows, out_stamps, out_core, out_sigma, out_covariance)
                rows += 1
                emitted = m.counters[NOW] == imu_stamps[k]
        advance(m, w, imu_stamps, imu_values, imu_stamps[k])
        if m.counters[MODE] == TRACKING and not emitted:
            emit(m, rows, out_stamps, out_core, out_sigma, out_covariance)
            rows += 1
    return j, rows
