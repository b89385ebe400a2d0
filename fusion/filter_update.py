"""The filter at a measurement: gate it, take in what passes, put an object where it is seen, forget what jumped."""

from __future__ import annotations

import numpy as np

from fusion.columns import Columns, read, read_fitted
from fusion.compiled import njit
from fusion.eskf import ACCEPTED, POSITION_ONLY, REJECTED, ROTATION_ONLY, correct, gate, innovation
from fusion.imu import GUESSED
from fusion.lasting_share import MET
from fusion.measurements import OBJECT_POSE, object_in_world, residual_and_jacobian
from fusion.meeting import UNKNOWN_MAP
from fusion.memory import MODE, NOW, TRACKING, Memory, Work
from fusion.nav_state import N_BIAS_KINDS, N_OBJECTS, OBJECT_SIZE, OBJECTS, TIME_OFFSET, Array
from fusion.new_states import adopt_object
from fusion.object_biases import forget_bias
from fusion.place_watch import ON_MAP, RELEASED, TURNED, status_of
from fusion.scatter import follow_scatter
from fusion.tape import note_correction, note_forgetting, note_meeting
from fusion.votes import VOTE_ACROSS, VOTE_ALONG, VOTE_TURN

# Places in the limits.
LIMIT_BOTH, LIMIT_ROTATION, LIMIT_POSITION, PARTIAL, ADAPTATION, MAX_SCALE, JUMP_AFTER, SETTLED = range(8)

GROSS = 10.0  # times the limit of the rotation's nis
FAR_OFF = 4.0  # times the limit of a half: what detections state of themselves mostly is half of their error
LINEAR = 0.35  # rad: a turn beyond it is left to votes that agree with each other (`starting.starts`)


@njit(cache=True)
def take(m: Memory, w: Work, log: Columns, j: int, correcting: bool) -> int:
    """Gate measurement j and, where correcting, take in what passes; write its NIS, return what passed."""
    kind, k, nis = log.kinds[j], log.objects[j], log.nis[j]
    if kind == OBJECT_POSE and m.known[k] == 0.0:
        nis[0] = np.inf
        return REJECTED
    count, decision = _meet_gate(m, w, log, j)
    status = status_of(m, kind, k)
    if is_far(m, w.residual) or (decision == POSITION_ONLY and is_blunder(m, nis[1])):
        decision = REJECTED
    if not correcting:
        return decision
    if status != ON_MAP:
        decision = POSITION_ONLY if status == TURNED and nis[2] <= m.limits[LIMIT_POSITION] else REJECTED
    if decision != REJECTED:
        _correct(m, w, 3 if decision == POSITION_ONLY else 0, 6 if decision == ACCEPTED else 3, count)
    return decision if status == ON_MAP else decision | RELEASED


@njit(cache=True)
def settle(m: Memory, w: Work, log: Columns, j: int, vote: Array) -> int:
    """Tie a state that has just started to measurement j, which agreed to it by this vote; return what passed.

    The state is at the mean of all that agreed, which one of them knows less of: it does not move, and what errs with
    it narrows the gate. But where the pose is off by more than its whole error explains, it is surer than what carried
    the others (a gyroscope's bias over half a second is half a degree), and the state moves to it.
    """
    count, decision = _meet_gate(m, w, log, j)
    if decision != ACCEPTED:
        return REJECTED
    r, whole = w.residual, (2.0 * vote[VOTE_ACROSS] + vote[VOTE_ALONG]) / 3.0
    turn = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]) / vote[VOTE_TURN]
    place = (r[3] * r[3] + r[4] * r[4] + r[5] * r[5]) / whole
    far = FAR_OFF if log.kinds[j] == OBJECT_POSE else 1.0
    if turn <= far * m.limits[LIMIT_ROTATION] and place <= far * m.limits[LIMIT_POSITION]:
        r[:] = 0.0
    _correct(m, w, 0, 6, count)
    return ACCEPTED


@njit(cache=True)
def _meet_gate(m: Memory, w: Work, log: Columns, j: int) -> tuple[int, int]:
    """Write measurement j's innovation and NIS; return how many columns H has, and what the gate lets through."""
    kind, k = log.kinds[j], log.objects[j]
    read_fitted(m, w, log, j)
    count = _predict(m, w, kind, k)
    if kind == OBJECT_POSE:
        follow_scatter(m, k, log.translations[j], w.residual)
    innovation(m, w, count)
    return count, gate(w.S, w.residual, m.limits, m.limits[PARTIAL], w.L, w.white, log.nis[j])


@njit(cache=True)
def _correct(m: Memory, w: Work, first: int, size: int, count: int) -> None:
    """Take in rows first..first+size of the measurement whose innovation was written."""
    correct(m, w, first, size)
    if len(m.tape) > 0:
        note_correction(m, w, first, size, count)


@njit(cache=True)
def is_unsettled(m: Memory) -> bool:
    """Tell whether the state is unsure of its position."""
    return m.P[3, 3] + m.P[4, 4] + m.P[5, 5] > m.limits[SETTLED]


@njit(cache=True)
def is_blunder(m: Memory, nis_rotation: float) -> bool:
    """Tell whether a rotation is so far off that an unsure state, whose gate is wide, should not trust the position.

    A flipped box also seems to stand aside. Where the map is unknown, what the state stands on may be the flip.
    """
    known = m.meeting[UNKNOWN_MAP] == 0.0
    return known and nis_rotation > GROSS * m.limits[LIMIT_ROTATION] and is_unsettled(m)


@njit(cache=True)
def is_lost(m: Memory) -> bool:
    """Tell whether the state is so unsure of its attitude that it may be anywhere.

    Not where its motion is but a guess: what carries the votes to each other would be no better.
    """
    return m.noise[GUESSED] == 0.0 and m.P[0, 0] + m.P[1, 1] + m.P[2, 2] > LINEAR**2


@njit(cache=True)
def is_far(m: Memory, residual: Array) -> bool:
    """Tell whether a rotation is so far off, and the attitude so unsure, that what is linear there does not hold."""
    return is_lost(m) and residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2 > LINEAR**2


@njit(cache=True)
def _predict(m: Memory, w: Work, kind: int, k: int) -> int:
    """Write residual and Jacobian of the measurement in w.measured; return how many columns H has."""
    R_m, t_m, offset = w.measured[0:9], w.measured[9:12], w.offset[0]
    return residual_and_jacobian(kind, k, R_m, t_m, m.x, w.rate, offset, m.layout, w.residual, w.H, m.columns, w.step)


@njit(cache=True)
def put_object(m: Memory, w: Work, log: Columns, j: int) -> None:
    """Put an object whose pose in the world is unknown where detection j sees it, symmetric or not."""
    k = log.objects[j]
    at = OBJECTS + OBJECT_SIZE * k
    read(m, w, log, j)
    seconds = m.x[TIME_OFFSET] - w.offset[0]
    object_in_world(m.x, seconds, w.rate, w.measured[0:9], w.measured[9:12], m.x[at : at + OBJECT_SIZE], w.step)
    forget_biases(m, k, False)
    count = _predict(m, w, OBJECT_POSE, k)
    adopt_object(m, w, k, count)
    m.known[k], m.pairs[k, MET] = 1.0, m.counters[NOW]
    if len(m.tape) > 0:
        note_meeting(m, w, k, count)


@njit(cache=True)
def follow_jumps(m: Memory, log: Columns, j: int) -> None:
    """Networks err in runs: an object refused often in a row has another bias now, so its old one is forgotten."""
    kind, k = log.kinds[j], log.objects[j]
    if kind != OBJECT_POSE or m.counters[MODE] != TRACKING or m.layout[N_BIAS_KINDS] == 0:
        return
    for part in range(status_of(m, kind, k), 2):  # what is released cannot jump
        used = log.decisions[j] & (POSITION_ONLY if part == 1 else ROTATION_ONLY)
        m.refused[k, part] = 0.0 if used else m.refused[k, part] + 1.0
        if m.refused[k, part] >= m.limits[JUMP_AFTER]:
            _forget(m, k, 0, 3 * part, True)
            m.refused[k, part] = 0.0


@njit(cache=True)
def forget_biases(m: Memory, k: int, jumped: bool) -> None:
    """Forget every bias of an object that is put elsewhere; where its detections jumped, the varying one has too."""
    for kind in range(m.layout[N_BIAS_KINDS]):
        for first in (0, 3):
            _forget(m, k, kind, first, jumped and kind == 0)
    m.refused[k, 0] = m.refused[k, 1] = 0.0


@njit(cache=True)
def _forget(m: Memory, k: int, kind: int, first: int, jumped: bool) -> None:
    forget_bias(m, k, kind, first, jumped)
    if len(m.tape) > 0:
        note_forgetting(m, k + kind * m.layout[N_OBJECTS], first)
