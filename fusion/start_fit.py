"""The correction that votes which agree ask for together: least squares over where their objects are and how turned.

Each vote asks for its object's place and, where it agrees whole, for the attitude it saw; how much either weighs is
what the detection's noise and biases say. Votes of one object err together, so they weigh as one in attitude and place;
camera poses err each by itself.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.ballot import MAX_SPEED, MAX_TILT, WHOLE, Ballot, Correction, seconds_since
from fusion.compiled import njit
from fusion.eskf import cholesky
from fusion.nav_state import Array
from fusion.so3_kernels import apply, exp_so3, log_so3, multiply, multiply_transposed_right
from fusion.votes import (
    VOTE_ACROSS,
    VOTE_ALONG,
    VOTE_ARM,
    VOTE_AXIS,
    VOTE_OBJECT,
    VOTE_ORDER,
    VOTE_PLACE,
    VOTE_TURN,
    fit_vote,
)

_ANY_HEADING = math.pi**-2  # 1 / rad^2: what is known of an attitude of which no vote tells
_EXACT = 1e-12  # rad^2, m^2: what says that it knows no error
_OTHERS = 32  # where camera poses are counted, beside the objects


@njit(cache=True)
def shift_of(ballot: Ballot, i: int, correction: Correction, out: Array) -> None:
    """Write where a correction puts the displacement that the integrated motion had at vote i, d and v left out.

    Integrated under a tilted gravity, the motion is off by (g - C g) t^2 / 2.
    """
    vote, C, origin, gravity = ballot.votes[i], correction.C, correction.origin, ballot.gravity
    since = seconds_since(ballot, i)
    x = vote[21] - origin[0] - since * origin[3]
    y = vote[22] - origin[1] - since * origin[4]
    z = vote[23] - origin[2] - since * origin[5]
    apply(C, x, y, z, out)
    for j in range(3):
        turned = C[3 * j] * gravity[0] + C[3 * j + 1] * gravity[1] + C[3 * j + 2] * gravity[2]
        out[j] += 0.5 * (gravity[j] - turned) * since * since


@njit(cache=True)
def fit_correction(ballot: Ballot, correction: Correction) -> None:
    """Improve a correction by one Gauss-Newton step over the votes of which something agrees with it.

    Gravity weighs with a third of the start's max_tilt, and velocities beyond max_speed count as unlikely. Unknowns:
    a turn of C on the left (rad), d (m), v (m/s).
    """
    A, b, turn, turned = np.zeros((9, 9)), np.zeros(9), np.zeros(9), np.zeros(9)
    C, d, v = correction.C, correction.d, correction.v
    _add_votes(ballot, correction, A, b)
    _add_gravity(C, ballot.up, ballot.options[MAX_TILT], A, b)
    weight = max(ballot.options[MAX_SPEED], 1e-3) ** -2
    for j in range(3):
        A[j, j] += _ANY_HEADING
        A[6 + j, 6 + j] += weight
        b[6 + j] -= v[j] * weight
    if not _solve(A, b):
        return
    exp_so3(b[0], b[1], b[2], turn)
    multiply(turn, C, turned)
    for i in range(9):
        C[i] = turned[i]
    for j in range(3):
        d[j] += b[3 + j]
        v[j] += b[6 + j]


@njit(cache=True)
def _solve(A: Array, b: Array) -> bool:
    """b <- A^-1 b for a positive definite A (9, 9); False: it is none."""
    L = np.zeros((9, 9))
    if not cholesky(A, 0, 9, L):
        return False
    for i in range(9):
        for j in range(i):
            b[i] -= L[i, j] * b[j]
        b[i] /= L[i, i]
    for i in range(8, -1, -1):
        for j in range(i + 1, 9):
            b[i] -= L[j, i] * b[j]
        b[i] /= L[i, i]
    return True


@njit(cache=True)
def _add_votes(ballot: Ballot, correction: Correction, A: Array, b: Array) -> None:
    """Add what agrees of each vote: its object's place, the attitude that it saw."""
    placed, whole, mask = np.zeros(_OTHERS + 1), np.zeros(_OTHERS + 1), len(ballot.stamps) - 1
    for a in range(ballot.first, ballot.head):
        agreed, owner = correction.agreed[a & mask], _owner(ballot.votes[a & mask])
        placed[owner] += agreed != 0
        whole[owner] += agreed & WHOLE != 0
    placed[_OTHERS] = whole[_OTHERS] = 1.0  # camera poses err each by itself; where not, their covariances are wider
    for a in range(ballot.first, ballot.head):
        agreed, owner = correction.agreed[a & mask], _owner(ballot.votes[a & mask])
        if agreed != 0:
            _add_place(ballot, a & mask, correction, 1.0 / placed[owner], A, b)
        if agreed & WHOLE != 0:
            _add_turn(ballot.votes[a & mask], correction.C, 1.0 / whole[owner], A, b)


@njit(cache=True)
def _owner(vote: Array) -> int:
    k = int(vote[VOTE_OBJECT])
    return k % _OTHERS if k >= 0 else _OTHERS


@njit(cache=True)
def _add_place(ballot: Ballot, i: int, correction: Correction, share: float, A: Array, b: Array) -> None:
    """Add that the object of vote i is at its place, C R_m arm + shift(C) + d + v t; a turn moves it by theta x q."""
    turned, arm, shift, q, r, W = np.zeros(9), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3))
    J, vote, since = np.zeros((3, 9)), ballot.votes[i], seconds_since(ballot, i)
    multiply(correction.C, vote[12:21], turned)
    apply(turned, vote[VOTE_ARM], vote[VOTE_ARM + 1], vote[VOTE_ARM + 2], arm)
    shift_of(ballot, i, correction, shift)
    for j in range(3):
        q[j] = arm[j] + shift[j] - 0.5 * ballot.gravity[j] * since * since
        r[j] = vote[VOTE_PLACE + j] - arm[j] - shift[j] - correction.d[j] - correction.v[j] * since
        J[j, 3 + j], J[j, 6 + j] = 1.0, since
    J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = q[2], -q[1], -q[2], q[0], q[1], -q[0]
    across, along = share / max(vote[VOTE_ACROSS], _EXACT), share / max(vote[VOTE_ALONG], _EXACT)
    squared = arm[0] ** 2 + arm[1] ** 2 + arm[2] ** 2
    for j in range(3):
        for k in range(3):
            W[j, k] = (along - across) * arm[j] * arm[k] / squared if squared > 0.0 else 0.0
        W[j, j] += across
    _add(J, W, r, A, b)


@njit(cache=True)
def _add_turn(vote: Array, C: Array, share: float, A: Array, b: Array) -> None:
    """Add that the attitude is the one that a vote saw; about a continuous symmetry's axis it says nothing."""
    turned, fitted, difference, r = np.zeros(9), np.zeros(12), np.zeros(9), np.zeros(3)
    J, W = np.zeros((3, 9)), np.zeros((3, 3))
    multiply(C, vote[12:21], turned)
    fit_vote(vote, turned, fitted, np.zeros(21))
    multiply_transposed_right(fitted, turned, difference)
    log_so3(difference, r)
    for j in range(3):
        J[j, j] = 1.0
        W[j, j] = share / max(vote[VOTE_TURN], _EXACT)
        for k in range(3 if vote[VOTE_ORDER] == 0.0 else 0):
            W[j, k] -= share / max(vote[VOTE_TURN], _EXACT) * vote[VOTE_AXIS + j] * vote[VOTE_AXIS + k]
    _add(J, W, r, A, b)


@njit(cache=True)
def _add_gravity(C: Array, up: Array, max_tilt: float, A: Array, b: Array) -> None:
    """Add that the corrected up (3,) is vertical; zero: nothing feels gravity."""
    norm, u = math.sqrt(up[0] ** 2 + up[1] ** 2 + up[2] ** 2), np.zeros(3)
    if norm == 0.0:
        return
    apply(C, up[0] / norm, up[1] / norm, up[2] / norm, u)
    weight = (3.0 / max(max_tilt, 1e-3)) ** 2
    for j in range(2):
        A[j, j] += weight
    b[0] += weight * u[1]
    b[1] -= weight * u[0]


@njit(cache=True)
def _add(J: Array, W: Array, r: Array, A: Array, b: Array) -> None:
    """A <- A + J^T W J, b <- b + J^T W r."""
    for i in range(9):
        for k in range(3):
            weighted = J[0, i] * W[0, k] + J[1, i] * W[1, k] + J[2, i] * W[2, k]
            b[i] += weighted * r[k]
            for j in range(9):
                A[i, j] += weighted * J[k, j]
