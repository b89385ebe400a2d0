"""Strapdown propagation of state and covariance between two IMU samples.

Midpoint integration: the angular velocity and specific force of an interval are the means of its two ends, and
the specific force is turned by the attitude of the interval's middle (holding the attitude of its start leaves
an error of 1e-2 m/s^2 on hand-held motion).
Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508 (S), section 5.4,
with the midpoint attitude in place of the start's and the bias terms kept to second order in dt.
"""

from __future__ import annotations

import numpy as np

from fusion.compiled import njit
from fusion.imu_noise import ACCEL_SQUARES, GYRO_SQUARES, density_squared
from fusion.nav_state import (
    ACCEL_BIAS,
    ACCEL_BIAS_ERROR,
    AT_GRAVITY,
    CORE,
    GRAVITY,
    GYRO_BIAS,
    GYRO_BIAS_ERROR,
    N_ERROR,
    POSITION,
    POSITION_ERROR,
    VELOCITY,
    VELOCITY_ERROR,
    Array,
    Ints,
)
from fusion.so3_kernels import apply, exp_so3, left_jacobian, multiply, orthonormalise, times_skew

# Places in the noise array (densities in Kalibr's units, then the uncertainty of a bridged gap).
GYRO_NOISE, ACCEL_NOISE, GYRO_WALK, ACCEL_WALK, GAP_S, GAP_RATE, GAP_ACCEL = range(7)
MEASURED, GUESSED = 10, 11  # 1 where the samples' own noise counts; where there is none, and motion is but a guess


@njit(cache=True)
def mean_until(stamps: Ints, values: Array, k: int, now: int, until: int, mean: Array) -> int:
    """Write the mean (6,) of both signals from now to sample k + 1 or until a stamp; return when that is.

    Between two samples both are linear in time: the mean over a part of an interval is the value at its middle.
    """
    start, end = stamps[k], stamps[k + 1]
    stop = min(end, until)
    share = 0.5 * ((now - start) + (stop - start)) / (end - start)
    for i in range(6):
        mean[i] = values[k, i] + share * (values[k + 1, i] - values[k, i])
    return stop


@njit(cache=True)
def propagate_nominal(x: Array, dt: float, angular_velocity: Array, specific_force: Array, work: Array) -> None:
    """Move the nominal state by dt seconds, in place; S eq. 260 with the midpoint attitude.

    angular_velocity (3,) rad/s and specific_force (3,) m/s^2 are means over the interval with their biases still on.
    Leaves in work: Exp(w dt) at 0, R_mid at 9, unbiased w at 18 and a at 21, world acceleration at 24.
    """
    turn, half, R_mid, accel = work[0:9], work[27:36], work[9:18], work[24:27]
    for i in range(3):
        work[18 + i] = angular_velocity[i] - x[GYRO_BIAS + i]
        work[21 + i] = specific_force[i] - x[ACCEL_BIAS + i]
    wx, wy, wz = work[18] * dt, work[19] * dt, work[20] * dt
    exp_so3(wx, wy, wz, turn)
    exp_so3(0.5 * wx, 0.5 * wy, 0.5 * wz, half)
    multiply(x, half, R_mid)
    apply(R_mid, work[21], work[22], work[23], accel)
    for i in range(3):
        accel[i] += x[GRAVITY + i]
        x[POSITION + i] += dt * x[VELOCITY + i] + 0.5 * dt * dt * accel[i]
        x[VELOCITY + i] += dt * accel[i]
    multiply(x, turn, half)
    for i in range(9):
        x[i] = half[i]
    orthonormalise(x, half)


@njit(cache=True)
def transition_blocks(dt: float, work: Array, blocks: Array) -> None:
    """Write the blocks of the core's transition matrix that are not identity, from what propagate_nominal left.

    blocks of 9: theta<-theta, theta<-gyro bias, velocity<-theta, velocity<-gyro bias, velocity<-accel bias.
    Position rows follow: position<-y = dt/2 * (velocity<-y), plus dt * velocity.  S eq. 270 with midpoint terms.
    """
    turn, R_mid, scratch, jacobian = work[0:9], work[9:18], work[27:36], work[36:45]
    wx, wy, wz = work[18] * dt, work[19] * dt, work[20] * dt
    ax, ay, az = work[21], work[22], work[23]
    left_jacobian(wx, wy, wz, -1.0, jacobian)
    for i in range(3):
        for j in range(3):
            blocks[3 * i + j] = turn[3 * j + i]
            blocks[9 + 3 * i + j] = -dt * jacobian[3 * i + j]
    # The start attitude's error turned to the middle: R Exp(theta) Exp(h) a = R_mid Exp(Exp(-h) theta) a.
    exp_so3(-0.5 * wx, -0.5 * wy, -0.5 * wz, jacobian)
    times_skew(R_mid, ax, ay, az, scratch)
    multiply(scratch, jacobian, blocks[18:27])
    left_jacobian(0.5 * wx, 0.5 * wy, 0.5 * wz, -1.0, jacobian)
    multiply(scratch, jacobian, blocks[27:36])
    for i in range(9):
        blocks[18 + i] *= -dt
        blocks[27 + i] *= 0.5 * dt * dt
        blocks[36 + i] = -dt * R_mid[i]


@njit(cache=True)
def rows_times(
    blocks: Array, dt: float, gravity_basis: Array, at_gravity: int, P: Array, columns: int, scratch: Array
) -> None:
    """P[:15, :columns] <- F P[:15, :columns] for the core's transition F, in place (and gravity's two columns of F)."""
    rate, half = scratch, 0.5 * dt
    for i in range(3):
        c0, c1, c2 = blocks[18 + 3 * i], blocks[19 + 3 * i], blocks[20 + 3 * i]
        d0, d1, d2 = blocks[27 + 3 * i], blocks[28 + 3 * i], blocks[29 + 3 * i]
        e0, e1, e2 = blocks[36 + 3 * i], blocks[37 + 3 * i], blocks[38 + 3 * i]
        for j in range(columns):
            total = c0 * P[0, j] + c1 * P[1, j] + c2 * P[2, j]
            total += d0 * P[9, j] + d1 * P[10, j] + d2 * P[11, j]
            rate[i, j] = total + e0 * P[12, j] + e1 * P[13, j] + e2 * P[14, j]
        if at_gravity >= 0:
            first, second = dt * gravity_basis[2 * i], dt * gravity_basis[2 * i + 1]
            for j in range(columns):
                rate[i, j] += first * P[at_gravity, j] + second * P[at_gravity + 1, j]
    for i in range(3):
        for j in range(columns):
            P[POSITION_ERROR + i, j] += dt * P[VELOCITY_ERROR + i, j] + half * rate[i, j]
            P[VELOCITY_ERROR + i, j] += rate[i, j]
    for i in range(3):
        a0, a1, a2 = blocks[3 * i], blocks[3 * i + 1], blocks[3 * i + 2]
        b0, b1, b2 = blocks[9 + 3 * i], blocks[10 + 3 * i], blocks[11 + 3 * i]
        for j in range(columns):
            rate[i, j] = a0 * P[0, j] + a1 * P[1, j] + a2 * P[2, j] + b0 * P[9, j] + b1 * P[10, j] + b2 * P[11, j]
    for i in range(3):
        for j in range(columns):
            P[i, j] = rate[i, j]


@njit(cache=True)
def propagate_covariance(
    P: Array,
    blocks: Array,
    dt: float,
    interval: float,
    noise: Array,
    sample: Array,
    gravity_basis: Array,
    layout: Ints,
    core: Array,
    scratch: Array,
) -> None:
    """P <- F P F^T + Q, in place, touching the core block and its cross terms only.

    P (n, n) symmetric; core (15 + 2, 15) and scratch (3, n) are work space. Everything outside the core is static here
    (bias states decay at updates only), so the cost grows with n and not with its square.
    """
    n, at_gravity = layout[N_ERROR], layout[AT_GRAVITY]
    rows_times(blocks, dt, gravity_basis, at_gravity, P, n, scratch)
    # (F P) F^T: the bias rows of F are identity, so that what is left is the block of attitude, position and velocity.
    for i in range(GYRO_BIAS_ERROR):
        for j in range(CORE):
            core[j, i] = P[i, j]
        if at_gravity >= 0:
            core[CORE, i] = P[i, at_gravity]
            core[CORE + 1, i] = P[i, at_gravity + 1]
    rows_times(blocks, dt, gravity_basis, CORE if at_gravity >= 0 else -1, core, GYRO_BIAS_ERROR, scratch)
    for i in range(GYRO_BIAS_ERROR):
        for j in range(i, GYRO_BIAS_ERROR):
            P[i, j] = P[j, i] = 0.5 * (core[i, j] + core[j, i])
        for j in range(GYRO_BIAS_ERROR, n):
            P[j, i] = P[i, j]
    add_process_noise(P, dt, interval, noise, sample)


@njit(cache=True)
def add_process_noise(P: Array, dt: float, interval: float, noise: Array, sample: Array) -> None:
    """Add what white noise and random walks do in dt seconds (S eq. 261, position integrated exactly).

    interval is the time (s) between the two samples that dt is a part of. One longer than noise[GAP_S] is a gap:
    angular rate and acceleration may have been anything of the given size all through it, so that their sigma grows
    with the interval and not with its root. sample (9,) is the row of the interval's end (`fusion/imu_noise.py`).
    """
    gyro = density_squared(noise[GYRO_NOISE], sample, GYRO_SQUARES, noise[MEASURED])
    accel = density_squared(noise[ACCEL_NOISE], sample, ACCEL_SQUARES, noise[MEASURED])
    if interval > noise[GAP_S]:
        gyro += noise[GAP_RATE] ** 2 * interval
        accel += noise[GAP_ACCEL] ** 2 * interval
    for i in range(3):
        P[i, i] += gyro * dt
        P[POSITION_ERROR + i, POSITION_ERROR + i] += accel * dt**3 / 3.0
        P[VELOCITY_ERROR + i, VELOCITY_ERROR + i] += accel * dt
        P[POSITION_ERROR + i, VELOCITY_ERROR + i] += 0.5 * accel * dt * dt
        P[VELOCITY_ERROR + i, POSITION_ERROR + i] += 0.5 * accel * dt * dt
        P[GYRO_BIAS_ERROR + i, GYRO_BIAS_ERROR + i] += noise[GYRO_WALK] ** 2 * dt
        P[ACCEL_BIAS_ERROR + i, ACCEL_BIAS_ERROR + i] += noise[ACCEL_WALK] ** 2 * dt


@njit(cache=True)
def write_gravity_basis(x: Array, basis: Array) -> None:
    """Write the (3, 2) tangent basis of gravity into basis (6,), as `nav_state.gravity_tangent` does."""
    gx, gy, gz = x[GRAVITY], x[GRAVITY + 1], x[GRAVITY + 2]
    norm = np.sqrt(gx * gx + gy * gy + gz * gz)
    dx, dy, dz = gx / norm, gy / norm, gz / norm
    if abs(dx) < 0.9:
        fx, fy, fz = 0.0, dz, -dy
    else:
        fx, fy, fz = -dz, 0.0, dx
    scale = np.sqrt(fx * fx + fy * fy + fz * fz)
    fx, fy, fz = fx / scale, fy / scale, fz / scale
    basis[0], basis[2], basis[4] = norm * fx, norm * fy, norm * fz
    basis[1], basis[3], basis[5] = norm * (dy * fz - dz * fy), norm * (dz * fx - dx * fz), norm * (dx * fy - dy * fx)
