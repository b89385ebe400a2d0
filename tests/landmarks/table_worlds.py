"""Small worlds with known truth: landmarks around the origin, cameras that look at them, detections with errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Landmark, LandmarkMap, ObjectPoses, Symmetry
from poet_loc.core.trajectory import Trajectory

FRAME_NS = 33_333_333
START_NS = 1_600_000_000_000_000_000


def make_map(
    rng: np.random.Generator,
    object_ids: Sequence[int],
    symmetries: dict[int, Symmetry] | None = None,
    covariances: dict[int, np.ndarray] | None = None,
) -> LandmarkMap:
    """Landmarks with these class ids, instances counted per class, symmetries and covariances by place in the map."""
    landmarks = []
    for place, object_id in enumerate(object_ids):
        pose = make_pose(Rotation.random(rng=rng), rng.uniform(-0.4, 0.4, 3))
        instance = list(object_ids[:place]).count(object_id)
        symmetry, covariance = (symmetries or {}).get(place), (covariances or {}).get(place)
        landmarks.append(Landmark(object_id, pose, instance, f"object_{place}", covariance, symmetry))
    return LandmarkMap(tuple(landmarks))


def fly_around(rng: np.random.Generator, frames: int, step_ns: int = FRAME_NS) -> Trajectory:
    """A smooth flight about a metre from the origin, looking at it."""
    seconds = np.arange(frames) * step_ns * 1e-9
    angle = rng.uniform(0, 2 * np.pi) + 0.3 * seconds
    position = np.stack([np.cos(angle), np.sin(angle), 0.6 + 0.1 * np.sin(0.7 * seconds)], axis=1)
    forward = -position / np.linalg.norm(position, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    matrices = np.stack([right, np.cross(forward, right), forward], axis=2)
    stamps = START_NS + np.arange(frames, dtype=np.int64) * step_ns
    return Trajectory(stamps, make_pose(Rotation.from_matrix(matrices), position))


def detect(
    truth: Trajectory,
    landmark_map: LandmarkMap,
    errors: np.ndarray | None = None,
    seen: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
) -> ObjectPoses:
    """Detections of every landmark in every frame, row after row in the order of the map.

    errors (F, L, 6) is [e_r, e_t] in camera axes, seen (F, L) leaves rows out.
    """
    frames, places = len(truth), len(landmark_map)
    frame, place = (each.ravel() for each in np.indices((frames, places)))
    T_cam_obj = truth.T_world_body[frame].inv() * landmark_map.T_world_obj[place]
    if errors is not None:
        e = errors.reshape(-1, 6)
        T_cam_obj = make_pose(Rotation.from_rotvec(e[:, :3]) * T_cam_obj.rotation, T_cam_obj.translation + e[:, 3:])
    poses = ObjectPoses(
        stamps_ns=truth.stamps_ns[frame],
        frames=frame.astype(np.int64),
        object_ids=landmark_map.object_ids[place],
        instances=np.array([landmark.instance for landmark in landmark_map])[place],
        scores=np.ones(len(frame)),
        T_cam_obj=T_cam_obj,
        covariances=None if covariances is None else covariances.reshape(-1, 6, 6),
    )
    return poses if seen is None else poses[seen.ravel()]


def small_errors(rng: np.random.Generator, frames: int, places: int, scale: float = 1.0) -> np.ndarray:
    sigma = scale * np.repeat([np.radians(2.0), 0.008], 3)
    return sigma * rng.standard_normal((frames, places, 6))


def gross_errors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Errors of half a metre and a radian at least."""
    direction = rng.standard_normal((count, 2, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    size = np.stack([rng.uniform(1.0, 2.5, count), rng.uniform(0.5, 1.0, count)], axis=1)
    return (direction * size[..., None]).reshape(count, 6)


def transformed(T: RigidTransform, landmark_map: LandmarkMap) -> LandmarkMap:
    """The same landmarks in another world."""
    return LandmarkMap(
        tuple(
            Landmark(each.object_id, T * each.T_world_obj, each.instance, each.name, each.covariance, each.symmetry)
            for each in landmark_map
        )
    )
