"""Compile every kernel of the estimators once, so that the first run does not wait for it."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from fusion.compiled import kernels_from_scratch
from fusion.fuse import fuse
from fusion.online import Estimator
from fusion.options import FuseOptions
from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import Log, read_log, write_log

SHORT = SimulationOptions(
    duration_s=3.0, imu_rate_hz=50.0, camera_rate_hz=15.0, objects=3, symmetric_objects=1, camera_poses=True
)


def compile_estimators() -> tuple[int, float]:
    """Fuse a short simulated log in every way; return how many kernels were compiled and the seconds all of it took.

    numba keeps them on disk, so that from then on every process loads them: a second call compiles none.
    """
    began, before = time.perf_counter(), kernels_from_scratch()
    with tempfile.TemporaryDirectory() as folder:  # a log read from files is what a user fuses
        write_log(Path(folder), replace(simulate(SHORT), path=Path(folder)))
        log = read_log(Path(folder))
        objects, camera = FuseOptions(), FuseOptions(measurements="camera")
        for options in (objects, camera, replace(objects, smooth=True)):
            fuse(log, options)
        for estimator in ("graph", "batch"):
            fuse(log, replace(objects, estimator=estimator))
            fuse(log, replace(camera, estimator=estimator))
        _feed(log)
    return kernels_from_scratch() - before, time.perf_counter() - began


def _feed(log: Log) -> None:
    """Feed the first samples to an online estimator; its kernels are compiled for whatever comes."""
    assert log.imu is not None
    assert log.calibration is not None
    estimator = Estimator(log.calibration, log.landmark_map)
    for k in range(2):
        estimator.feed_imu(int(log.imu.stamps_ns[k]), log.imu.angular_velocity[k], log.imu.specific_force[k])
