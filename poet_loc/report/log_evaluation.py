"""Estimates of a log against the log's own ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log
from poet_loc.report.evaluate import (
    Body,
    Estimate,
    EvaluateOptions,
    Evaluation,
    evaluate,
    frames_to_compare,
    references_for_both_bodies,
    stamps_in_gaps,
    too_sparse,
)
from poet_loc.report.fused import Fused

AnyFused = TypeVar("AnyFused", bound=Fused)


def references_of(log: Log) -> dict[Body, Trajectory]:
    """Return the ground truth of camera and IMU that a log has, the missing one by way of T_cam_imu.

    Both are on the camera's clock.
    """
    there: dict[Body, Trajectory] = {}
    if log.T_world_cam is not None:
        there["cam"] = log.T_world_cam
    if log.T_world_imu is not None:
        there["imu"] = log.T_world_imu.later(-log.timeshift_ns)
    return references_for_both_bodies(there, None if log.calibration is None else log.calibration.T_cam_imu)


def on_camera_clock(log: Log, fused: AnyFused) -> AnyFused:
    """Return what was fused of a log, which is on the IMU's clock, with the camera's stamps.

    The time offset that was found of it counts where the IMU's ground truth is made of the camera's.
    """
    found_s = None if fused.calibrated is None else fused.calibrated.timeshift_cam_imu_s
    if found_s is None or log.T_world_imu is not None:
        return fused.later(-log.timeshift_ns)
    return fused.later(-round(found_s * 1e9))


def evaluate_log(
    log: Log, detections: str | None, estimates: Sequence[Estimate], options: EvaluateOptions
) -> Evaluation | None:
    """Return the errors of those estimates whose body the log has ground truth for; None where it has for none.

    detections names the set whose stamps are the sensor's; None: the log's camera poses. All estimates are on the
    camera's clock.
    """
    references = references_of(log)
    known = [estimate for estimate in estimates if estimate.body in references]
    if not known:
        return None
    source = log.camera_poses if detections is None else log.object_poses[detections]
    assert source is not None
    sensor_ns = np.asarray(source.stamps_ns)
    truth_ns = references["cam" if "cam" in references else "imu"].stamps_ns
    if log.frames is None:
        frames_ns, frames_of = frames_to_compare(truth_ns, sensor_ns, options), _file_of(detections)
    else:
        frames_ns, frames_of = log.frames.stamps_ns, "frames.csv"
        frames_ns = truth_ns if too_sparse(truth_ns, frames_ns, options) else frames_ns
    truth_file = "T_world_imu.tum" if log.T_world_cam is None else "T_world_cam.tum"
    if frames_ns is truth_ns:
        frames_of = truth_file
    elif log.frames is None and len(missed_ns := stamps_in_gaps(truth_ns, sensor_ns)):
        frames_ns, frames_of = np.union1d(frames_ns, missed_ns), f"{frames_of} and, in its long gaps, {truth_file}"
    span_ns = (int(sensor_ns.min()), int(sensor_ns.max()))
    return evaluate(known, references, span_ns, options, frames_ns, frames_of)


def _file_of(detections: str | None) -> str:
    if detections is None:
        return "camera_poses.csv"
    return f"object_poses_{detections}.csv" if detections else "object_poses.csv"
