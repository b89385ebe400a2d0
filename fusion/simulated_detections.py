"""What a simulated sensor says of the objects in view, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.detection_errors import covariance_in_camera_axes, ray_axes, run_numbers, runs, to_camera_axes
from fusion.simulation_options import SimulationOptions, writes_covariances
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Calibration, LandmarkMap, ObjectPoses

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]
Stream = Callable[[str], np.random.Generator]


def detect_objects(
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
    true_map = maps[0]
    points, R_cam_obj = _objects_in_camera(maps, T_world_cam)
    sigmas, white, slow = _ray_errors(options, np.linalg.norm(points, axis=-1), stream)
    R_cam_ray = ray_axes(points)
    slow = to_camera_axes(slow, R_cam_ray)
    inlier = slow + to_camera_axes(white, R_cam_ray)
    gross, flipped, dropped = _run_masks(options, len(stamps_ns), true_map, stream("runs"))
    look_alike, wrong_turn, wrong_place = _gross_errors(gross, flipped, true_map, points, stream("gross"))

    seen = _in_view(calibration, points) & ~dropped
    frame, column = np.nonzero(seen)
    turn = Rotation.from_rotvec(inlier[seen][:, :3]).as_matrix()
    rotation = (wrong_turn[frame, column] @ turn @ R_cam_obj[seen]) @ look_alike[seen]
    scores = stream("scores").uniform(0.5, 1.0, seen.shape) - 0.2 * gross
    detections = ObjectPoses(
        stamps_ns[frame],
        frame.astype(np.int64),
        true_map.object_ids[column],
        np.zeros(len(frame), dtype=np.int64),
        np.asarray(np.round(scores[seen], 3), dtype=float),
        make_pose(Rotation.from_matrix(rotation), (points + inlier[..., 3:] + wrong_place)[seen]),
        covariance_in_camera_axes(options.stated_share * sigmas[seen], R_cam_ray[seen])
        if writes_covariances(options)
        else None,
    )
    errors = {"inlier_errors": inlier, "slow_errors": slow, "gross": gross, "flipped": flipped}
    return detections, {name: each[seen] for name, each in errors.items()}


def _objects_in_camera(maps: tuple[LandmarkMap, LandmarkMap, Mask], T_world_cam: RigidTransform) -> tuple[Array, Array]:
    """Return position (F, O, 3) and rotation (F, O, 3, 3) of every object in every frame, in camera axes."""
    true_map, moved_map, moved = maps
    now = moved[:, None, None]
    p_world_obj = np.where(now, moved_map.T_world_obj.translation, true_map.T_world_obj.translation)
    R_world_obj = [each.T_world_obj.rotation.as_matrix() for each in (true_map, moved_map)]
    R_cam_world = np.swapaxes(T_world_cam.rotation.as_matrix(), 1, 2)
    points = np.einsum("fij,foj->foi", R_cam_world, p_world_obj - T_world_cam.translation[:, None])
    rotations = np.where(now[..., None], R_world_obj[1], R_world_obj[0])
    return points, np.einsum("fij,fojk->foik", R_cam_world, rotations)


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
