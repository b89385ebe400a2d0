"""Propagation by odometry instead of an IMU: relative poses with drift, no gravity, no biases.

Between two poses of the odometry the body moves at a constant twist, so the motion over any part of the interval is
the exponential of that part: R <- R Exp(w dt), p <- p + R J_l(w dt) v dt. Its errors are random walks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.compiled import njit
from fusion.nav_state import N_ERROR, POSITION, POSITION_ERROR, VELOCITY, Array, Ints
from fusion.options import FuseOptions
from fusion.so3_kernels import apply, exp_so3, left_jacobian, multiply, orthonormalise, times_skew
from poet_loc.core.geometry import local
from poet_loc.core.odometry_breaks import Expected, believed_motion, unseen_sigmas
from poet_loc.core.records import ImuSamples
from poet_loc.core.trajectory import Trajectory

# Places in the noise array, behind those of the IMU.
IS_ODOMETRY, ROTATION_WALK, TRANSLATION_WALK = 7, 8, 9

# Places in a row of the samples, where an IMU's say how noisy it is: variances per second and axis of what is not known
# of the motion until the next one (`believed_samples`).
ROTATION_DOUBT, TRANSLATION_DOUBT = 6, 7


def odometry_samples(T_odom_cam: Trajectory, T_cam_body: RigidTransform) -> ImuSamples:
    """Return the body's twist from each pose of the odometry to the next, in the place of IMU samples.

    Angular velocity (rad/s) stands for itself, the body's velocity (m/s, body axes) in the place of the specific force;
    both hold until the next stamp.
    """
    T_odom_body = T_odom_cam.T_world_body * T_cam_body
    seconds = np.diff(T_odom_cam.stamps_ns)[:, None] * 1e-9
    twist = local(T_odom_body[:-1], T_odom_body[1:]) / seconds
    twist = np.vstack([twist, twist[-1:]])
    return ImuSamples(T_odom_cam.stamps_ns, np.ascontiguousarray(twist[:, :3]), np.ascontiguousarray(twist[:, 3:]))


def expected_of(options: FuseOptions) -> Expected:
    """Return how odometry drifts, and what a camera may do in its holes, as the options say."""
    walk, gap = options.odometry, options.gap
    drift = float(np.radians(walk.rotation_walk_deg)), walk.translation_walk
    return Expected(drift, gap.longest_s, (gap.angular_rate, gap.speed))


def believed_samples(
    samples: ImuSamples, stamps_ns: NDArray[np.int64], options: FuseOptions
) -> tuple[ImuSamples, Array]:
    """Return what to believe of `odometry_samples`, and the variances (N, 2) per second of what is not known of it.

    Where measurements of stamps_ns lie before and behind it, the body stands still, which nobody believes.
    """
    stamps, expected = samples.stamps_ns, expected_of(options)
    found = believed_motion(stamps, np.hstack([samples.angular_velocity, samples.specific_force])[:-1], expected)
    twists, sigmas, still = found.twists, found.sigmas, np.zeros(6)
    if len(stamps_ns) and stamps_ns[0] < stamps[0]:
        unseen = unseen_sigmas(np.array([stamps[0] - stamps_ns[0]]) * 1e-9, expected)
        stamps, twists, sigmas = np.r_[stamps_ns[0], stamps], np.vstack([still, twists]), np.vstack([unseen, sigmas])
    if len(stamps_ns) and stamps_ns[-1] > stamps[-1]:
        unseen = unseen_sigmas(np.array([stamps_ns[-1] - stamps[-1]]) * 1e-9, expected)
        stamps, twists, sigmas = np.r_[stamps, stamps_ns[-1]], np.vstack([twists, still]), np.vstack([sigmas, unseen])
    doubts, twists = sigmas**2 / (np.diff(stamps)[:, None] * 1e-9), np.vstack([twists, twists[-1:]])
    kept = np.ascontiguousarray(twists[:, :3]), np.ascontiguousarray(twists[:, 3:])
    return ImuSamples(stamps, *kept), np.vstack([doubts, doubts[-1:]])


@njit(cache=True)
def move_by_odometry(x: Array, dt: float, rate: Array, velocity: Array, work: Array) -> None:
    """Move the nominal state by dt seconds of a twist, in place; leave Exp(w dt) at 0 and R dp at 18 of work."""
    turn, jacobian, step, moved = work[0:9], work[9:18], work[18:21], work[27:36]
    wx, wy, wz = rate[0] * dt, rate[1] * dt, rate[2] * dt
    exp_so3(wx, wy, wz, turn)
    left_jacobian(wx, wy, wz, 1.0, jacobian)
    apply(jacobian, velocity[0] * dt, velocity[1] * dt, velocity[2] * dt, work[21:24])
    apply(x, work[21], work[22], work[23], step)
    multiply(x, turn, moved)
    for i in range(9):
        x[i] = moved[i]
    orthonormalise(x, moved)
    apply(x, velocity[0], velocity[1], velocity[2], moved)
    for i in range(3):
        x[POSITION + i] += step[i]
        x[VELOCITY + i] = moved[i]


@njit(cache=True)
def spread_by_odometry(
    P: Array, R_before: Array, dt: float, noise: Array, sample: Array, layout: Ints, work: Array
) -> None:
    """P <- F P F^T + Q after `move_by_odometry`, in place: attitude turns with the body, position by the lever.

    sample (9,) is the row whose twist it was.
    """
    n, lever, turn = layout[N_ERROR], work[36:45], work[0:9]
    times_skew(R_before, work[21], work[22], work[23], lever)
    for side in range(2):
        for j in range(n):
            a0, a1, a2 = (P[0, j], P[1, j], P[2, j]) if side == 0 else (P[j, 0], P[j, 1], P[j, 2])
            for i in range(3):
                turned = turn[i] * a0 + turn[3 + i] * a1 + turn[6 + i] * a2
                shift = lever[3 * i] * a0 + lever[3 * i + 1] * a1 + lever[3 * i + 2] * a2
                if side == 0:
                    P[POSITION_ERROR + i, j] -= shift
                    P[i, j] = turned
                else:
                    P[j, POSITION_ERROR + i] -= shift
                    P[j, i] = turned
    for i in range(3):
        P[i, i] += (noise[ROTATION_WALK] ** 2 + sample[ROTATION_DOUBT]) * dt
        P[POSITION_ERROR + i, POSITION_ERROR + i] += (noise[TRANSLATION_WALK] ** 2 + sample[TRANSLATION_DOUBT]) * dt
