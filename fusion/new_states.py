"""States that enter while the filter runs: the pose of an object that is met, and the clone of the imu's pose."""

from __future__ import annotations

from fusion.compiled import njit
from fusion.eskf import innovation
from fusion.memory import Memory, Work
from fusion.nav_state import AT_CLONE, AT_OBJECTS, CLONE, N_ERROR, POSITION, Array, Ints


@njit(cache=True)
def adopt_object(m: Memory, w: Work, k: int, count: int) -> None:
    """Take an object whose pose was unknown into the state, where a detection with zero residual has put it.

    With 0 = H_x dx + H_o do + e its error is do = -H_o^-1 (H_x dx + e), so that P_o. = -H_o^-1 H_x P_x. and
    P_oo = H_o^-1 (H_x P H_x^T + R) H_o^-T; H_o is a rotation in either half.
    """
    n, at, first, P, H = m.layout[N_ERROR], m.layout[AT_OBJECTS] + 6 * k, 0, m.P, w.H
    for i in range(6):
        for j in range(n):
            P[at + i, j] = P[j, at + i] = 0.0
    innovation(m, w, count)
    while m.columns[first] != at:
        first += 1
    for half in range(2):
        for i in range(3):
            for j in range(n):
                total = 0.0
                for r in range(3):
                    total += H[3 * half + r, first + 3 * half + i] * w.PHt[3 * half + r, j]
                P[at + 3 * half + i, j] = P[j, at + 3 * half + i] = -total
    for a in range(6):
        for b in range(6):
            total = 0.0
            for r in range(3):
                for s in range(3):
                    left = H[3 * (a // 3) + r, first + a]
                    right = H[3 * (b // 3) + s, first + b]
                    total += left * w.S[3 * (a // 3) + r, 3 * (b // 3) + s] * right
            P[at + a, at + b] = total


@njit(cache=True)
def clone_pose(x: Array, P: Array, layout: Ints) -> None:
    """Let the clone be the pose of now: xi = R theta, rho = dp + p x xi (see `nav_state`), in state and covariance.

    Source: S. Roumeliotis and J. Burdick, "Stochastic cloning", ICRA 2002.
    """
    start, at = layout[CLONE], layout[AT_CLONE]
    for i in range(12):
        x[start + i] = x[i]
    for j in range(at):
        _clone_errors(x, P[:, j], P[at:, j])
    for j in range(at + 6):
        _clone_errors(x, P[j], P[j, at:])
    for i in range(at, at + 6):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@njit(cache=True)
def _clone_errors(x: Array, pose: Array, clone: Array) -> None:
    px, py, pz = x[POSITION], x[POSITION + 1], x[POSITION + 2]
    a, b, c = pose[0], pose[1], pose[2]
    u, v, w = x[0] * a + x[1] * b + x[2] * c, x[3] * a + x[4] * b + x[5] * c, x[6] * a + x[7] * b + x[8] * c
    clone[0], clone[1], clone[2] = u, v, w
    clone[3], clone[4], clone[5] = pose[3] + py * w - pz * v, pose[4] + pz * u - px * w, pose[5] + px * v - py * u
