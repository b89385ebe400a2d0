"""The stage: camera or object poses and an IMU become a trajectory."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion import filter_loop, memory
from fusion.eskf import POSITION_ONLY, ROTATION_ONLY
from fusion.measurements import Measurements
from fusion.options import FuseOptions
from fusion.prepare import Problem, fill_memory, pose_problem
from fusion.result import FuseResult, GateLog
from poet_loc.core.geometry import make_pose
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

    camera_poses stand in for the log's own camera_poses.csv, object_poses for the only detections of the log.
    Raises InputError where the log lacks what the options need, or where the start's conditions are never met.
    """
    options = options or FuseOptions()
    problem = pose_problem(log, options, camera_poses, object_poses)
    if options.estimator == "eskf":
        return run_filter(problem, options)
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
    measured, imu = problem.measurements, problem.imu
    count, rows = len(measured), len(imu) + len(measured)
    decisions, nis = np.zeros(count, dtype=np.int64), np.full((count, 3), np.nan)
    stamps, core = np.zeros(rows, dtype=np.int64), np.zeros((rows, filter_loop.OUT_CORE))
    sigma, covariance = np.zeros((rows, filter_loop.OUT_SIGMA)), np.zeros((rows, filter_loop.OUT_COVARIANCE))
    columns = (measured.kinds, measured.objects, measured.rotations, measured.translations, measured.covariances)
    written = loop(
        floats,
        integers,
        imu.stamps_ns,
        np.hstack([imu.angular_velocity, imu.specific_force]),
        measured.stamps_ns,
        *columns,
        decisions,
        nis,
        stamps,
        core,
        sigma,
        covariance,
    )
    if written == 0:
        raise InputError(
            f"the filter never started: no {options.start.min_votes} poses within "
            f"{options.start.window_s} s agree with each other and with gravity",
            path=problem.path,
            fix="check the map and the extrinsics, or relax --start",
        )
    counters = memory.views.py_func(floats, integers).counters
    result = result_from_rows(
        f"fuse/{estimator}/{options.measurements}",
        (stamps[:written], core[:written], sigma[:written], covariance[:written].reshape(-1, 6, 6)),
        gate_log(problem, decisions, nis),
        time.perf_counter() - began,
        int(counters[memory.RESTARTS]),
    )
    return replace(result, motion=problem.motion, body=problem.body)


def result_from_rows(
    name: str,
    rows: tuple[NDArray[np.int64], Array, Array, Array],
    gate: GateLog,
    runtime_s: float,
    restarts: int = 0,
) -> FuseResult:
    """Turn rows (stamps, nominal core (N, 21), sigmas (N, 15), covariances (N, 6, 6)) into a result."""
    stamps, core, sigma, covariance = rows
    rotation = Rotation.from_matrix(core[:, :9].reshape(-1, 3, 3))
    return FuseResult(
        name=name,
        stamps_ns=stamps,
        T_world_imu=make_pose(rotation, core[:, 9:12]),
        velocity=core[:, 12:15],
        gyroscope_bias=core[:, 15:18],
        accelerometer_bias=core[:, 18:21],
        sigmas=sigma,
        pose_covariances=covariance,
        gate=gate,
        runtime_s=runtime_s,
        restarts=restarts,
    )


def gate_log(problem: Problem, decisions: NDArray[np.int64], nis: Array) -> GateLog:
    """Say of every measurement what was used; nis (M, 3) is [both, rotation, position]."""
    measured: Measurements = problem.measurements
    keys = np.array([*problem.keys, (-1, 0)], dtype=np.int64)[measured.objects]
    return GateLog(
        measured.stamps_ns,
        keys[:, 0],
        keys[:, 1],
        nis[:, 0],
        nis[:, 2],
        nis[:, 1],
        (decisions & POSITION_ONLY) > 0,
        (decisions & ROTATION_ONLY) > 0,
    )
