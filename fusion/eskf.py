"""The error-state Kalman filter: innovation, gate, update, and the memory it works in.

Written for compiled loops: the covariance stays symmetric because every update subtracts Z^T Z with Z = L^-1 H P
and S = L L^T (no inverse, no symmetrising), and the rows of H outside a measurement's own columns are never touched.
`fusion/reference_filter.py` is the same filter in plain numpy and filterpy, which the tests hold this one against.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.compiled import njit
from fusion.imu import write_gravity_basis
from fusion.nav_state import (
    AT_BIASES,
    AT_CLONE,
    AT_EXTRINSICS,
    AT_GRAVITY,
    AT_OBJECTS,
    AT_TIME_OFFSET,
    BIASES,
    CLONE,
    EXTRINSIC_ROTATION,
    GRAVITY,
    N_BIAS_KINDS,
    N_ERROR,
    N_OBJECTS,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    POSITION_ERROR,
    TIME_OFFSET,
    Array,
    Ints,
)
from fusion.so3_kernels import apply, exp_so3, log_so3, multiply, multiply_transposed_left, orthonormalise

REJECTED, POSITION_ONLY, ROTATION_ONLY, ACCEPTED = 0, 1, 2, 3  # bit 0: position used, bit 1: rotation used

# Places in the bias model, per kind: sigma of rotation (rad), across and along the ray (share of distance), time (s).
BIAS_ROTATION, BIAS_ACROSS, BIAS_ALONG, BIAS_TAU, BIAS_JUMP, BIAS_JUMP_AT, BIAS_MODEL_SIZE = range(7)


@njit(cache=True)
def innovation(P: Array, H: Array, columns: Ints, count: int, R: Array, n: int, PHt: Array, S: Array) -> None:
    """Write P H^T as rows (6, n) into PHt and S = H P H^T + R (6, 6)."""
    for r in range(6):
        for i in range(n):
            PHt[r, i] = 0.0
    for c in range(count):
        column = columns[c]
        for r in range(6):
            h = H[r, c]
            if h != 0.0:
                for i in range(n):
                    PHt[r, i] += h * P[column, i]
    for r in range(6):
        for s in range(r, 6):
            total = R[r, s]
            for c in range(count):
                total += H[s, c] * PHt[r, columns[c]]
            S[r, s] = S[s, r] = total


@njit(cache=True)
def cholesky(S: Array, first: int, size: int, L: Array) -> bool:
    """Write the Cholesky factor of S[first:first+size, same] into L; return False where S is not positive."""
    for i in range(size):
        for j in range(i + 1):
            total = S[first + i, first + j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if total <= 0.0:
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@njit(cache=True)
def whiten(L: Array, residual: Array, first: int, size: int, white: Array) -> float:
    """Write L^-1 residual[first:first+size] into white and return its squared norm, the NIS."""
    nis = 0.0
    for i in range(size):
        total = residual[first + i]
        for k in range(i):
            total -= L[i, k] * white[k]
        white[i] = total / L[i, i]
        nis += white[i] * white[i]
    return nis


@njit(cache=True)
def gate(S: Array, residual: Array, limits: Array, partial: float, L: Array, white: Array, nis: Array) -> int:
    """Decide what of a measurement to use; write its NIS [both, rotation, position] into nis (3,).

    limits (3,) are chi-square limits for both, rotation alone, position alone. A rotation that contradicts the
    state does not cost the position its update (partial >= 1), nor the other way round (partial >= 2).
    """
    nis[0] = nis[1] = nis[2] = np.inf
    if cholesky(S, 3, 3, L):
        nis[2] = whiten(L, residual, 3, 3, white)
    if not cholesky(S, 0, 6, L):
        return REJECTED
    nis[0] = whiten(L, residual, 0, 6, white)
    nis[1] = white[0] * white[0] + white[1] * white[1] + white[2] * white[2]
    if nis[0] <= limits[0]:
        return ACCEPTED
    if partial >= 1.0 and nis[2] <= limits[2]:
        return POSITION_ONLY
    if partial >= 2.0 and nis[1] <= limits[1]:
        return ROTATION_ONLY
    return REJECTED


@njit(cache=True)
def correct(
    x: Array,
    P: Array,
    PHt: Array,
    S: Array,
    residual: Array,
    first: int,
    size: int,
    layout: Ints,
    L: Array,
    white: Array,
    Z: Array,
    error: Array,
    scratch: Array,
) -> None:
    """Kalman update with rows first..first+size (size 3 or 6) of a measurement: x and P in place."""
    n = layout[N_ERROR]
    if not cholesky(S, first, size, L):
        return
    whiten(L, residual, first, size, white)
    for i in range(n):
        error[i] = 0.0
    for r in range(size):
        for i in range(n):
            Z[r, i] = PHt[first + r, i]
        for q in range(r):
            factor = L[r, q]
            for i in range(n):
                Z[r, i] -= factor * Z[q, i]
        factor = 1.0 / L[r, r]
        for i in range(n):
            Z[r, i] *= factor
            error[i] += Z[r, i] * white[r]
    for i in range(n):
        z0, z1, z2 = Z[0, i], Z[1, i], Z[2, i]
        if size == 6:
            z3, z4, z5 = Z[3, i], Z[4, i], Z[5, i]
            for j in range(n):
                total = z0 * Z[0, j] + z1 * Z[1, j] + z2 * Z[2, j]
                P[i, j] -= total + (z3 * Z[3, j] + z4 * Z[4, j] + z5 * Z[5, j])
        else:
            for j in range(n):
                P[i, j] -= z0 * Z[0, j] + z1 * Z[1, j] + z2 * Z[2, j]
    before = scratch[32:47]
    for i in range(15):
        before[i] = x[i]
    inject(x, error, layout, scratch)
    transport(P, before, x, error, layout, scratch)


@njit(cache=True)
def transport(P: Array, before: Array, x: Array, error: Array, layout: Ints, scratch: Array) -> None:
    """Carry P from the tangent space of the state before a correction to that of the state after it.

    Heading and position cannot be told from a bias that all objects share, whatever the filter believes they are. That
    direction stays unobservable only if errors are compared in world axes about the world's origin (the right-invariant
    error: R_true = Exp(xi) R, p_true = Exp(xi) p + rho, v likewise), so P is carried along with xi, rho, nu held:
    theta+ = R+^T R- theta, dp+ = dp + [p- - p+]x R- theta, and so for velocity and estimated object positions.
    Without it the filter grows sure of what it cannot know.
    Source: A. Barrau and S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE TAC 62 (2017).
    """
    n = layout[N_ERROR]
    G, skewed = scratch[0:9], scratch[9:18]
    multiply_transposed_left(x, before, G)
    n_objects = layout[N_OBJECTS] if layout[AT_OBJECTS] >= 0 else 0
    for part in range(2 + n_objects):
        if part < 2:
            row, at = POSITION_ERROR + 3 * part, POSITION + 3 * part
            dx, dy, dz = before[at] - x[at], before[at + 1] - x[at + 1], before[at + 2] - x[at + 2]
        else:
            row = layout[AT_OBJECTS] + 6 * (part - 2) + 3
            dx, dy, dz = -error[row], -error[row + 1], -error[row + 2]
        # skew(d) @ R-
        for j in range(3):
            skewed[j] = dy * before[6 + j] - dz * before[3 + j]
            skewed[3 + j] = dz * before[j] - dx * before[6 + j]
            skewed[6 + j] = dx * before[3 + j] - dy * before[j]
        _add_rows_and_columns(P, n, row, skewed)
    _turn_rows_and_columns(P, n, G, scratch)


@njit(cache=True)
def _add_rows_and_columns(P: Array, n: int, row: int, block: Array) -> None:
    """P <- G P G^T where G adds block @ attitude error to three rows."""
    for i in range(3):
        b0, b1, b2 = block[3 * i], block[3 * i + 1], block[3 * i + 2]
        for j in range(n):
            P[row + i, j] += b0 * P[0, j] + b1 * P[1, j] + b2 * P[2, j]
    for i in range(3):
        b0, b1, b2 = block[3 * i], block[3 * i + 1], block[3 * i + 2]
        for j in range(n):
            P[j, row + i] += b0 * P[j, 0] + b1 * P[j, 1] + b2 * P[j, 2]


@njit(cache=True)
def _turn_rows_and_columns(P: Array, n: int, G: Array, scratch: Array) -> None:
    """P <- G P G^T where G turns the attitude error."""
    for j in range(n):
        p0, p1, p2 = P[0, j], P[1, j], P[2, j]
        for i in range(3):
            P[i, j] = G[3 * i] * p0 + G[3 * i + 1] * p1 + G[3 * i + 2] * p2
    for j in range(n):
        p0, p1, p2 = P[j, 0], P[j, 1], P[j, 2]
        for i in range(3):
            P[j, i] = G[3 * i] * p0 + G[3 * i + 1] * p1 + G[3 * i + 2] * p2


@njit(cache=True)
def adopt_object(
    x: Array, P: Array, H: Array, columns: Ints, count: int, R: Array, k: int, layout: Ints, work: Array
) -> None:
    """Take an object whose pose was unknown into the state, where a detection with zero residual has put it.

    With 0 = H_x dx + H_o do + e its error is do = -H_o^-1 (H_x dx + e), so that P_o. = -H_o^-1 H_x P_x. and
    P_oo = H_o^-1 (H_x P H_x^T + R) H_o^-T; H_o is a rotation in either half. work holds 6 n + 36 floats.
    """
    n, at = layout[N_ERROR], layout[AT_OBJECTS] + 6 * k
    for i in range(6):
        for j in range(n):
            P[at + i, j] = P[j, at + i] = 0.0
    PHt, S = work[: 6 * n].reshape((6, n)), work[6 * n : 6 * n + 36].reshape((6, 6))
    innovation(P, H, columns, count, R, n, PHt, S)
    first = 0
    while columns[first] != at:
        first += 1
    for half in range(2):
        for i in range(3):
            for j in range(n):
                total = 0.0
                for r in range(3):
                    total += H[3 * half + r, first + 3 * half + i] * PHt[3 * half + r, j]
                P[at + 3 * half + i, j] = P[j, at + 3 * half + i] = -total
    for a in range(6):
        for b in range(6):
            total = 0.0
            for r in range(3):
                for s in range(3):
                    left = H[3 * (a // 3) + r, first + a]
                    right = H[3 * (b // 3) + s, first + b]
                    total += left * S[3 * (a // 3) + r, 3 * (b // 3) + s] * right
            P[at + a, at + b] = total


@njit(cache=True)
def inject(x: Array, error: Array, layout: Ints, scratch: Array) -> None:
    """Move the nominal state by an error state, in place (`nav_state.retract_state`)."""
    _turn(x, 0, error, 0, scratch)
    for i in range(12):
        x[POSITION + i] += error[POSITION_ERROR + i]
    at = layout[AT_EXTRINSICS]
    if at >= 0:
        _turn(x, EXTRINSIC_ROTATION, error, at, scratch)
        for i in range(3):
            x[EXTRINSIC_ROTATION + 9 + i] += error[at + 3 + i]
    if layout[AT_TIME_OFFSET] >= 0:
        x[TIME_OFFSET] += error[layout[AT_TIME_OFFSET]]
    if layout[AT_GRAVITY] >= 0:
        _turn_gravity(x, error, layout[AT_GRAVITY], scratch)
    for k in range(layout[N_OBJECTS] if layout[AT_OBJECTS] >= 0 else 0):
        start, at = OBJECTS + OBJECT_SIZE * k, layout[AT_OBJECTS] + 6 * k
        _turn(x, start, error, at, scratch)
        for i in range(3):
            x[start + 9 + i] += error[at + 3 + i]
    if layout[AT_BIASES] >= 0:
        for i in range(6 * layout[N_OBJECTS] * layout[N_BIAS_KINDS]):
            x[layout[BIASES] + i] += error[layout[AT_BIASES] + i]
    if layout[AT_CLONE] >= 0:
        start, at = layout[CLONE], layout[AT_CLONE]
        turn, turned = scratch[0:9], scratch[9:18]
        exp_so3(error[at], error[at + 1], error[at + 2], turn)
        multiply(turn, x[start : start + 9], turned)
        apply(turn, x[start + 9], x[start + 10], x[start + 11], scratch[18:21])
        orthonormalise(turned, turn)
        for i in range(9):
            x[start + i] = turned[i]
        for i in range(3):
            x[start + 9 + i] = scratch[18 + i] + error[at + 3 + i]


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


@njit(cache=True)
def _turn(x: Array, start: int, error: Array, at: int, scratch: Array) -> None:
    turn, turned = scratch[0:9], scratch[9:18]
    exp_so3(error[at], error[at + 1], error[at + 2], turn)
    multiply(x[start : start + 9], turn, turned)
    orthonormalise(turned, turn)
    for i in range(9):
        x[start + i] = turned[i]


@njit(cache=True)
def _turn_gravity(x: Array, error: Array, at: int, scratch: Array) -> None:
    basis = scratch[0:6]
    write_gravity_basis(x, basis)
    before = after = 0.0
    for i in range(3):
        before += x[GRAVITY + i] ** 2
        x[GRAVITY + i] += basis[2 * i] * error[at] + basis[2 * i + 1] * error[at + 1]
        after += x[GRAVITY + i] ** 2
    for i in range(3):
        x[GRAVITY + i] *= math.sqrt(before / after)


@njit(cache=True)
def decay_biases(x: Array, P: Array, seconds: float, bias_model: Array, layout: Ints) -> None:
    """Let the object biases relax for some seconds: first-order Gauss-Markov, exact for any step.

    b <- phi b, P_b <- phi^2 P_b + (1 - phi^2) sigma^2 with phi = exp(-seconds / tau); an infinite tau stays put. A bias
    far outside its sigma is a gross error in a run: it does not fade, and it wanders as far as it jumps.
    Cross terms commute with the IMU's propagation, so this is done once per update and not once per sample.
    """
    for kind in range(layout[N_BIAS_KINDS]):
        model = kind * BIAS_MODEL_SIZE
        phi = math.exp(-seconds / bias_model[model + BIAS_TAU])
        if phi == 1.0:
            continue
        for k in range(layout[N_OBJECTS]):
            shift = 6 * (k + kind * layout[N_OBJECTS])
            for first in (0, 3):
                _decay(
                    x,
                    P,
                    layout[N_ERROR],
                    layout[BIASES] + shift,
                    layout[AT_BIASES] + shift,
                    first,
                    kind,
                    phi,
                    bias_model,
                )


@njit(cache=True)
def _decay(x: Array, P: Array, n: int, b: int, at: int, first: int, kind: int, phi: float, bias_model: Array) -> None:
    fading = fades(x, b, first, kind, bias_model)
    for i in range(first, first + 3):
        sigma = bias_sigma(bias_model, kind, i)
        if fading:
            x[b + i] *= phi
            for j in range(n):
                P[at + i, j] *= phi
            for j in range(n):
                P[j, at + i] *= phi
        else:
            sigma *= bias_model[kind * BIAS_MODEL_SIZE + BIAS_JUMP]
        P[at + i, at + i] += (1.0 - phi * phi) * sigma * sigma


@njit(cache=True)
def fades(x: Array, b: int, first: int, kind: int, bias_model: Array) -> bool:
    """Tell whether half of the bias at x[b:] is no gross error, so that it relaxes."""
    furthest = 0.0
    for i in range(first, first + 3):
        furthest = max(furthest, abs(x[b + i]) / bias_sigma(bias_model, kind, i))
    return furthest <= bias_model[kind * BIAS_MODEL_SIZE + BIAS_JUMP_AT]


@njit(cache=True)
def forget_bias(
    x: Array, P: Array, k: int, first: int, bias_model: Array, layout: Ints, kind: int, jumped: bool
) -> None:
    """Forget an object's bias of rotation (first 0) or translation (3).

    Its mean becomes zero again and its sigma, if it jumped, a multiple of the stationary one; what it knew of other
    states is dropped.
    """
    shift = 6 * (k + kind * layout[N_OBJECTS])
    n, at, b = layout[N_ERROR], layout[AT_BIASES] + shift, layout[BIASES] + shift
    for i in range(first, first + 3):
        x[b + i] = 0.0
        for j in range(n):
            P[at + i, j] = P[j, at + i] = 0.0
        scale = bias_model[BIAS_JUMP] if jumped else 1.0
        P[at + i, at + i] = (scale * bias_sigma(bias_model, kind, i)) ** 2


@njit(cache=True)
def bias_sigma(bias_model: Array, kind: int, component: int) -> float:
    """Return the stationary 1-sigma of one bias component: rotation (rad) 0-2, across x, across y, along 3-5."""
    model = kind * BIAS_MODEL_SIZE
    if component < 3:
        return bias_model[model + BIAS_ROTATION]
    return bias_model[model + (BIAS_ALONG if component == 5 else BIAS_ACROSS)]


@njit(cache=True)
def fit_symmetry(R_m: Array, R_co: Array, axis: Array, order: int, R: Array, scratch: Array) -> None:
    """Turn a measured rotation R_m (9,), in place, about the symmetry axis to where it fits the prediction best.

    order 1: none; n > 1: by a multiple of 2 pi / n; 0: continuous, and then the variance about the axis in R (6, 6)
    becomes so large that only the two rows across it count. The best turn is the twist of R_m^T R_co about the axis.
    """
    if order == 1:
        return
    difference, vector, turn = scratch[0:9], scratch[9:12], scratch[12:21]
    multiply_transposed_left(R_m, R_co, difference)
    log_so3(difference, vector)
    angle = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    along = axis[0] * vector[0] + axis[1] * vector[1] + axis[2] * vector[2]
    half = 0.5 * angle
    sine = along * (math.sin(half) / angle if angle > 1e-9 else 0.5)
    twist = 2.0 * math.atan2(sine, math.cos(half))
    if order > 1:
        step = 2.0 * math.pi / order
        twist = step * math.floor(twist / step + 0.5)
    exp_so3(twist * axis[0], twist * axis[1], twist * axis[2], turn)
    multiply(R_m, turn, difference)
    for i in range(9):
        R_m[i] = difference[i]
    if order == 0:
        for i in range(3):
            for j in range(3):
                a_i = R_m[3 * i] * axis[0] + R_m[3 * i + 1] * axis[1] + R_m[3 * i + 2] * axis[2]
                a_j = R_m[3 * j] * axis[0] + R_m[3 * j + 1] * axis[1] + R_m[3 * j + 2] * axis[2]
                R[i, j] += 1e3 * a_i * a_j
