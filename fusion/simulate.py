"""A simulated table-top world: known motion -> IMU samples and object poses with known noise.

Everything comes from the seed; switching one thing on or off leaves the random numbers of the others as they were.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.detection_errors import (
    NetworkErrors,
    WhiteErrors,
    covariance_in_camera_axes,
    ray_axes,
    run_numbers,
    runs,
    to_camera_axes,
)
from fusion.motion import Motion, hand_held_flight
from fusion.table_top import disturbed_map, table_top
from poet_loc.core.geometry import make_pose, retract
from poet_loc.core.records import (
    Calibration,
    Camera,
    CameraPoses,
    ImuNoise,
    ImuSamples,
    LandmarkMap,
    ObjectPoses,
)
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]
Stream = Callable[[str], np.random.Generator]

_START_NS = 1_700_000_000_000_000_000
_MARGIN_S = 0.1  # the IMU runs this much longer than the camera at both ends


@dataclass(frozen=True)
class Displacement:
    """One object that is moved while the log runs; the written map does not know."""

    object: int = -1
    """Which of the objects, counted from 0; -1: none."""
    after_s: float = 30.0
    """When, s from the log's start."""
    until_s: float = float("inf")
    """When it is put back, s from the log's start."""
    distance: float = 0.2
    """How far over the table, in a random direction, m."""
    turn_deg: float = 0.0
    """How far it is turned about the vertical, deg."""


@dataclass(frozen=True)
class SimulationOptions:
    """The world, its sensors and their errors."""

    duration_s: float = 60.0
    """Length of the log, s."""
    rest_s: float = 1.0
    """Time at rest before the flight begins, s."""
    imu_rate_hz: float = 200.0
    """Rate of the IMU, Hz."""
    camera_rate_hz: float = 30.0
    """Rate of the camera and thus of the object poses, Hz."""
    objects: int = 8
    """Objects on the table."""
    symmetric_objects: int = 2
    """How many of them are symmetric: alternately a can (every turn about z) and a box (half turns about z)."""
    seed: int = 0
    """Everything random comes from it."""
    noise: Literal["none", "white", "network"] = "network"
    """Errors of the object poses: none, white with the covariance written, or like a real network's."""
    covariances: bool | None = None
    """Write the object poses' covariances (of the inlier error); None: with white noise only."""
    white: WhiteErrors = field(default_factory=WhiteErrors)
    """Errors of `noise` white."""
    network: NetworkErrors = field(default_factory=NetworkErrors)
    """Errors of `noise` network."""
    imu_errors: bool = True
    """Give the IMU white noise and wandering biases; False: exact samples."""
    imu_noise: ImuNoise = field(default_factory=lambda: ImuNoise(1.7e-4, 2.0e-3, 2.0e-5, 3.0e-3, 200.0))
    """Noise densities of the IMU as written to the calibration (its update rate becomes imu_rate_hz)."""
    gyroscope_bias_sigma: float = 0.01
    """1-sigma of the gyroscope's first bias, rad/s."""
    accelerometer_bias_sigma: float = 0.1
    """1-sigma of the accelerometer's first bias, m/s^2."""
    imu_position_in_cam: tuple[float, float, float] = (0.05, -0.02, -0.03)
    """Where the IMU sits in camera axes, m."""
    imu_rotation_in_cam_deg: tuple[float, float, float] = (-85.0, 5.0, 3.0)
    """Rotation vector of T_cam_imu, deg."""
    timeshift_cam_imu_s: float = 0.0
    """t_imu = t_cam + timeshift, written to the calibration, s."""
    stamp_delay_s: float = 0.0
    """Camera stamps are this much later than the exposure and the calibration does not know, s."""
    map_position_sigma_m: float = 0.0
    """1-sigma of the written map's position errors per axis, m; the map then carries its covariance."""
    map_rotation_sigma_deg: float = 0.0
    """1-sigma of the written map's rotation errors per axis, deg."""
    moved: Displacement = field(default_factory=Displacement)
    """An object that is moved on the way."""
    camera_poses: bool = False
    """Also make camera poses at the camera's rate, with white noise and its covariance."""
    camera_pose_position_sigma_m: float = 0.02
    """1-sigma of those camera poses' position per axis, m."""
    camera_pose_rotation_sigma_deg: float = 1.0
    """1-sigma of those camera poses' rotation per axis, deg."""
    odometry: bool = False
    """Also make T_odom_cam, which drifts."""
    odometry_position_drift: float = 0.004
    """Random walk of the odometry's position, m/sqrt(s)."""
    odometry_rotation_drift_deg: float = 0.12
    """Random walk of the odometry's rotation, deg/sqrt(s)."""


@dataclass(frozen=True)
class SimulationTruth:
    """What a simulated log does not say: the motion and every error that was put in."""

    motion: Motion
    """The true motion of the imu on the IMU's clock."""
    gyroscope_bias: Array
    """(N, 3) at the IMU stamps, rad/s."""
    accelerometer_bias: Array
    """(N, 3) at the IMU stamps, m/s^2."""
    landmark_map: LandmarkMap
    """The true map."""
    inlier_errors: Array
    """(D, 6) [e_r, e_t] of each detection in camera axes without what is gross or flipped, rad and m."""
    slow_errors: Array
    """(D, 6) the part of them that is not white."""
    gross: Mask
    """(D,) detections that are grossly wrong."""
    flipped: Mask
    """(D,) detections that show a look-alike of a symmetric object."""
    moved_map: LandmarkMap
    """The true map while an object is moved; without one, the true map."""


def simulate(options: SimulationOptions | None = None) -> Log:
    """Return a simulated log, as if read from a folder."""
    return simulate_with_truth(options)[0]


def simulate_with_truth(options: SimulationOptions | None = None) -> tuple[Log, SimulationTruth]:
    """Return a simulated log and what a log does not say."""
    options = options or SimulationOptions()

    def stream(name: str) -> np.random.Generator:
        return np.random.default_rng([options.seed, zlib.crc32(name.encode())])

    calibration = _calibration(options)
    T_cam_imu = calibration.T_cam_imu
    assert T_cam_imu is not None
    motion = hand_held_flight(_START_NS, options.duration_s, options.rest_s, T_cam_imu, stream("flight"))
    imu, gyroscope_bias, accelerometer_bias = _imu(options, motion, stream("imu"))
    true_map = table_top(options.objects, options.symmetric_objects, stream("map"))

    exposures_ns = _regular_stamps(options.duration_s, options.camera_rate_hz, _MARGIN_S)
    stamps_ns = exposures_ns + round((options.stamp_delay_s - options.timeshift_cam_imu_s) * 1e9)
    seen_from = motion.pose(exposures_ns) * T_cam_imu.inv()
    moved_map = displaced_map(true_map, options.moved, stream("moved"))
    seconds = (exposures_ns - _START_NS) * 1e-9
    moved = (seconds >= options.moved.after_s) & (seconds < options.moved.until_s)
    maps = true_map, moved_map, moved
    detections, errors = _detections(options, calibration, maps, stamps_ns, seen_from, stream)

    on_camera_clock = stamps_ns + round(options.timeshift_cam_imu_s * 1e9)
    T_world_cam = Trajectory(stamps_ns, motion.pose(on_camera_clock) * T_cam_imu.inv())
    log = Log(
        path=Path("simulated"),
        object_poses={"": detections},
        landmark_map=disturbed_map(
            true_map, options.map_position_sigma_m, options.map_rotation_sigma_deg, stream("map errors")
        ),
        camera_poses=_camera_poses(options, stamps_ns, seen_from, stream("camera poses")),
        imu=imu,
        calibration=calibration,
        T_world_cam=T_world_cam,
        T_world_imu=Trajectory(imu.stamps_ns, motion.pose(imu.stamps_ns)),
        T_odom_cam=_odometry(options, Trajectory(stamps_ns, seen_from), stream("odometry")),
        frames=None,
    )
    return log, SimulationTruth(motion, gyroscope_bias, accelerometer_bias, true_map, moved_map=moved_map, **errors)


def displaced_map(landmark_map: LandmarkMap, moved: Displacement, rng: np.random.Generator) -> LandmarkMap:
    """Return the map with one object moved over the table and turned about the vertical."""
    angle, landmarks = rng.uniform(-np.pi, np.pi), list(landmark_map)
    if not 0 <= moved.object < len(landmarks):
        return landmark_map
    before = landmarks[moved.object]
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(moved.turn_deg)])
    aside = moved.distance * np.array([np.cos(angle), np.sin(angle), 0.0])
    T_world_obj = make_pose(turn * before.T_world_obj.rotation, before.T_world_obj.translation + aside)
    landmarks[moved.object] = replace(before, T_world_obj=T_world_obj)
    return LandmarkMap(tuple(landmarks))


def _regular_stamps(duration_s: float, rate_hz: float, margin_s: float) -> Stamps:
    count = int((duration_s - 2.0 * margin_s) * rate_hz) + 1
    return _START_NS + np.round((margin_s + np.arange(count) / rate_hz) * 1e9).astype(np.int64)


def _calibration(options: SimulationOptions) -> Calibration:
    noise = options.imu_noise
    return Calibration(
        T_cam_imu=make_pose(
            Rotation.from_rotvec(options.imu_rotation_in_cam_deg, degrees=True), options.imu_position_in_cam
        ),
        timeshift_cam_imu_s=options.timeshift_cam_imu_s,
        camera=Camera((600.0, 600.0, 319.5, 239.5), resolution=(640, 480)),
        imu=ImuNoise(
            noise.gyroscope_noise_density,
            noise.accelerometer_noise_density,
            noise.gyroscope_random_walk,
            noise.accelerometer_random_walk,
            options.imu_rate_hz,
        ),
    )


def _imu(options: SimulationOptions, motion: Motion, rng: np.random.Generator) -> tuple[ImuSamples, Array, Array]:
    """Return the samples and the biases in them; discrete sigma = density * sqrt(rate), walk * sqrt(interval)."""
    exact = motion.imu_samples(_regular_stamps(options.duration_s, options.imu_rate_hz, 0.0))
    shape = exact.angular_velocity.shape
    if not options.imu_errors:
        return exact, np.zeros(shape), np.zeros(shape)
    noise, rate = options.imu_noise, options.imu_rate_hz

    def wander(first_sigma: float, walk: float) -> Array:
        steps = rng.standard_normal(shape) * walk / np.sqrt(rate)
        steps[0] = rng.standard_normal(3) * first_sigma
        return np.cumsum(steps, axis=0)

    gyroscope_bias = wander(options.gyroscope_bias_sigma, noise.gyroscope_random_walk)
    accelerometer_bias = wander(options.accelerometer_bias_sigma, noise.accelerometer_random_walk)
    white = rng.standard_normal((2, *shape)) * np.sqrt(rate)
    samples = ImuSamples(
        exact.stamps_ns,
        exact.angular_velocity + gyroscope_bias + noise.gyroscope_noise_density * white[0],
        exact.specific_force + accelerometer_bias + noise.accelerometer_noise_density * white[1],
    )
    return samples, gyroscope_bias, accelerometer_bias


def _detections(
    options: SimulationOptions,
    calibration: Calibration,
    maps: tuple[LandmarkMap, LandmarkMap, Mask],
    stamps_ns: Stamps,
    T_world_cam: RigidTransform,
    stream: Stream,
) -> tuple[ObjectPoses, Mapping[str, NDArray]]:
    """Return the object poses that the sensor reports, and the errors in them by field of SimulationTruth.

    maps: the true map, the one after an object was moved, and in which frames that was so.
    """
    true_map, moved_map, moved = maps
    frames, objects = len(stamps_ns), len(true_map)
    now = moved[:, None, None]
    p_world_obj = np.where(now, moved_map.T_world_obj.translation, true_map.T_world_obj.translation)
    R_world_obj = [each.T_world_obj.rotation.as_matrix() for each in (true_map, moved_map)]
    R_cam_world = np.swapaxes(T_world_cam.rotation.as_matrix(), 1, 2)
    points = np.einsum("fij,foj->foi", R_cam_world, p_world_obj - T_world_cam.translation[:, None])
    R_cam_obj = np.einsum("fij,fojk->foik", R_cam_world, np.where(now[..., None], R_world_obj[1], R_world_obj[0]))
    sigmas, white, slow = _ray_errors(options, np.linalg.norm(points, axis=-1), stream)
    R_cam_ray = ray_axes(points)
    slow = to_camera_axes(slow, R_cam_ray)
    inlier = slow + to_camera_axes(white, R_cam_ray)

    gross, flipped, dropped = _run_masks(options, frames, true_map, stream("runs"))
    look_alike, wrong_turn, wrong_place = _gross_errors(gross, flipped, true_map, points, stream("gross"))
    seen = _in_view(calibration, points) & ~dropped
    frame, column = np.nonzero(seen)
    rotation = (
        wrong_turn[frame, column] @ Rotation.from_rotvec(inlier[seen][:, :3]).as_matrix() @ R_cam_obj[seen]
    ) @ look_alike[seen]
    write = options.noise == "white" if options.covariances is None else options.covariances
    scores = stream("scores").uniform(0.5, 1.0, (frames, objects)) - 0.2 * gross
    detections = ObjectPoses(
        stamps_ns[frame],
        frame.astype(np.int64),
        true_map.object_ids[column],
        np.zeros(len(frame), dtype=np.int64),
        np.asarray(np.round(scores[seen], 3), dtype=float),
        make_pose(Rotation.from_matrix(rotation), (points + inlier[..., 3:] + wrong_place)[seen]),
        covariance_in_camera_axes(sigmas[seen], R_cam_ray[seen]) if write else None,
    )
    return detections, {
        "inlier_errors": inlier[seen],
        "slow_errors": slow[seen],
        "gross": gross[seen],
        "flipped": flipped[seen],
    }


def _ray_errors(options: SimulationOptions, distances: Array, stream: Stream) -> tuple[Array, Array, Array]:
    """Return 1-sigma, white error and slow error of all F frames and O objects in ray axes, each (F, O, 6)."""
    frames, objects = distances.shape
    draws = stream("white").standard_normal((frames, objects, 6))
    if options.noise == "network":
        sigmas = options.network.sigmas(distances)
        slow = options.network.slow_part(frames, objects, 1.0 / options.camera_rate_hz, stream("slow"))
        return sigmas, options.network.white_sigma * sigmas * draws, sigmas * slow
    sigmas = options.white.sigmas(distances)
    scale = 1.0 if options.noise == "white" else 0.0
    return sigmas, scale * sigmas * draws, np.zeros_like(sigmas)


def _run_masks(
    options: SimulationOptions, frames: int, true_map: LandmarkMap, rng: np.random.Generator
) -> tuple[Mask, Mask, Mask]:
    """Return which detections are gross, flipped and missing, each (F, O)."""
    if options.noise != "network":
        nothing = np.zeros((frames, len(true_map)), dtype=bool)
        return nothing, nothing, nothing
    network, rate, count = options.network, options.camera_rate_hz, len(true_map)
    symmetric = np.array([landmark.symmetry is not None for landmark in true_map], dtype=bool)
    gross = runs(frames, count, network.gross_share, network.gross_run_s * rate, rng)
    flipped = runs(frames, count, network.flip_share, network.flip_run_s * rate, rng) & symmetric
    dropped = runs(frames, count, network.dropout_share, network.dropout_run_s * rate, rng)
    return gross, flipped & ~gross, dropped


def _gross_errors(
    gross: Mask, flipped: Mask, true_map: LandmarkMap, points: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return, for each detection, a turn of the object, a turn in camera axes and a displacement.

    Each run of gross errors is one of three: the depth is wrong by a quarter to a half, the object is seen turned by
    half about one of its axes, or the whole pose is somewhere else. A flip turns the object by its own symmetry.
    """
    gross_run, flip_run = run_numbers(gross), run_numbers(flipped)
    count = max(int(gross_run.max(initial=-1)), int(flip_run.max(initial=-1))) + 1
    kind = rng.integers(0, 3, count + 1)
    depth = rng.choice([-1.0, 1.0], count + 1) * rng.uniform(0.25, 0.5, count + 1)
    half_turn = Rotation.from_rotvec(np.pi * np.eye(3)[rng.integers(0, 3, count + 1)]).as_matrix()
    anywhere = Rotation.random(count + 1, rng=rng).as_matrix()
    aside = rng.choice([-1.0, 1.0], (count + 1, 3)) * rng.uniform(0.1, 0.3, (count + 1, 3))
    turn = rng.uniform(0.0, 2.0 * np.pi, count + 1)

    wrong_depth, turned, elsewhere = (gross & (kind[gross_run] == which) for which in range(3))
    identity = np.eye(3)
    look_alike = np.where(turned[..., None, None], half_turn[gross_run], identity)
    for column, landmark in enumerate(true_map):
        if landmark.symmetry is not None:
            order = landmark.symmetry.order
            angle = turn if order == "continuous" else np.full(count + 1, 2.0 * np.pi / order)
            own = Rotation.from_rotvec(angle[:, None] * landmark.symmetry.axis).as_matrix()
            on = flipped[:, column, None, None]
            look_alike[:, column] = np.where(on, own[flip_run[:, column]], look_alike[:, column])
    wrong_turn = np.where(elsewhere[..., None, None], anywhere[gross_run], identity)
    wrong_place = np.where(wrong_depth[..., None], depth[gross_run][..., None] * points, 0.0)
    wrong_place += np.where(elsewhere[..., None], aside[gross_run], 0.0)
    return look_alike, wrong_turn, wrong_place


def _in_view(calibration: Calibration, points: Array, nearest_m: float = 0.1, border_px: float = 15.0) -> Mask:
    """Return which points (..., 3) in camera axes lie inside the image."""
    camera = calibration.camera
    assert camera is not None
    assert camera.resolution is not None
    fx, fy, cx, cy = camera.intrinsics
    width, height = camera.resolution
    depth = np.maximum(points[..., 2], nearest_m)
    u, v = fx * points[..., 0] / depth + cx, fy * points[..., 1] / depth + cy
    inside = (u >= border_px) & (u < width - border_px) & (v >= border_px) & (v < height - border_px)
    return np.asarray(inside & (points[..., 2] > nearest_m))


def _camera_poses(
    options: SimulationOptions, stamps_ns: Stamps, T_world_cam: RigidTransform, rng: np.random.Generator
) -> CameraPoses | None:
    if not options.camera_poses:
        return None
    sigma = np.repeat([np.radians(options.camera_pose_rotation_sigma_deg), options.camera_pose_position_sigma_m], 3)
    errors = sigma * rng.standard_normal((len(stamps_ns), 6))
    return CameraPoses(
        stamps_ns,
        np.arange(len(stamps_ns), dtype=np.int64),
        make_pose(T_world_cam.rotation * Rotation.from_rotvec(errors[:, :3]), T_world_cam.translation + errors[:, 3:]),
        np.broadcast_to(np.diag(sigma**2), (len(stamps_ns), 6, 6)).copy(),
    )


def _odometry(options: SimulationOptions, T_world_cam: Trajectory, rng: np.random.Generator) -> Trajectory | None:
    """Return the camera's relative motions chained with an error each; the first pose is the identity."""
    if not options.odometry:
        return None
    sigma = np.repeat([np.radians(options.odometry_rotation_drift_deg), options.odometry_position_drift], 3)
    poses = T_world_cam.T_world_body
    steps = poses[:-1].inv() * poses[1:]
    errors = sigma / np.sqrt(options.camera_rate_hz) * rng.standard_normal((len(steps), 6))
    chain = [np.eye(4)]
    for step in retract(steps, errors).as_matrix():
        chain.append(chain[-1] @ step)
    return Trajectory(T_world_cam.stamps_ns, RigidTransform.from_matrix(np.stack(chain)))
