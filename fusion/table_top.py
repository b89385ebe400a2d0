"""The simulated table: objects on the plane z = 0 around the world's origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.simulation_options import Displacement
from poet_loc.core.geometry import make_pose, retract
from poet_loc.core.records import Landmark, LandmarkMap, Symmetry

Array = NDArray[np.float64]

_TABLE_RADIUS_M = 0.34


def table_top(objects: int, symmetric_objects: int, rng: np.random.Generator) -> LandmarkMap:
    """Return objects standing or lying on the table z = 0, spread over a disc; the last ones are symmetric."""
    places = _spread(objects, rng)
    landmarks = []
    for index, (x, y) in enumerate(places):
        symmetric = index >= objects - symmetric_objects
        can = symmetric and (objects - index) % 2 == 0
        height = rng.uniform(0.03, 0.12)
        lying = rng.random() < 0.3
        rotation = Rotation.from_euler("ZX", [rng.uniform(-np.pi, np.pi), np.pi / 2 if lying else 0.0])
        symmetry = Symmetry((0.0, 0.0, 1.0), "continuous" if can else 2) if symmetric else None
        name = f"{'can' if can else 'box'}_{index + 1}"
        landmarks.append(Landmark(index + 1, make_pose(rotation, [x, y, height]), name=name, symmetry=symmetry))
    return LandmarkMap(tuple(landmarks))


def _spread(count: int, rng: np.random.Generator) -> Array:
    """Return (count, 2) places in the table's disc, each the farthest of twenty draws from those before it."""
    places = np.empty((0, 2))
    for _ in range(count):
        radius, angle = _TABLE_RADIUS_M * np.sqrt(rng.random(20)), rng.uniform(-np.pi, np.pi, 20)
        draws = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        room = np.linalg.norm(draws[:, None] - places, axis=2).min(axis=1, initial=np.inf)
        places = np.vstack([places, draws[np.argmax(room)]])
    return places


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


def disturbed_map(
    true_map: LandmarkMap, position_sigma_m: float, rotation_sigma_deg: float, rng: np.random.Generator
) -> LandmarkMap:
    """Return the map with errors of these 1-sigmas per axis and their covariance; no sigma, no change."""
    sigma = np.repeat([np.radians(rotation_sigma_deg), position_sigma_m], 3)
    if not sigma.any():
        return true_map
    return LandmarkMap(
        tuple(
            Landmark(
                landmark.object_id,
                retract(landmark.T_world_obj, -sigma * rng.standard_normal(6)),
                landmark.instance,
                landmark.name,
                np.diag(sigma**2),
                landmark.symmetry,
            )
            for landmark in true_map
        )
    )
