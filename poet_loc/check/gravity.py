"""Checks of gravity: the specific force in the world's axes is (0, 0, +9.81) on average."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from landmarks.camera_pose import solve
from landmarks.options import SolverOptions
from poet_loc.check.finding import Evidence, Finding
from poet_loc.check.units import GRAVITY
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import CameraPoses, ImuSamples, LandmarkMap
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log, object_poses_file

Array = NDArray[np.float64]

_TILT_DEG, _TILT_OF_ONE_DEG = 25.0, 60.0
_MOST_FRAMES = 400
_DYNAMICS_S = 0.6
_ANSWER = 0.3
_OPEN_RAD = 1.0  # 1-sigma from which an attitude is not known


def check_gravity(log: Log) -> Iterator[Finding]:
    """Yield gravity that points elsewhere than down in the world of the poses."""
    if log.imu is None:
        return
    bodies = dict(_imu_attitudes(log))
    means = {file: mean for file, body in bodies.items() if (mean := _mean_force(log.imu, body)) is not None}
    if not any(0.7 < np.linalg.norm(mean) / GRAVITY < 1.4 for mean in means.values()):
        return  # what is no g has no direction; the check of units has told it
    tilts = {file: _tilt(mean) for file, mean in means.items()}
    limit = _TILT_DEG if all(tilt > _TILT_DEG for tilt in tilts.values()) else _TILT_OF_ONE_DEG
    wrong = {file: tilt for file, tilt in tilts.items() if tilt > limit}
    if not wrong:
        return
    file = next(iter(wrong))
    mean = means[file]
    evidence: Evidence = {f"mean_force_{axis}_m_s2": float(value) for axis, value in zip("xyz", mean, strict=True)}
    evidence |= {"tilt_deg": wrong[file], "seen_from": file, "files_that_agree": f"{len(wrong)} of {len(tilts)}"}
    if len(wrong) < len(tilts):
        what = f"gravity lies {wrong[file]:.0f} deg from where it is in the other files"
        fix = "its world is another one, or its rotations are read in the wrong order or direction"
        yield Finding("gravity-tilted", "error", file, what, fix, evidence)
    elif wrong[file] > 180.0 - _TILT_DEG:
        yield _upside_down(log, bodies[file], evidence)
    else:
        axis = np.argmax(np.abs(mean))
        up = f"{'+' if mean[axis] > 0 else '-'}{'xyz'[axis]}"
        what = f"the specific force points along {up} of the world, {wrong[file]:.0f} deg from +z"
        fix = f"the world needs z up: turn map and trajectories (its up is nearest {up}), or correct T_cam_imu"
        yield Finding("gravity-tilted", "error", _world_file(log), what, fix, evidence)


def _upside_down(log: Log, body: Trajectory, evidence: Evidence) -> Finding:
    """Tell an accelerometer that measures gravity from a world that is upside down, by its answer to motion."""
    assert log.imu is not None
    answer = _answer_to_motion(log.imu, body)
    evidence = evidence | {"acceleration_per_force": answer}
    if answer < -_ANSWER:
        what = "the accelerometer has the wrong sign: it reads -g on the axis that points up"
        fix = "turn the sign of all three axes: an IMU at rest, level, reads +9.81 on z"
        return Finding("accelerometer-sign", "error", "imu.csv", what, fix, evidence, _negated_accelerometer)
    if answer > _ANSWER:
        what = "the world is upside down: gravity points along +z of the poses"
        fix = "turn the world by 180 deg about x (NED to a world with z up)"
        return Finding("world-upside-down", "error", _world_file(log), what, fix, evidence, turned_world)
    what = "gravity points along +z: the accelerometer has the wrong sign or the world is upside down"
    fix = "an IMU at rest, level, reads +9.81 on z; the log moves too little to tell which of the two it is"
    return Finding("gravity-reversed", "error", "imu.csv", what, fix, evidence)


def _imu_attitudes(log: Log) -> Iterator[tuple[str, Trajectory]]:
    """Yield, by file, T_world_imu on the IMU's clock from each file that has an attitude in the world."""
    if log.T_world_imu is not None:
        yield "T_world_imu.tum", log.T_world_imu
    if log.calibration is None or log.calibration.T_cam_imu is None:
        return
    T_cam_imu, shift = log.calibration.T_cam_imu, log.calibration.timeshift_ns
    if log.T_world_cam is not None:
        yield "T_world_cam.tum", Trajectory(log.T_world_cam.stamps_ns + shift, log.T_world_cam.T_world_body * T_cam_imu)
    if log.camera_poses is not None:
        poses = log.camera_poses
        yield "camera_poses.csv", Trajectory(poses.stamps_ns + shift, poses.T_world_cam * T_cam_imu)
    for name, T_world_cam in solved(log).items():
        yield object_poses_file(name), Trajectory(T_world_cam.stamps_ns + shift, T_world_cam.T_world_body * T_cam_imu)


def solved(log: Log) -> dict[str, Trajectory]:
    """Return a camera trajectory from each set of detections, some hundred frames of it.

    Frames whose attitude the detections leave open, as one symmetric object does, are left out.
    """
    if log.landmark_map is None:
        return {}
    trajectories = {}
    for name, poses in log.object_poses.items():
        stamps = np.unique(poses.stamps_ns)
        kept = stamps[:: max(1, -(-len(stamps) // _MOST_FRAMES))]
        camera = solve(poses[np.isin(poses.stamps_ns, kept)], log.landmark_map, SolverOptions(mode="out")).camera_poses
        assert camera.covariances is not None
        camera = camera[np.linalg.eigvalsh(camera.covariances[:, :3, :3])[:, -1] < _OPEN_RAD**2]
        if len(camera) > 5:
            trajectories[name] = Trajectory(camera.stamps_ns, camera.T_world_cam)
    return trajectories


def _mean_force(imu: ImuSamples, body: Trajectory) -> Array | None:
    inside = (body.stamps_ns >= imu.stamps_ns[0]) & (body.stamps_ns <= imu.stamps_ns[-1])
    if inside.sum() < 5:
        return None
    force = _force_at(imu, body.stamps_ns[inside])
    return np.asarray(np.median(body.T_world_body[inside].rotation.apply(force), axis=0))


def _force_at(imu: ImuSamples, stamps_ns: NDArray[np.int64], width_s: float = 0.05) -> Array:
    """Return the mean specific force about each stamp, (N, 3)."""
    size = min(len(imu), max(1, round(width_s * 1e9 / float(np.median(np.diff(imu.stamps_ns))))))
    total = np.vstack([np.zeros(3), np.cumsum(imu.specific_force, axis=0)])
    first = np.clip(np.searchsorted(imu.stamps_ns, stamps_ns) - size // 2, 0, len(imu) - size)
    return np.asarray((total[first + size] - total[first]) / size)


def _tilt(mean: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(mean[2] / max(float(np.linalg.norm(mean)), 1e-9), -1.0, 1.0))))


def _answer_to_motion(imu: ImuSamples, body: Trajectory) -> float:
    """Return how much of the force in the world the second derivative of the position shows: about +1 or -1.

    A bias, which turns with the body, and gravity are fitted beside it; 0 where the log is too short.
    """
    step = max(float(np.median(np.diff(body.stamps_ns))), 1e7)
    window = max(5, 2 * round(_DYNAMICS_S * 1e9 / step / 2) + 1)
    stamps = np.arange(body.stamps_ns[0], body.stamps_ns[-1], int(step))
    stamps = stamps[(stamps >= imu.stamps_ns[0]) & (stamps <= imu.stamps_ns[-1])]
    if len(stamps) < 3 * window:
        return 0.0
    poses, valid = body.interpolate(stamps, int(4 * step))
    force = poses.rotation.apply(_force_at(imu, stamps, step / 1e9))
    kernel, smooth = _matched_kernels(window, step / 1e9)
    acceleration = np.column_stack([np.correlate(column, kernel, "valid") for column in poses.translation.T])
    turned_bias = poses.rotation.as_matrix().reshape(-1, 9)
    force, turned_bias = (
        np.column_stack([np.convolve(column, smooth, "valid") for column in each.T]) for each in (force, turned_bias)
    )
    valid = valid[window // 2 : len(valid) - window // 2]
    return _regressed(acceleration[valid], force[valid], turned_bias[valid].reshape(-1, 3, 3))


def _regressed(acceleration: Array, force: Array, rotations: Array) -> float:
    """Return k of a = k f + R b + g by least squares, the noise of the positions being in a.  (N, 3) -> about +-1."""
    count = len(force)
    design = np.concatenate([force[:, :, None], rotations, np.broadcast_to(np.eye(3), (count, 3, 3))], axis=2).reshape(
        3 * count, 7
    )
    solution, *_ = np.linalg.lstsq(design, acceleration.ravel(), rcond=None)
    return float(solution[0])


def _matched_kernels(window: int, step_s: float) -> tuple[Array, Array]:
    """Return the second derivative of a parabola through a window of positions, and the mean of accelerations it is.

    By parts, sum k_i p_i = sum K_j (p_{j-1} - 2 p_j + p_{j+1}) with K the double running sum of k.
    """
    t = (np.arange(window) - window // 2) * step_s
    kernel = 2.0 * np.linalg.pinv(np.vander(t, 3))[0]
    twice = np.cumsum(np.cumsum(kernel))[:-2] * step_s**2
    return kernel, np.concatenate([[0.0], twice, [0.0]])


def _world_file(log: Log) -> str:
    return "landmarks.json" if log.landmark_map is not None else "camera_poses.csv"


def _negated_accelerometer(log: Log) -> Log:
    assert log.imu is not None
    return replace(log, imu=replace(log.imu, specific_force=-log.imu.specific_force))


def turned_world(log: Log) -> Log:
    """Return the log with its world turned by 180 degrees about x: map, camera poses and ground truth."""
    turn = make_pose(Rotation.from_quat([1.0, 0.0, 0.0, 0.0]), np.zeros(3))

    def moved(trajectory: Trajectory | None) -> Trajectory | None:
        return None if trajectory is None else Trajectory(trajectory.stamps_ns, turn * trajectory.T_world_body)

    landmarks = log.landmark_map and LandmarkMap(
        tuple(replace(each, T_world_obj=turn * each.T_world_obj) for each in log.landmark_map)
    )
    cameras = log.camera_poses and _turned(log.camera_poses, turn)
    return replace(
        log,
        landmark_map=landmarks,
        camera_poses=cameras,
        T_world_cam=moved(log.T_world_cam),
        T_world_imu=moved(log.T_world_imu),
    )


def _turned(poses: CameraPoses, turn: RigidTransform) -> CameraPoses:
    covariances = poses.covariances
    if covariances is not None:  # the position's part is in world axes
        jacobian = np.eye(6)
        jacobian[3:, 3:] = turn.rotation.as_matrix()
        covariances = jacobian @ covariances @ jacobian.T
    return replace(poses, T_world_cam=turn * poses.T_world_cam, covariances=covariances)
