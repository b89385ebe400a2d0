"""Known-bad logs: each spoils a good one in a way that users do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.simulate import SimulationOptions, simulate
from poet_loc.check.gravity import turned_world
from poet_loc.check.pose_sources import Reading, reread
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import LandmarkMap
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log, write_log

SpoilLog = Callable[[Log], Log]
SpoilFolder = Callable[[Path], None]


def imu(gyroscope: float | np.ndarray = 1.0, accelerometer: float | np.ndarray = 1.0) -> SpoilLog:
    """Scale, or with a (3, 3) matrix turn, what the IMU reads."""

    def by(values: np.ndarray, factor: float | np.ndarray) -> np.ndarray:
        return values @ np.asarray(factor).T if np.ndim(factor) else values * factor

    def spoil(log: Log) -> Log:
        rates, force = by(log.imu.angular_velocity, gyroscope), by(log.imu.specific_force, accelerometer)
        return replace(log, imu=replace(log.imu, angular_velocity=rates, specific_force=force))

    return spoil


def biased_gyroscope(log: Log) -> Log:
    return replace(log, imu=replace(log.imu, angular_velocity=log.imu.angular_velocity + [0.3, -0.2, 0.1]))


def without_gravity(log: Log) -> Log:
    T, _ = log.T_world_imu.interpolate(log.imu.stamps_ns)
    force = log.imu.specific_force - T.rotation.inv().apply([0.0, 0.0, 9.81])
    return replace(log, imu=replace(log.imu, specific_force=force))


def dead_axis(log: Log) -> Log:
    force = log.imu.specific_force.copy()
    force[:, 2] = 0.0
    return replace(log, imu=replace(log.imu, specific_force=force))


def imu_gap(log: Log) -> Log:
    seconds = (log.imu.stamps_ns - log.imu.stamps_ns[0]) / 1e9
    return replace(log, imu=log.imu[(seconds < 3.0) | (seconds > 4.0)])


def detection_gap(log: Log) -> Log:
    poses = log.object_poses[""]
    seconds = (poses.stamps_ns - poses.stamps_ns[0]) / 1e9
    return replace(log, object_poses={"": poses[(seconds < 2.0) | (seconds > 11.0)]})


def broken_odometry(length_s: float, jump_m: float) -> SpoilLog:
    """Add odometry that is the truth but for a hole, or a jump."""

    def spoil(log: Log) -> Log:
        truth, jump = log.T_world_cam, make_pose(Rotation.identity(), np.array([0.0, jump_m, 0.0]))
        seconds, poses = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9, truth.T_world_body
        before, after = np.flatnonzero(seconds < 3.0), np.flatnonzero(seconds >= 3.0 + length_s)
        poses = RigidTransform.concatenate([poses[before], jump * poses[after]])
        return replace(log, T_odom_cam=Trajectory(truth.stamps_ns[np.r_[before, after]], poses))

    return spoil


def opengl_camera(log: Log) -> Log:
    turned = make_pose(Rotation.from_rotvec([np.pi, 0.0, 0.0]), np.zeros(3))
    poses = {name: replace(each, T_cam_obj=turned * each.T_cam_obj) for name, each in log.object_poses.items()}
    return replace(log, object_poses=poses)


def scaled_odometry(scale: float) -> SpoilLog:
    """Add odometry that is the truth in another unit."""

    def spoil(log: Log) -> Log:
        poses = log.T_world_cam.T_world_body
        return replace(
            log,
            T_odom_cam=Trajectory(log.T_world_cam.stamps_ns, make_pose(poses.rotation, scale * poses.translation)),
        )

    return spoil


def part_of_odometry(first_s: float, last_s: float) -> SpoilLog:
    """Add odometry that is the truth, and there from one time to another only."""

    def spoil(log: Log) -> Log:
        seconds = (log.T_world_cam.stamps_ns - log.T_world_cam.stamps_ns[0]) / 1e9
        return replace(log, T_odom_cam=log.T_world_cam[(seconds >= first_s) & (seconds <= last_s)])

    return spoil


def receive_times(log: Log) -> Log:
    rng = np.random.default_rng(1)
    stamps = np.sort(log.imu.stamps_ns + rng.uniform(-6e6, 6e6, len(log.imu)).astype(np.int64))
    keep = np.concatenate([[True], np.diff(stamps) > 0])
    return replace(log, imu=replace(log.imu, stamps_ns=stamps)[keep])


def microseconds(log: Log) -> Log:
    return replace(log, imu=replace(log.imu, stamps_ns=log.imu.stamps_ns // 1000))


def other_clock(log: Log) -> Log:
    return replace(log, imu=replace(log.imu, stamps_ns=log.imu.stamps_ns - 3600 * 10**9))


def inverse_extrinsics(log: Log) -> Log:
    return calibrated(log, T_cam_imu=log.calibration.T_cam_imu.inv())


def turned_extrinsics(log: Log) -> Log:
    turn = make_pose(Rotation.from_rotvec([0.0, 70.0, 40.0], degrees=True), np.zeros(3))
    return calibrated(log, T_cam_imu=turn * log.calibration.T_cam_imu)


def calibrated(log: Log, **fields) -> Log:
    return replace(log, calibration=replace(log.calibration, **fields))


def noise(**factors: float) -> SpoilLog:
    def spoil(log: Log) -> Log:
        stated = log.calibration.imu
        changed = {name: getattr(stated, name) * factor for name, factor in factors.items()}
        return calibrated(log, imu=replace(stated, **changed))

    return spoil


def late_camera(log: Log) -> Log:
    """The camera's stamps are 80 ms late, in every file."""
    late = 80_000_000
    truth = Trajectory(log.T_world_cam.stamps_ns + late, log.T_world_cam.T_world_body)
    poses = log.object_poses[""]
    return replace(log, object_poses={"": replace(poses, stamps_ns=poses.stamps_ns + late)}, T_world_cam=truth)


def late_detections(log: Log) -> Log:
    poses = log.object_poses[""]
    return replace(log, object_poses={"": replace(poses, stamps_ns=poses.stamps_ns + 80_000_000)})


def detections(reading: Reading) -> SpoilLog:
    def spoil(log: Log) -> Log:
        poses = log.object_poses[""]
        return replace(log, object_poses={"": replace(poses, T_cam_obj=mistaken(poses.T_cam_obj, reading))})

    return spoil


def mapped(reading: Reading) -> SpoilLog:
    def spoil(log: Log) -> Log:
        landmarks = (replace(each, T_world_obj=mistaken(each.T_world_obj, reading)) for each in log.landmark_map)
        return replace(log, landmark_map=LandmarkMap(tuple(landmarks)))

    return spoil


def truth(field: str, reading: Reading) -> SpoilLog:
    def spoil(log: Log) -> Log:
        trajectory = getattr(log, field)
        return replace(log, **{field: Trajectory(trajectory.stamps_ns, mistaken(trajectory.T_world_body, reading))})

    return spoil


def mistaken(T: RigidTransform, reading: Reading) -> RigidTransform:
    """Return what is read when poses are written in another order or direction."""
    if reading == "wxyz":
        return make_pose(Rotation.from_quat(T.rotation.as_quat()[..., [3, 0, 1, 2]]), T.translation)
    return reread(T, reading)


def lengths(factor: float, *files: str) -> SpoilLog:
    def scaled(T: RigidTransform) -> RigidTransform:
        return make_pose(T.rotation, T.translation * factor)

    def spoil(log: Log) -> Log:
        if "landmarks" in files:
            landmarks = (replace(each, T_world_obj=scaled(each.T_world_obj)) for each in log.landmark_map)
            log = replace(log, landmark_map=LandmarkMap(tuple(landmarks)))
        if "object_poses" in files:
            poses = log.object_poses[""]
            log = replace(log, object_poses={"": replace(poses, T_cam_obj=scaled(poses.T_cam_obj))})
        if "T_world_cam" in files:
            T = log.T_world_cam
            log = replace(log, T_world_cam=Trajectory(T.stamps_ns, scaled(T.T_world_body)))
        return log

    return spoil


def stated(times_too_small: float) -> SpoilLog:
    """Let detections state so many times less than errors of 5 mm and 2 deg that they then have."""

    def spoil(log: Log) -> Log:
        rng = np.random.default_rng(8)
        sigma = np.repeat([np.radians(2.0), 0.005], 3)
        truth = simulate(SimulationOptions(duration_s=15.0, objects=5, symmetric_objects=1, seed=0, noise="none"))
        exact = truth.object_poses[""]
        error = sigma * rng.standard_normal((len(exact), 6))
        turn, T_true = Rotation.from_rotvec(error[:, :3]), exact.T_cam_obj
        T = make_pose(turn * T_true.rotation, T_true.translation + error[:, 3:])
        covariances = np.tile(np.diag((sigma / times_too_small) ** 2), (len(exact), 1, 1))
        return replace(log, object_poses={"": replace(exact, T_cam_obj=T, covariances=covariances)})

    return spoil


def moved_landmark(log: Log) -> Log:
    return with_landmark(log, 2, make_pose(Rotation.identity(), [0.2, -0.1, 0.05]))


def turned_landmark(log: Log) -> Log:
    landmark = log.landmark_map.landmarks[1].T_world_obj
    turn = make_pose(landmark.rotation, np.zeros(3)) * make_pose(Rotation.from_rotvec([0, 0, 1.2]), np.zeros(3))
    return with_landmark(log, 1, make_pose(turn.rotation * landmark.rotation.inv(), np.zeros(3)))


def with_landmark(log: Log, index: int, T_new_old: RigidTransform) -> Log:
    landmarks = list(log.landmark_map)
    T = landmarks[index].T_world_obj
    T = make_pose(T_new_old.rotation * T.rotation, T.translation + T_new_old.translation)
    landmarks[index] = replace(landmarks[index], T_world_obj=T)
    return replace(log, landmark_map=LandmarkMap(tuple(landmarks)))


def missing_landmark(log: Log) -> Log:
    return replace(log, landmark_map=LandmarkMap(log.landmark_map.landmarks[1:]))


def world_on_its_side(log: Log) -> Log:
    """y is up, as in many datasets of cameras."""
    turn = make_pose(Rotation.from_rotvec([-90.0, 0.0, 0.0], degrees=True), np.zeros(3))
    landmarks = (replace(each, T_world_obj=turn * each.T_world_obj) for each in log.landmark_map)
    moved = {
        name: Trajectory(getattr(log, name).stamps_ns, turn * getattr(log, name).T_world_body)
        for name in ("T_world_cam", "T_world_imu")
    }
    return replace(log, landmark_map=LandmarkMap(tuple(landmarks)), **moved)


def truth_of_another_world(log: Log) -> Log:
    T = log.T_world_cam.T_world_body
    moved = Trajectory(log.T_world_cam.stamps_ns, make_pose(T.rotation, T.translation + [0.5, 0.0, 0.0]))
    return replace(log, T_world_cam=moved)


def lines(file: str, change: Callable[[list[str]], list[str]]) -> SpoilFolder:
    """Change the lines of a file after its header."""

    def spoil(folder: Path) -> None:
        header, *rows = (folder / file).read_text().splitlines()
        (folder / file).write_text("\n".join([header, *change(rows)]) + "\n")

    return spoil


def swapped_rows(rows: list[str]) -> list[str]:
    return [*rows[:100], rows[101], rows[100], *rows[102:]]


def repeated_row(rows: list[str]) -> list[str]:
    return [*rows[:50], rows[50], *rows[50:]]


def broken_rows(rows: list[str]) -> list[str]:
    return [*rows[:10], rows[10][:-20] + ",,", "garbage", *rows[12:]]


def nan_rows(rows: list[str]) -> list[str]:
    return [*rows[:10], ",".join([rows[10].split(",")[0], *["nan"] * 6]), *rows[11:]]


def unscored_rows(rows: list[str]) -> list[str]:
    def without(row: str, score: str) -> str:
        cells = row.split(",")
        return ",".join([*cells[:4], score, *cells[5:]])

    return [without(rows[0], "nan"), without(rows[1], "inf"), *rows[2:]]


def column_too_many(folder: Path) -> None:
    file = folder / "object_poses.csv"
    header, *rows = file.read_text().splitlines()
    file.write_text("\n".join([f"{header},", *(f"{row}," for row in rows)]) + "\n")


def long_quaternions(rows: list[str]) -> list[str]:
    def double(row: str) -> str:
        cells = row.split(",")
        return ",".join([*cells[:8], *(repr(2.0 * float(cell)) for cell in cells[8:])])

    return [double(row) if index % 3 == 0 else row for index, row in enumerate(rows)]


def degrees_in_header(folder: Path) -> None:
    text = (folder / "imu.csv").read_text()
    header, *rows = text.splitlines()
    cells = [row.split(",") for row in rows]
    turned = [[c[0], *(repr(float(v) * 180.0 / np.pi) for v in c[1:4]), *c[4:]] for c in cells]
    header = header.replace("rad s^-1", "deg s^-1")
    (folder / "imu.csv").write_text("\n".join([header, *map(",".join, turned)]) + "\n")


def millimetre_lever(folder: Path) -> None:
    import yaml

    file = folder / "calibration.yaml"
    content = yaml.safe_load(file.read_text())
    for row in content["cam0"]["T_cam_imu"][:3]:
        row[3] *= 1000.0
    file.write_text(yaml.safe_dump(content))


def renamed_camera(folder: Path) -> None:
    file = folder / "calibration.yaml"
    file.write_text(file.read_text().replace("cam0:", "camera:"))


def broken_json(folder: Path) -> None:
    (folder / "landmarks.json").write_text('{"landmarks": [')


IMU_FLIPPED_Y = np.diag([1.0, -1.0, 1.0])


# name: (how it is spoiled, the checks that name it, whether --fix leaves a log without findings)
def short_imu(log: Log) -> Log:
    return replace(log, imu=log.imu[: len(log.imu) * 3 // 5], T_world_imu=None)


def foreign_camera_poses(folder: Path) -> None:
    (folder / "object_poses.csv").unlink()
    (folder / "camera_poses.csv").write_text("0.1;1;2;3;0;0;0;1\n")


SPOILED_LOGS: dict[str, tuple[SpoilLog, set[str], bool]] = {
    "gyroscope in degrees": (imu(gyroscope=180.0 / np.pi), {"gyroscope-degrees"}, True),
    "gyroscope never zeroed": (biased_gyroscope, {"gyroscope-bias"}, False),
    "gyroscope with half its range": (imu(gyroscope=2.0), {"gyroscope-scale"}, False),
    "accelerometer in g": (imu(accelerometer=1.0 / 9.81), {"accelerometer-unit"}, True),
    "accelerometer in milli-g": (imu(accelerometer=1000.0 / 9.81), {"accelerometer-unit"}, True),
    "gravity taken out": (without_gravity, {"no-gravity"}, False),
    "dead axis": (dead_axis, {"dead-axis", "accelerometer-norm"}, False),
    "one axis of the imu flipped": (imu(IMU_FLIPPED_Y, IMU_FLIPPED_Y), {"axes-mirrored", "gravity-tilted"}, False),
    "accelerometer with the wrong sign": (imu(accelerometer=-1.0), {"accelerometer-sign"}, True),
    "world upside down": (turned_world, {"world-upside-down"}, True),
    "world with y up": (world_on_its_side, {"gravity-tilted"}, False),
    "gap in the imu": (imu_gap, {"gap"}, False),
    "nothing detected for long": (detection_gap, {"gap"}, False),
    "odometry that jumps": (broken_odometry(0.0, 0.4), {"odometry-jump"}, False),
    "odometry with a hole": (broken_odometry(1.5, 0.0), {"odometry-hole"}, False),
    "odometry that begins late": (part_of_odometry(2.0, 1e9), {"odometry-hole"}, False),
    "odometry that ends early": (part_of_odometry(0.0, 5.0), {"odometry-hole"}, False),
    "odometry that is a fifth too long": (scaled_odometry(1.2), {"odometry-scale"}, False),
    "odometry that is a fifth too short": (scaled_odometry(0.8), {"odometry-scale"}, False),
    "stamps of receipt": (receive_times, {"jitter"}, False),
    "stamps in microseconds": (microseconds, {"stamp-unit"}, True),
    "imu ends early": (short_imu, {"imu-span"}, False),
    "imu on another clock": (other_clock, {"span"}, False),
    "update rate": (noise(update_rate=0.5), {"rate"}, False),
    "T_cam_imu inverted": (inverse_extrinsics, {"extrinsics-inverted"}, True),
    "T_cam_imu turned": (turned_extrinsics, {"extrinsics-rotation"}, False),
    "camera 80 ms late": (late_camera, {"time-offset"}, True),
    "detections 80 ms late": (late_detections, {"time-offset"}, False),
    "detections w, x, y, z": (detections("wxyz"), {"quaternion-order"}, True),
    "detections inverted": (detections("inverse"), {"poses-inverted"}, True),
    "detections in OpenGL's axes": (opengl_camera, {"behind-camera"}, True),
    "map w, x, y, z": (mapped("wxyz"), {"quaternion-order"}, True),
    "map inverted": (mapped("inverse"), {"poses-inverted"}, True),
    "camera truth w, x, y, z": (truth("T_world_cam", "wxyz"), {"quaternion-order"}, True),
    "camera truth inverted": (truth("T_world_cam", "inverse"), {"poses-inverted"}, True),
    "imu truth w, x, y, z": (truth("T_world_imu", "wxyz"), {"quaternion-order"}, True),
    "imu truth inverted": (truth("T_world_imu", "inverse"), {"poses-inverted"}, True),
    "map in millimetres": (lengths(1000.0, "landmarks"), {"millimetres"}, True),
    "detections in millimetres": (lengths(1000.0, "object_poses"), {"millimetres"}, True),
    "truth in millimetres": (lengths(1000.0, "T_world_cam"), {"millimetres"}, True),
    "truth of another world": (truth_of_another_world, {"ground-truth-apart"}, False),
    "detector with another scale": (lengths(2.54, "object_poses"), {"scale", "ground-truth-apart"}, False),
    "landmark moved": (moved_landmark, {"landmark-out-of-line"}, False),
    "landmark turned": (turned_landmark, {"landmark-out-of-line"}, False),
    "covariances too small": (stated(2.5), {"covariance-too-small"}, False),
    "landmark missing": (missing_landmark, {"unknown-object"}, True),
    "noise far too small": (noise(gyroscope_noise_density=0.01), {"noise-too-small"}, False),
    "noise discrete": (noise(accelerometer_noise_density=14.1), {"noise-too-large"}, False),
    "noise in degrees": (noise(gyroscope_noise_density=57.3), {"noise-too-large"}, False),
    "noise implausible": (noise(accelerometer_noise_density=1e5), {"noise-implausible"}, False),
}

SPOILED_FILES: dict[str, tuple[SpoilFolder, set[str], bool]] = {
    "imu rows swapped": (lines("imu.csv", swapped_rows), {"stamps-backward"}, True),
    "imu row repeated": (lines("imu.csv", repeated_row), {"stamps-duplicate"}, True),
    "imu rows broken": (lines("imu.csv", broken_rows), {"rows"}, True),
    "imu rows nan": (lines("imu.csv", nan_rows), {"not-finite"}, True),
    "imu header in degrees": (degrees_in_header, {"imu-header-units"}, True),
    "detection repeated": (lines("object_poses.csv", repeated_row), {"stamps-duplicate"}, True),
    "detections without score": (lines("object_poses.csv", unscored_rows), {"not-finite"}, True),
    "a comma at the end of each row": (column_too_many, {"unreadable"}, True),
    "quaternions of norm 2": (lines("object_poses.csv", long_quaternions), {"quaternion-norm"}, True),
    "lever arm in millimetres": (millimetre_lever, {"millimetres"}, True),
    "no map": (lambda folder: (folder / "landmarks.json").unlink(), {"missing"}, False),
    "no calibration": (lambda folder: (folder / "calibration.yaml").unlink(), {"missing"}, False),
    "calibration of another name": (renamed_camera, {"missing"}, False),
    "calibration no yaml": (lambda folder: (folder / "calibration.yaml").write_text("cam0: ["), {"unreadable"}, False),
    "camera poses of another program": (foreign_camera_poses, {"unreadable"}, False),
    "map no json": (broken_json, {"unreadable"}, False),
}


def write_spoiled(name: str, good: Log, folder: Path) -> tuple[set[str], bool]:
    """Write a known-bad log; return the checks that must name it and whether it can be repaired."""
    if name in SPOILED_LOGS:
        spoil, expected, repairable = SPOILED_LOGS[name]
        write_log(folder, spoil(good))
    else:
        spoil_folder, expected, repairable = SPOILED_FILES[name]
        write_log(folder, good)
        spoil_folder(folder)
    return expected, repairable
