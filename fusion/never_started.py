"""What to say where the conditions of a start were never met."""

from __future__ import annotations

import math

import numpy as np

from fusion.measurements import CAMERA_POSE, ODOMETRY_STEP
from fusion.options import FuseOptions, Start
from fusion.prepare import Problem
from poet_loc.core.input_error import InputError

_SPEED_OVER_NS = 500_000_000


def never_started(problem: Problem, options: FuseOptions) -> InputError:
    """Return the error of a filter whose start's conditions were never met."""
    begin, poses = options.start, problem.measurements.stamps_ns[problem.measurements.kinds != ODOMETRY_STEP]
    file = "T_odom_cam.tum" if problem.motion == "odometry" else "imu.csv"
    span = problem.imu.stamps_ns if len(problem.imu) else poses[:0]
    inside = np.count_nonzero((poses >= span[0]) & (poses <= span[-1])) if len(span) else 0
    also = {"odometry": " and with the odometry", "constant-velocity": ""}.get(problem.motion, " and with gravity")
    neither = f"no {begin.min_votes} poses, nor {begin.few_votes} over {begin.few_span_s} s,"
    few = min(begin.few_votes, begin.min_votes)
    if inside < few <= len(poses):
        return InputError(
            f"the filter never started: {inside} of {len(poses)} poses lie between its first and last stamp",
            path=problem.path / file,
            fix="put both on one clock (poet-loc check tells what they cover), or choose another --motion",
        )
    return InputError(
        f"the filter never started: {neither} agree with each other{also}",
        path=problem.path,
        fix=_fix(problem, options),
    )


def _fix(problem: Problem, options: FuseOptions) -> str:
    if options.estimate.map == "unknown":
        return "of an unknown map the anchor's rotation counts: where it is not known, leave landmarks.json out"
    hindrance = _hindrance(problem, options.start) if options.measurements == "camera" else ""
    return hindrance or "see what poet-loc check says of the log, relax --start, or give --start.pose"


def _hindrance(problem: Problem, start: Start) -> str:
    """Tell camera poses that are rougher, or move faster, than the options let votes of one start differ."""
    measured = problem.measurements
    rows = np.flatnonzero(measured.kinds == CAMERA_POSE)
    variances = np.diagonal(measured.covariances[rows], axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=2)
    angle, distance = 2.0 * np.sqrt(np.median(variances, axis=0))
    rough = distance > start.max_distance or angle > math.radians(start.max_angle_deg)
    if rough and problem.lasting_s == 0.0:
        wanted = f"--start.max-distance {max(distance, start.max_distance):.2f}"
        wanted += f" --start.max-angle-deg {max(math.degrees(angle), start.max_angle_deg):.0f}"
        return f"their own 1-sigma lets them differ by more than the start does: {wanted}"
    later = np.searchsorted(measured.stamps_ns[rows], measured.stamps_ns[rows] + _SPEED_OVER_NS)
    first, second = rows[later < len(rows)], rows[later[later < len(rows)]]
    seconds = (measured.stamps_ns[second] - measured.stamps_ns[first]) * 1e-9
    speeds = np.linalg.norm(measured.translations[second] - measured.translations[first], axis=1) / seconds
    speed = float(np.median(speeds)) if len(speeds) else 0.0
    too_fast = speed > start.max_camera_speed
    return f"they move at {speed:.1f} m/s: --start.max-camera-speed {speed:.1f}" if too_fast else ""
