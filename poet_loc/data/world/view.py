"""From a scene and a camera to an image, a depth map and masks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.data.world import labels
from poet_loc.data.world.objects import WorldObject, clutter, household_objects
from poet_loc.data.world.rasterizer import NEAR, cover
from poet_loc.data.world.shading import Light, Table, Textures, Things, shade

Array = NDArray[np.float64]

SURFACES = 96
"""Table tops and backgrounds that the world knows."""
_LEVELS = 6
_SHADOW_SIZE = 384
_TABLE_SHINE = 0.05


@dataclass(frozen=True)
class Assets:
    """Objects, clutter and surfaces, their textures packed into one array with mip levels."""

    objects: tuple[WorldObject, ...]
    clutter: tuple[WorldObject, ...]
    surfaces: tuple[labels.Image, ...]
    texels: NDArray[np.uint8]
    texture_table: NDArray[np.int64]
    """(T, levels, 3): start, width, height; objects first, then clutter, then surfaces."""

    def thing(self, index: int) -> WorldObject:
        """Return thing 0..: the objects, then the clutter."""
        return self.objects[index] if index < len(self.objects) else self.clutter[index - len(self.objects)]

    def surface_texture(self, index: int) -> int:
        """Return the texture number of a surface."""
        return len(self.objects) + len(self.clutter) + index


@lru_cache(maxsize=2)
def load_assets(seed: int = 0) -> Assets:
    """Return the world of a seed; it takes about two seconds and is kept."""
    objects, others = household_objects(seed), clutter(seed)
    surfaces = tuple(_surface(seed, index) for index in range(SURFACES))
    images = [thing.texture for thing in (*objects, *others)] + list(surfaces)
    parts: list[NDArray[np.uint8]] = []
    table = np.zeros((len(images), _LEVELS, 3), np.int64)
    start = 0
    for number, image in enumerate(images):
        for level in range(_LEVELS):
            table[number, level] = start, image.shape[1], image.shape[0]
            parts.append(image.reshape(-1))
            start += image.size
            image = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
    return Assets(objects, others, surfaces, np.concatenate(parts), table)


def _surface(seed: int, index: int) -> labels.Image:
    rng = np.random.default_rng([seed, 3, index])
    return labels.noise_texture(256, rng) if index % 2 else labels.scenery(256, rng)


@dataclass(frozen=True)
class Lights:
    """Light of a scene in linear rgb; directions are unit vectors in world axes that point towards the light."""

    sky: Array
    ground: Array
    towards_sun: Array
    sun: Array
    towards_fill: Array
    fill: Array


@dataclass(frozen=True)
class Scene:
    """Things on a table under lights; world z is up, the table top is z = 0."""

    things: tuple[int, ...]
    """Numbers of things (see Assets.thing)."""
    T_world_thing: RigidTransform
    gains: Array
    """(K, 3) colour gain of each thing."""
    lights: Lights
    table_surface: int
    table_half_size: float
    """m; 0: no table"""
    table_repeats: float
    backdrop_surface: int
    backdrop_gain: float
    turn: float = 0.0
    """Heading of the table, rad."""


@dataclass(frozen=True)
class Geometry:
    """The triangles of a scene in camera axes (m), and where its vertices fall in the image (pixels)."""

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    face_thing: NDArray[np.int32]
    """(F,) which of the scene's things, 0..K-1."""
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    inverse_depth: NDArray[np.float32]
    """(V,) 1/z, nan in front of the near plane."""


def place(
    assets: Assets, scene: Scene, T_cam_world: RigidTransform, intrinsics: tuple[float, float, float, float]
) -> Geometry:
    """Return the scene's triangles as a camera with (fx, fy, cx, cy) sees them."""
    meshes = [assets.thing(number).mesh for number in scene.things]
    T_cam_thing = T_cam_world * scene.T_world_thing
    rotation, shift = T_cam_thing.rotation.as_matrix(), T_cam_thing.translation
    points = np.concatenate([mesh.vertices @ R.T + t for mesh, R, t in zip(meshes, rotation, shift)]).astype(np.float32)
    normals = np.concatenate([mesh.normals @ R.T for mesh, R in zip(meshes, rotation)]).astype(np.float32)
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)]).astype(np.int32)
    face_thing = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]).astype(np.int32)
    uv = np.concatenate([mesh.uv for mesh in meshes]).astype(np.float32)
    fx, fy, cx, cy = intrinsics
    visible = points[:, 2] > NEAR
    inverse = np.where(visible, 1.0 / np.where(visible, points[:, 2], 1.0), np.nan).astype(np.float32)
    u = (fx * points[:, 0] * inverse + cx).astype(np.float32)
    v = (fy * points[:, 1] * inverse + cy).astype(np.float32)
    return Geometry(points, normals, uv, faces, face_thing, u, v, inverse)


def render_image(
    assets: Assets, scene: Scene, T_cam_world: RigidTransform, intrinsics: tuple[float, float, float, float],
    size: tuple[int, int], samples: int = 2,
) -> NDArray[np.float32]:  # fmt: skip
    """Return the (height, width, 3) image in linear light, about 0..1; size is (width, height), samples is per axis."""
    geometry = place(assets, scene, T_cam_world, intrinsics)
    width, height = size
    u, v = ((coordinate + 0.5) * samples - 0.5 for coordinate in (geometry.u, geometry.v))
    triangle, _ = cover(u, v, geometry.inverse_depth, geometry.faces, width * samples, height * samples)
    texture_of = np.array(scene.things, np.int32)
    shine = np.array([assets.thing(number).shine for number in scene.things], np.float32)
    gain = np.concatenate([scene.gains, shine[:, None]], 1).astype(np.float32)[geometry.face_thing]
    things = Things(
        geometry.points, geometry.normals, geometry.uv, geometry.faces, texture_of[geometry.face_thing],
        _mip_levels(geometry, assets, texture_of), gain,
    )  # fmt: skip
    return shade(
        triangle, samples, np.asarray(intrinsics, np.float32), things, _table(assets, scene, T_cam_world),
        Textures(assets.texels, assets.texture_table, _LINEAR), _light(geometry, scene, T_cam_world),
        _backdrop(assets, scene, size),
    )  # fmt: skip


def depth_and_things(geometry: Geometry, size: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return depth (m, inf where no thing is) and the thing's place in the scene (-1: none) at the pixel centres."""
    triangle, inverse = cover(geometry.u, geometry.v, geometry.inverse_depth, geometry.faces, *size)
    thing = np.where(triangle >= 0, geometry.face_thing[np.maximum(triangle, 0)], -1).astype(np.int32)
    with np.errstate(divide="ignore"):
        depth = np.where(triangle >= 0, 1.0 / inverse, np.inf).astype(np.float32)
    return depth, thing


def silhouette(geometry: Geometry, thing: int, canvas: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Return the mask of one thing alone on a canvas (left, top, width, height), px, which may exceed the image."""
    faces = geometry.faces[geometry.face_thing == thing]
    left, top, width, height = canvas
    triangle, _ = cover(geometry.u - left, geometry.v - top, geometry.inverse_depth, faces, width, height)
    return triangle >= 0


_LINEAR = ((np.arange(256) / 255.0) ** 2.2).astype(np.float32)


def _mip_levels(geometry: Geometry, assets: Assets, texture_of: NDArray[np.int32]) -> NDArray[np.int32]:
    """(F,) mip level at which a texel is about a pixel wide."""
    a, b, c = geometry.faces.T

    def area(x: NDArray, y: NDArray) -> NDArray:
        return np.abs((x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])) + 1e-9

    texels = (
        area(geometry.uv[:, 0], geometry.uv[:, 1]) * assets.texture_table[texture_of[geometry.face_thing], 0, 1] ** 2
    )
    pixels = np.nan_to_num(area(geometry.u, geometry.v), nan=1e9)
    level = np.floor(0.5 * np.log2(texels / pixels) + 0.3)
    return np.clip(level, 0, _LEVELS - 1).astype(np.int32)


def _lights_in_camera(lights: Lights, R_cam_world: Rotation) -> NDArray[np.float32]:
    up, sun, fill = R_cam_world.apply(np.stack([[0, 0, 1.0], lights.towards_sun, lights.towards_fill]))
    return np.stack([up, lights.sky, lights.ground, sun, lights.sun, fill, lights.fill]).astype(np.float32)


def _light(geometry: Geometry, scene: Scene, T_cam_world: RigidTransform) -> Light:
    """Return the lights with the sun's shadow map."""
    away = -T_cam_world.rotation.apply(scene.lights.towards_sun)
    right = np.cross(away, [0.3, 0.2, 1.0] if abs(away[2]) < 0.9 else [1.0, 0.0, 0.1])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(away, right), away])
    x, y, depth = axes @ geometry.points.T.astype(float)
    span = max(np.ptp(x), np.ptp(y)) + 0.02
    scale = (_SHADOW_SIZE - 8) / span
    start_x, start_y = x.min() - 4 / scale, y.min() - 4 / scale
    light_u, light_v = ((x - start_x) * scale).astype(np.float32), ((y - start_y) * scale).astype(np.float32)
    _, buffer = cover(light_u, light_v, (-depth).astype(np.float32), geometry.faces, _SHADOW_SIZE, _SHADOW_SIZE)
    bias = 2.5 / scale + 0.002
    frame = np.array([start_x, start_y, scale, bias], np.float32)
    colours = _lights_in_camera(scene.lights, T_cam_world.rotation)
    return Light(colours, buffer, axes.astype(np.float32), frame)


def _table(assets: Assets, scene: Scene, T_cam_world: RigidTransform) -> Table:
    axes_world = Rotation.from_euler("z", scene.turn).as_matrix().T
    axes = np.concatenate([T_cam_world.translation[None], T_cam_world.rotation.apply(axes_world)]).astype(np.float32)
    numbers = np.array([scene.table_half_size, scene.table_repeats, _TABLE_SHINE], np.float32)
    return Table(assets.surface_texture(scene.table_surface), numbers, axes)


def _backdrop(assets: Assets, scene: Scene, size: tuple[int, int]) -> NDArray[np.float32]:
    surface = assets.surfaces[scene.backdrop_surface]
    return _LINEAR[cv2.resize(surface, size, interpolation=cv2.INTER_LINEAR)] * np.float32(scene.backdrop_gain)
