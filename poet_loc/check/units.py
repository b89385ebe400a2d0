"""Checks of units: the accelerometer and the gyroscope at rest, millimetres in poses, map against detections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from poet_loc.check.finding import Evidence, Finding
from poet_loc.check.streams import trajectories_of
from poet_loc.check.turns import gyroscope_beside_poses
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log, object_poses_file

Array = NDArray[np.float64]

GRAVITY = 9.81
_WINDOW_S = 0.5
_QUIET = 0.05  # scatter of a quiet window's acceleration, as a share of its mean
_NORM_TOLERANCE = 0.6
_SAME = 0.03  # how far readings at rest lie apart, as a share
_LARGEST_BIAS = 0.2
_FASTEST_TURN = 10.0
_MOMENTS = 4  # at least so many quiet windows
_FASTEST_MOTION = 50.0
_SCALE_SCATTER = 0.5
_UNITS = {"g": GRAVITY, "milli-g": GRAVITY / 1e3, "cm/s^2": 0.01, "mm/s^2": 0.001, "ft/s^2": 0.3048}


def check_accelerometer(log: Log) -> Iterator[Finding]:
    """Yield a specific force at rest that is not g, and axes that never move."""
    windows = _windows(log)
    if log.imu is None or windows is None:
        return
    force = log.imu.specific_force
    for axis in np.flatnonzero(np.ptp(force, axis=0) == 0.0):
        name, value = "xyz"[axis], float(force[0, axis])
        what = f"the accelerometer's {name} axis never changes"
        evidence: Evidence = {"axis": name, "value_m_s2": value, "samples": len(force)}
        yield Finding("dead-axis", "error", "imu.csv", what, "look at the driver: the axis is not connected", evidence)
    _, means, scatter, _ = windows
    norm = np.linalg.norm(means, axis=1)
    quiet = _quietest(scatter / np.maximum(norm, 1e-9))
    rest, axes = float(np.median(norm[quiet])), np.median(means[quiet], axis=0)
    evidence = {"norm_at_rest_m_s2": rest, "expected_m_s2": GRAVITY, "quiet_windows": len(quiet)}
    evidence |= {f"{name}_at_rest_m_s2": float(value) for name, value in zip("xyz", axes, strict=True)}
    if abs(rest - GRAVITY) < _NORM_TOLERANCE:
        return
    unit = next((name for name, factor in _UNITS.items() if abs(rest * factor - GRAVITY) < 0.1 * GRAVITY), None)
    if unit:
        what, fix = f"the accelerometer is in {unit}, it seems", f"multiply by {_UNITS[unit]:g}: m/s^2 belong here"
        yield Finding("accelerometer-unit", "error", "imu.csv", what, fix, evidence, _scaled_imu(1.0, _UNITS[unit]))
    elif rest < 0.15 * GRAVITY:
        what = "the accelerometer reads almost nothing at rest: gravity was taken out"
        fix = "record the raw specific force (sensor_msgs/Imu, not a linear acceleration)"
        yield Finding("no-gravity", "error", "imu.csv", what, fix, evidence)
    elif len(quiet) > 2 and np.std(norm[quiet]) < _SAME * rest:  # at rest it reads the same each time; else it flew
        what = "the accelerometer at rest does not read g: a unit, a range setting or an axis is wrong"
        fix = "compare each axis with g while it points up and down; one axis may be missing, doubled or mis-scaled"
        yield Finding("accelerometer-norm", "error", "imu.csv", what, fix, evidence)


def check_gyroscope(log: Log) -> Iterator[Finding]:
    """Yield a gyroscope in degrees or with a large bias.

    Degrees are an error where poses turn with it, 57 times slower, and a warning where only its reading at rest or its
    fastest turn hints at them. What it reads in quiet moments is no bias where the poses turn as much in the mean.
    """
    windows = _windows(log)
    if log.imu is None or windows is None:
        return
    fast = float(np.percentile(np.linalg.norm(log.imu.angular_velocity, axis=1), 95))
    turning = gyroscope_beside_poses(log) if fast > _LARGEST_BIAS else None
    if turning is not None and turning.in_degrees:
        yield turning.as_degrees()
        return
    rates, means, scatter, wobble = windows
    quiet = np.flatnonzero(scatter / np.maximum(np.linalg.norm(means, axis=1), 1e-9) < _QUIET)
    if not quiet.size:
        return
    still = quiet[np.argsort(wobble[quiet])[: max(_MOMENTS, len(quiet) // 10)]]
    bias = np.median(rates[still], axis=0)
    at_rest = float(np.linalg.norm(bias))
    if np.linalg.norm(rates[still].std(axis=0)) > 0.5 * at_rest and fast < _FASTEST_TURN:
        return  # at rest it would read the same each time: this one moved
    beside_poses = at_rest if turning is None else float(np.linalg.norm(turning.bias))
    if min(at_rest, beside_poses) < _LARGEST_BIAS and (fast < _FASTEST_TURN or turning is not None):
        return
    evidence: Evidence = {"norm_at_rest_rad_s": at_rest, "as_degrees_deg_s": at_rest, "p95_rad_s": fast}
    evidence |= {f"{name}_at_rest_rad_s": float(value) for name, value in zip("xyz", bias, strict=True)}
    what = f"the gyroscope reads {at_rest:.2g} rad/s in its quietest moments"
    hinted = fast > _FASTEST_TURN or fast > 5.0 * at_rest or at_rest > 1.0 or wobble[still].min() > 0.02
    if hinted and turning is None:
        fix = "multiply by pi/180: rad/s belong here"
        repair = _scaled_imu(np.pi / 180.0, 1.0)
        yield Finding("gyroscope-degrees", "warning", "imu.csv", f"{what}: degrees, it seems", fix, evidence, repair)
    else:
        fix = "calibrate the gyroscope at rest, fuse with --prior.gyroscope-bias 0.25, or see whether it is in degrees"
        yield Finding("gyroscope-bias", "error", "imu.csv", f"{what}: a large bias", fix, evidence)


def check_lengths(log: Log) -> Iterator[Finding]:
    """Yield positions in millimetres: detections against the map, and trajectories that move too fast."""
    for file, trajectory in trajectories_of(log).items():
        yield from _too_fast(file, trajectory)
    if log.camera_poses is not None and len(log.camera_poses) > 1:
        poses = log.camera_poses
        yield from _too_fast("camera_poses.csv", Trajectory(poses.stamps_ns, poses.T_world_cam))
    if log.landmark_map is None:
        return
    ratios = {name: ratio for name, p in log.object_poses.items() if (ratio := _scale(p, log.landmark_map))}
    wrong = {name: ratio for name, ratio in ratios.items() if not 0.55 < ratio < 1.8}
    in_map = len(wrong) == len(ratios)
    for name, ratio in wrong.items():
        file = "landmarks.json" if in_map else object_poses_file(name)
        factor = ratio if in_map else 1.0 / ratio
        evidence: Evidence = {"detected_over_mapped_distances": ratio, "detections": object_poses_file(name)}
        if abs(factor * 1e3 - 1.0) < 0.3:
            what, fix = "positions are millimetres, it seems", "divide them by 1000: metres belong here"
            repair = _map_in_metres if in_map else _detections_in_metres(name)
            yield Finding("millimetres", "error", file, what, fix, evidence, repair)
        else:
            what = "distances between objects in the map are not those between the detections"
            fix = "measure one distance: the map or the detector's models have another scale"
            yield Finding("scale", "error", file, what, fix, evidence)
        if in_map:
            return


def _too_fast(file: str, trajectory: Trajectory) -> Iterator[Finding]:
    if len(trajectory) < 2:
        return
    steps = np.linalg.norm(np.diff(trajectory.T_world_body.translation, axis=0), axis=1)
    speed = float(np.median(steps / (np.diff(trajectory.stamps_ns) / 1e9)))
    if speed > _FASTEST_MOTION:
        what, fix = "positions are millimetres, it seems", "divide them by 1000: metres belong here"
        evidence: Evidence = {"median_speed_m_s": speed}
        yield Finding("millimetres", "error", file, what, fix, evidence, _trajectory_in_metres(file))


def _scale(poses: ObjectPoses, landmark_map: LandmarkMap) -> float | None:
    """Return the median ratio of distances between two objects of one frame to those of the map.

    None without such pairs, and where the ratios scatter: those are wrong detections, not a wrong unit.
    """
    places = {landmark.key: landmark.T_world_obj.translation for landmark in landmark_map}
    keys = list(zip(poses.object_ids.tolist(), poses.instances.tolist(), strict=True))
    rows = np.flatnonzero([key in places for key in keys])
    ratios = []
    for step in (1, 2, 3):  # neighbours in a file that is sorted by stamp
        one, two = rows[:-step], rows[step:]
        pairs = poses.stamps_ns[one] == poses.stamps_ns[two]
        one, two = one[pairs], two[pairs]
        if not one.size:
            continue
        t = poses.T_cam_obj.translation
        in_map = np.array([np.linalg.norm(places[keys[i]] - places[keys[j]]) for i, j in zip(one, two, strict=True)])
        apart = in_map > 1e-6
        ratios.append(np.linalg.norm(t[one] - t[two], axis=1)[apart] / in_map[apart])
    every = np.concatenate(ratios) if ratios else np.empty(0)
    if len(every) < 5:
        return None
    low, median, high = np.percentile(every, [25, 50, 75])
    return float(median) if high - low < _SCALE_SCATTER * median else None


def _windows(log: Log) -> tuple[Array, Array, Array, Array] | None:
    """Return mean gyroscope and accelerometer, and the scatter of the latter and of the former, of half seconds."""
    if log.imu is None or len(log.imu) < 20:
        return None
    size = max(5, round(_WINDOW_S * 1e9 / float(np.median(np.diff(log.imu.stamps_ns)))))
    count = len(log.imu) // size
    if count == 0:
        return None
    rates, force = (
        each[: count * size].reshape(count, size, 3) for each in (log.imu.angular_velocity, log.imu.specific_force)
    )
    scatter, wobble = (np.linalg.norm(each.std(axis=1), axis=1) for each in (force, rates))
    return rates.mean(axis=1), force.mean(axis=1), scatter, wobble


def _quietest(relative_scatter: Array) -> NDArray[np.intp]:
    order = np.argsort(relative_scatter)
    quiet = int(np.count_nonzero(relative_scatter < _QUIET))
    return order[: max(1, quiet if quiet < 4 else len(order) // 10, min(quiet, 4))]


def _scaled_imu(gyroscope: float, accelerometer: float):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        assert log.imu is not None
        rates, force = log.imu.angular_velocity * gyroscope, log.imu.specific_force * accelerometer
        return replace(log, imu=replace(log.imu, angular_velocity=rates, specific_force=force))

    return repair


def _map_in_metres(log: Log) -> Log:
    assert log.landmark_map is not None
    landmarks = (
        replace(each, T_world_obj=make_pose(each.T_world_obj.rotation, each.T_world_obj.translation / 1e3))
        for each in log.landmark_map
    )
    return replace(log, landmark_map=LandmarkMap(tuple(landmarks)))


def _detections_in_metres(name: str):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        poses = log.object_poses[name]
        metres = replace(poses, T_cam_obj=make_pose(poses.T_cam_obj.rotation, poses.T_cam_obj.translation / 1e3))
        return replace(log, object_poses={**log.object_poses, name: metres})

    return repair


def _trajectory_in_metres(file: str):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        field = file.split(".")[0]
        record = getattr(log, field)
        if field == "camera_poses":
            T = record.T_world_cam
            return replace(log, camera_poses=replace(record, T_world_cam=make_pose(T.rotation, T.translation / 1e3)))
        T = record.T_world_body
        metres = Trajectory(record.stamps_ns, make_pose(T.rotation, T.translation / 1e3))
        fields: dict[str, Any] = {field: metres}
        return replace(log, **fields)

    return repair
