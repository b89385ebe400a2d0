"""What the filter did to its error, written down for the smoother to go back over: one record per linear map.

A memory without a tape (the filter's own runs) writes nothing. Records are read from the end, so each ends with its
length and its kind; numbers of any type are stored as floats.

    STEP        dt, the core's transition blocks (45), gravity's basis (6)
    ODOMETRY    Exp(w dt) (9), R skew(step) (9)
    DECAY       the factor of every object bias
    CORRECTION  parts, G (9), skew blocks (9 each); rows, columns, their numbers, L^-1 H, L^-1 residual, Z = L^-1 H P
    CLOCK       what a correction adds to the core's first nine errors per time offset (`eskf.transport_clock`)
    MEETING     the object's first error state, columns, their numbers, the derivative of its pose by them (6 rows)
    FORGETTING  first error state, how many
    RESTART     which error states (n) survive
    CLONING     R_world_imu (9), [p]x R_world_imu (9): the clone's error made of the pose's
    ROW         number, x (core), the core's rows of P
"""

from __future__ import annotations

import numpy as np

from fusion.compiled import njit
from fusion.eskf import lever_of_part, parts_carried
from fusion.measurements import MAX_COLUMNS
from fusion.memory import AT_TAPE, BIAS_TIME, NOW, RESTARTS, TAPE_END, TAPE_SIZE, Memory, Work
from fusion.nav_state import (
    AT_BIASES,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    BIASES,
    CORE,
    EXTRINSIC_ROTATION,
    N_BIAS_KINDS,
    N_ERROR,
    N_OBJECTS,
    POSITION,
    Array,
    Ints,
)
from fusion.object_biases import bias_phi, fades
from fusion.so3_kernels import multiply_transposed_left

STEP, ODOMETRY, DECAY, CORRECTION, MEETING, FORGETTING, RESTART, ROW, CLONING, CLOCK = range(10)
STEP_SIZE, TAIL = 52, 2


def with_tape(floats: Array, integers: Ints, size: int) -> tuple[Array, Ints]:
    """Return copies of a filter's buffers that have room for so many floats of tape."""
    integers = integers.copy()
    integers[AT_TAPE], integers[TAPE_SIZE] = len(floats), size
    return np.concatenate([floats, np.zeros(size)]), integers


def tape_bound(layout: Ints, samples: int, stamps: int, measurements: int) -> int:
    """Return how many floats so many IMU samples, stamps with measurements and measurements write at most."""
    n, K = int(layout[N_ERROR]), int(layout[N_OBJECTS])
    biases = 6 * K * int(layout[N_BIAS_KINDS])
    steps, row = (samples + stamps) * (STEP_SIZE + TAIL), 1 + CORE + 6 + CORE * n + TAIL
    correction = 1 + 9 * (3 + K) + 2 + MAX_COLUMNS + 6 * MAX_COLUMNS + 6 + 6 * n + TAIL + 9 + TAIL
    meeting_and_forgetting = 2 + MAX_COLUMNS + 6 * MAX_COLUMNS + TAIL + 8 * (2 + TAIL)
    per_stamp = biases + TAIL + 2 * (n + TAIL) + 18 + TAIL
    return steps + (samples + stamps) * row + stamps * per_stamp + measurements * (correction + meeting_and_forgetting)


@njit(cache=True, inline="always")
def _close(m: Memory, end: int, kind: int) -> None:
    """End a record whose numbers reach to `end`."""
    m.tape[end] = end - m.counters[TAPE_END]
    m.tape[end + 1] = kind
    m.counters[TAPE_END] = end + TAIL


@njit(cache=True)
def note_step(m: Memory, w: Work, dt: float) -> None:
    """Write down a step of the IMU."""
    at = m.counters[TAPE_END]
    m.tape[at] = dt
    for i in range(45):
        m.tape[at + 1 + i] = w.blocks[i]
    for i in range(6):
        m.tape[at + 46 + i] = w.basis[i]
    _close(m, at + 52, STEP)


@njit(cache=True)
def note_odometry(m: Memory, w: Work) -> None:
    """Write down a step of the odometry, from what `odometry.spread_by_odometry` left."""
    at = m.counters[TAPE_END]
    for i in range(9):
        m.tape[at + i] = w.step[i]
        m.tape[at + 9 + i] = w.step[36 + i]
    _close(m, at + 18, ODOMETRY)


@njit(cache=True)
def note_decay(m: Memory) -> None:
    """Write down what `object_biases.decay_biases` is about to do."""
    seconds = (m.counters[NOW] - m.counters[BIAS_TIME]) * 1e-9
    at, K = m.counters[TAPE_END], m.layout[N_OBJECTS]
    for kind in range(m.layout[N_BIAS_KINDS]):
        for k in range(K):
            shift = 6 * (k + kind * K)
            for first in (0, 3):
                fading = fades(m.x, m.layout[BIASES] + shift, first, kind, m.bias_model)
                for i in range(first, first + 3):
                    m.tape[at + shift + i] = bias_phi(m.bias_model, kind, i, seconds) if fading else 1.0
    _close(m, at + 6 * K * m.layout[N_BIAS_KINDS], DECAY)


@njit(cache=True)
def note_correction(m: Memory, w: Work, first: int, size: int, count: int) -> None:
    """Write down a correction with rows first..first+size, from what `eskf.correct` left."""
    tape, n, before = m.tape, m.layout[N_ERROR], w.scratch[32:47]
    at = m.counters[TAPE_END]
    parts = parts_carried(m.layout)
    tape[at] = parts
    multiply_transposed_left(m.x, before, tape[at + 1 : at + 10])
    at += 10
    for part in range(parts):
        lever_of_part(m.layout, part, before, m.x, w.error, tape[at : at + 9])
        at += 9
    tape[at], tape[at + 1] = size, count
    at += 2
    for c in range(count):
        tape[at + c] = m.columns[c]
    at += count
    for r in range(size):  # L^-1 H
        for c in range(count):
            total = w.H[first + r, c]
            for q in range(r):
                total -= w.L[r, q] * tape[at + q * count + c]
            tape[at + r * count + c] = total / w.L[r, r]
    at += size * count
    for r in range(size):
        tape[at + r] = w.white[r]
        for j in range(n):
            tape[at + size + r * n + j] = w.Z[r, j]
    _close(m, at + size + size * n, CORRECTION)
    if m.layout[AT_TIME_OFFSET] >= 0:
        at = m.counters[TAPE_END]
        for i in range(9):
            tape[at + i] = w.scratch[50 + i]
        _close(m, at + 9, CLOCK)


@njit(cache=True)
def note_meeting(m: Memory, w: Work, k: int, count: int) -> None:
    """Write down that object k was placed where its first detection saw it (`new_states.adopt_object`)."""
    tape, at, own = m.tape, m.counters[TAPE_END], m.layout[AT_OBJECTS] + 6 * k
    tape[at], tape[at + 1] = own, count
    at += 2
    first = 0
    while m.columns[first] != own:
        first += 1
    for c in range(count):
        tape[at + c] = m.columns[c]
    at += count
    for r in range(6):
        half = 3 * (r // 3)
        for c in range(count):
            total = 0.0
            for s in range(3):
                total += w.H[half + s, first + r] * w.H[half + s, c]
            tape[at + r * count + c] = 0.0 if first <= c < first + 6 else -total
    _close(m, at + 6 * count, MEETING)


@njit(cache=True)
def note_forgetting(m: Memory, k: int, first: int) -> None:
    """Write down that half of an object's varying bias was forgotten."""
    at = m.counters[TAPE_END]
    m.tape[at], m.tape[at + 1] = m.layout[AT_BIASES] + 6 * k + first, 3
    _close(m, at + 2, FORGETTING)


@njit(cache=True)
def survives(m: Memory, i: int, keep_from: int) -> bool:
    """Tell whether error state i survives a start that keeps those from keep_from on (0: none).

    Biases of objects never do, their poses always: what a filter that gave up knew of them, it still knows.
    """
    biases, objects = m.layout[AT_BIASES], m.layout[AT_OBJECTS]
    if 0 <= biases <= i < biases + 6 * m.layout[N_OBJECTS] * m.layout[N_BIAS_KINDS]:
        return False
    if m.counters[RESTARTS] > 0 and 0 <= objects <= i < objects + 6 * m.layout[N_OBJECTS]:
        return True
    return 0 < keep_from <= i


@njit(cache=True)
def note_restart(m: Memory, keep_from: int) -> None:
    """Write down which error states survive a restart (`starting.adopt`)."""
    at, n = m.counters[TAPE_END], m.layout[N_ERROR]
    for i in range(n):
        m.tape[at + i] = 1.0 if survives(m, i, keep_from) else 0.0
    _close(m, at + n, RESTART)


@njit(cache=True)
def note_clone(m: Memory) -> None:
    """Write down that the clone became the pose of now (`new_states.clone_pose`)."""
    tape, x, at = m.tape, m.x, m.counters[TAPE_END]
    px, py, pz = x[POSITION], x[POSITION + 1], x[POSITION + 2]
    for i in range(9):
        tape[at + i] = x[i]
    for j in range(3):
        tape[at + 9 + j] = py * x[6 + j] - pz * x[3 + j]
        tape[at + 12 + j] = pz * x[j] - px * x[6 + j]
        tape[at + 15 + j] = px * x[3 + j] - py * x[j]
    _close(m, at + 18, CLONING)


@njit(cache=True)
def note_row(m: Memory, row: int) -> None:
    """Write down the state that a row of the output shows."""
    tape, n, at = m.tape, m.layout[N_ERROR], m.counters[TAPE_END]
    tape[at] = row
    for i in range(EXTRINSIC_ROTATION):
        tape[at + 1 + i] = m.x[i]
    at += 1 + EXTRINSIC_ROTATION
    for i in range(CORE):
        for j in range(n):
            tape[at + i * n + j] = m.P[i, j]
    _close(m, at + CORE * n, ROW)
