"""The camera's time offset as the log itself tells it, before anything is fused: turn rates against the gyroscope."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from fusion.options import FuseOptions
from fusion.prepare import WITH_IMU, Problem
from poet_loc.core.records import Calibration, CameraPoses, ObjectPoses
from poet_loc.core.turn_match import Match, match_turns
from poet_loc.core.turn_rates import PoseStream, turn_rates
from poet_loc.io.log_folder import Log


def coarse_offset(
    log: Log, camera_poses: CameraPoses | None = None, object_poses: ObjectPoses | None = None
) -> Match | None:
    """Return how the poses of a log turn with its gyroscope where their time offset stands out, else None.

    Those of the detections, else of the camera poses, else of the odometry, which keeps the camera's time, too. The
    offset is that of `timeshift_cam_imu`: t_imu = t_cam + offset.
    """
    if log.imu is None or len(log.imu) < 2:
        return None
    for stream in _streams(log, camera_poses, object_poses):
        match = match_turns(log.imu, turn_rates(stream))
        if match is not None and match.offset.distinct:
            return match
    return None


def _streams(log: Log, camera_poses: CameraPoses | None, object_poses: ObjectPoses | None) -> Iterator[PoseStream]:
    if object_poses is not None:
        yield PoseStream.of_detections(object_poses)
    camera_poses = log.camera_poses if camera_poses is None else camera_poses
    if camera_poses is not None:
        yield PoseStream.of_camera_poses(camera_poses)
    if log.T_odom_cam is not None:
        yield PoseStream.of_trajectory(log.T_odom_cam)


def with_coarse_offset(
    log: Log, options: FuseOptions, camera_poses: CameraPoses | None, object_poses: ObjectPoses | None
) -> Log:
    """Return the log with that time offset in its calibration where it is to be estimated and theirs contradicts it.

    A filter cannot bridge tenths of a second: with a motion that is smooth it explains them by other states.
    """
    if not options.estimate.time_offset or options.motion not in ("auto", *WITH_IMU):
        return log
    if options.measurements == "objects" and object_poses is None:
        object_poses = log.detections(None)[1]
    match, calibration = coarse_offset(log, camera_poses, object_poses), log.calibration or Calibration()
    if match is None or not match.contradicts(calibration.timeshift_cam_imu_s):
        return log
    return replace(log, calibration=replace(calibration, timeshift_cam_imu_s=match.offset.offset_s))


def retimed(problem: Problem, timeshift_cam_imu_s: float) -> Problem:
    """Return the problem with another time offset in its calibration."""
    calibration = replace(problem.calibration, timeshift_cam_imu_s=timeshift_cam_imu_s)
    later = calibration.timeshift_ns - problem.calibration.timeshift_ns
    measured = replace(problem.measurements, stamps_ns=problem.measurements.stamps_ns + later)
    return replace(problem, calibration=calibration, measurements=measured)
