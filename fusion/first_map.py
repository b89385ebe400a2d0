"""A map to begin with where none is given: every object at the origin, upright as gravity says.

Of an unknown map only the pose of the object that anchors the world is used (`fusion/meeting.py`), so the world is that
object's frame, turned so that z is up: the mean specific force, seen from an object that rests, points up, as
accelerations of the camera average out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.options import FuseOptions
from fusion.prepare import NEAREST_OBJECT
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Calibration, ImuSamples, Landmark, LandmarkMap, ObjectPoses
from poet_loc.io.log_folder import Log

Array = NDArray[np.float64]

UPRIGHT_DEG = 5.0  # 1-sigma: a network turns an object wrong by some degrees for a whole log


def lacks_map(log: Log, options: FuseOptions, object_poses: ObjectPoses | None = None) -> bool:
    """Tell whether the options ask for an unknown map of a log that has none at all; object_poses stand in for its."""
    seen = object_poses is not None or bool(log.object_poses)
    return options.estimate.map == "unknown" and log.landmark_map is None and seen


def with_first_map(log: Log, options: FuseOptions, object_poses: ObjectPoses | None) -> tuple[Log, FuseOptions]:
    """Return log and options, where the map is unknown and none is given with a first map of what is detected.

    As that is upright to some degrees only, the direction of gravity is then estimated too, if there is an IMU.
    """
    if not lacks_map(log, options, object_poses) or options.measurements != "objects":
        return log, options
    poses = object_poses if object_poses is not None else log.detections(None)[1]
    calibration = log.calibration or Calibration()
    log = replace(log, landmark_map=first_map(poses, log.imu, calibration))
    if log.imu is None or options.motion not in ("auto", "imu", "imu+odometry"):
        return log, options
    prior = replace(options.prior, gravity_deg=max(options.prior.gravity_deg, UPRIGHT_DEG))
    return log, replace(options, estimate=replace(options.estimate, gravity=True), prior=prior)


def first_map(poses: ObjectPoses, imu: ImuSamples | None, calibration: Calibration) -> LandmarkMap:
    """Return a landmark for every object of the detections, at the origin; upright, where an IMU tells."""
    ids = np.stack([poses.object_ids, poses.instances], axis=1)
    landmarks = []
    for key in np.unique(ids, axis=0):
        seen = poses[(ids == key).all(axis=1) & (poses.T_cam_obj.translation[:, 2] > NEAREST_OBJECT)]
        T_world_obj = make_pose(_upright(seen, imu, calibration), np.zeros(3))
        landmarks.append(Landmark(int(key[0]), T_world_obj, instance=int(key[1])))
    return LandmarkMap(tuple(landmarks))


def _upright(seen: ObjectPoses, imu: ImuSamples | None, calibration: Calibration) -> Rotation:
    """Return the smallest turn of the object after which the specific force points along z."""
    if imu is None or calibration.T_cam_imu is None:
        return Rotation.identity()
    stamps = seen.stamps_ns + calibration.timeshift_ns
    inside = (stamps >= imu.stamps_ns[0]) & (stamps <= imu.stamps_ns[-1])
    if not inside.any():
        return Rotation.identity()
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
    at = (stamps[inside] - imu.stamps_ns[0]) * 1e-9
    force = np.stack([np.interp(at, seconds, axis) for axis in imu.specific_force.T], axis=1)
    R_obj_imu = seen[inside].T_cam_obj.rotation.inv() * calibration.T_cam_imu.rotation
    up = np.median(R_obj_imu.apply(force), axis=0)
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], up[None])[0] if np.any(up) else Rotation.identity()
