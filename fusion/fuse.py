"""The stage: camera or object poses and an IMU become a trajectory."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion import filter_loop, memory
from fusion.calibrated import calibrated
from fusion.coarse_offset import with_coarse_offset
from fusion.columns import OUT_CORE, OUT_COVARIANCE, OUT_SIGMA, Columns, Rows
from fusion.eskf import POSITION_ONLY, ROTATION_ONLY
from fusion.first_map import with_first_map
from fusion.health import run_health
from fusion.measurements import ODOMETRY_STEP, Measurements
from fusion.never_started import never_started
from fusion.noise_scale import widening
from fusion.options import FuseOptions
from fusion.place_watch import RELEASED
from fusion.prepare import Problem, fill_memory, pose_problem
from fusion.result import FuseResult, GateLog
from poet_loc.core.input_error import InputError
from poet_loc.core.records import CameraPoses, ObjectPoses
from poet_loc.io.log_folder import Log

Array = NDArray[np.float64]


def fuse(
    log: Log,
    options: FuseOptions | None = None,
    camera_poses: CameraPoses | None = None,
    object_poses: ObjectPoses | None = None,
) -> FuseResult:
    """Fuse a log's camera or object poses with its IMU.

    camera_poses stand in for the log's own camera_poses.csv, object_poses for the only detections of the log. Where the
    time offset is estimated, it begins at what the log's turn rates say if these contradict the calibration. Where the
    map is unknown and the log has none, the world is the anchor's, upright by the IMU (`fusion/first_map.py`).
    Raises InputError where the log lacks what the options need, or where the start's conditions are never met.
    """
    options = options or FuseOptions()
    log, options = with_first_map(log, options, object_poses)
    log = with_coarse_offset(log, options, camera_poses, object_poses)
    problem = pose_problem(log, options, camera_poses, object_poses)
    result = _estimate(problem, options)
    return replace(result, health=run_health(result, options, int(problem.imu.stamps_ns[0])))


def _estimate(problem: Problem, options: FuseOptions) -> FuseResult:
    if options.estimator == "eskf":
        if options.smooth:
            from fusion.smoother import run_smoother  # which is built on this module

            return run_smoother(problem, options)
        return run_filter(problem, options)
    if options.smooth:
        raise InputError(f"smoothing goes with the eskf, not with {options.estimator}", fix="leave --smooth out")
    from fusion.graph import run_graph  # gtsam takes a second to import

    return run_graph(problem, options)


def run_filter(
    problem: Problem, options: FuseOptions, loop: Callable[..., int] = filter_loop.run_log, estimator: str = "eskf"
) -> FuseResult:
    """Run the error-state Kalman filter over a whole log.

    loop: `filter_loop.run_log`, or its plain twin in `fusion/reference_filter.py`.
    """
    began = time.perf_counter()
    floats, integers = fill_memory(problem, options)
    columns, rows = loop_columns(problem)
    written = loop(floats, integers, columns, rows)
    if written == 0:
        raise never_started(problem, options)
    m = memory.views.py_func(floats, integers)
    result = result_from_rows(
        f"fuse/{estimator}/{options.measurements}",
        (
            rows.stamps[:written],
            rows.core[:written],
            rows.sigma[:written],
            rows.covariance[:written].reshape(-1, 6, 6),
        ),
        gate_log(problem, columns.decisions, columns.nis),
        time.perf_counter() - began,
    )
    return with_findings(result, problem, m)


def loop_columns(problem: Problem) -> tuple[Columns, Rows]:
    """Return what a loop over the problem's whole log reads, and room for what it writes."""
    measured, imu = problem.measurements, problem.imu
    count, rows = len(measured), len(imu) + len(measured)
    columns = Columns(
        imu.stamps_ns,
        problem.rows,
        measured.stamps_ns,
        measured.kinds,
        measured.objects,
        measured.rotations,
        measured.translations,
        measured.covariances,
        np.zeros(count, dtype=np.int64),
        np.full((count, 3), np.nan),
    )
    sizes = (OUT_CORE, OUT_SIGMA, OUT_COVARIANCE)
    return columns, Rows(np.zeros(rows, dtype=np.int64), *(np.zeros((rows, size)) for size in sizes))


def with_findings(result: FuseResult, problem: Problem, m: memory.Memory) -> FuseResult:
    """Return a result with what its problem says of it and what its filter's memory holds in the end."""
    return replace(
        result,
        motion=problem.motion,
        body=problem.body,
        restarts=int(m.counters[memory.RESTARTS]),
        calibrated=calibrated(m, problem),
        noise_scale=widening(m),
    )


def result_from_rows(
    name: str,
    rows: tuple[NDArray[np.int64], Array, Array, Array],
    gate: GateLog,
    runtime_s: float,
) -> FuseResult:
    """Turn rows (stamps, nominal core (N, 21), sigmas (N, 15), covariances (N, 6, 6)) into a result."""
    stamps, core, sigma, covariance = rows
    T_world_imu = np.zeros((len(core), 4, 4))
    T_world_imu[:, :3, :3], T_world_imu[:, :3, 3] = core[:, :9].reshape(-1, 3, 3), core[:, 9:12]
    T_world_imu[:, 3, 3] = 1.0
    return FuseResult(
        name=name,
        stamps_ns=stamps,
        T_world_imu=RigidTransform(T_world_imu, normalize=False, copy=False),  # the filter's are rotations
        velocity=core[:, 12:15],
        gyroscope_bias=core[:, 15:18],
        accelerometer_bias=core[:, 18:21],
        sigmas=sigma,
        pose_covariances=covariance,
        gate=gate,
        runtime_s=runtime_s,
    )


def gate_log(problem: Problem, decisions: NDArray[np.int64], nis: Array) -> GateLog:
    """Say of every pose that was measured what was used; nis (M, 3) is [both, rotation, position]."""
    measured: Measurements = problem.measurements
    poses = measured.kinds != ODOMETRY_STEP
    decisions, nis = decisions[poses], nis[poses]
    keys = np.array([*problem.keys, (-1, 0)], dtype=np.int64)[measured.objects[poses]]
    return GateLog(
        measured.stamps_ns[poses],
        keys[:, 0],
        keys[:, 1],
        nis[:, 0],
        nis[:, 2],
        nis[:, 1],
        (decisions & POSITION_ONLY) > 0,
        (decisions & ROTATION_ONLY) > 0,
        (decisions & RELEASED) > 0,
    )
