"""Triangle meshes with a texture atlas, built from a few primitives; metres, z up, counter-clockwise outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Rect = tuple[float, float, float, float]
"""A patch of the atlas: (left, top, right, bottom) in [0, 1], v pointing down."""


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) m, unit normals (V, 3), uv (V, 2) with v down, faces (F, 3)."""

    vertices: Array
    normals: Array
    uv: Array
    faces: NDArray[np.int32]

    def moved(self, offset: tuple[float, float, float], rotation: Rotation | None = None) -> Mesh:
        """Return the mesh rotated, then shifted by offset (m)."""
        rotation = rotation or Rotation.identity()
        vertices = rotation.apply(self.vertices) + np.asarray(offset, float)
        return Mesh(vertices, rotation.apply(self.normals), self.uv, self.faces)

    def centred(self) -> Mesh:
        """Return the mesh with the middle of its bounding box at the origin."""
        middle = (self.vertices.min(0) + self.vertices.max(0)) / 2
        return Mesh(self.vertices - middle, self.normals, self.uv, self.faces)


def merge(parts: list[Mesh]) -> Mesh:
    """Return one mesh of several."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts)]).astype(np.int32),
    )


def box(size: tuple[float, float, float], rects: dict[str, Rect]) -> Mesh:
    """Return a box centred at the origin; rects name the atlas patch of its faces +x -x +y -y +z -z."""
    half = np.asarray(size, float) / 2
    # face: outward normal, direction of u, direction of v (down on the label)
    frames = {
        "+x": ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
        "-x": ((-1, 0, 0), (0, -1, 0), (0, 0, -1)),
        "+y": ((0, 1, 0), (-1, 0, 0), (0, 0, -1)),
        "-y": ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
        "+z": ((0, 0, 1), (0, 1, 0), (1, 0, 0)),
        "-z": ((0, 0, -1), (0, 1, 0), (-1, 0, 0)),
    }
    vertices: list[Array] = []
    normals: list[Array] = []
    uv: list[tuple[float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for name, (normal, along_u, along_v) in frames.items():
        left, top, right, bottom = rects[name]
        n, u, v = (np.asarray(axis, float) for axis in (normal, along_u, along_v))
        start = len(vertices)
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            vertices.append((n + a * u + b * v) * half)
            normals.append(n)
            uv.append((left if a < 0 else right, top if b < 0 else bottom))
        faces += [(start, start + 2, start + 1), (start, start + 3, start + 2)]
    return Mesh(np.array(vertices), np.array(normals), np.array(uv), np.array(faces, np.int32))


@dataclass(frozen=True)
class Section:
    """A cross-section of a loft: height z, half axes x and y (m), and the power of its superellipse (2: ellipse)."""

    z: float
    half_x: float
    half_y: float
    power: float = 2.0
    shift_x: float = 0.0


def loft(sections: list[Section], side: Rect, cap: Rect | None, segments: int = 40) -> Mesh:
    """Return the skin through sections from bottom to top, closed by flat caps unless cap is None.

    The label's left edge lies at angle pi (-x), its middle faces +x, and it reads from outside.
    """
    angles = np.linspace(-np.pi, np.pi, segments + 1)
    grid = np.array([_ring(section, angles) for section in sections])  # (K, S + 1, 3)
    normals = _loft_normals(grid)
    lengths = np.linalg.norm(np.diff(grid[:, segments // 2], axis=0), axis=1)
    height = np.concatenate([[0.0], np.cumsum(lengths)]) / max(lengths.sum(), 1e-9)
    left, top, right, bottom = side
    u = np.broadcast_to(left + (right - left) * np.arange(segments + 1) / segments, grid.shape[:2])
    v = np.broadcast_to((bottom + (top - bottom) * height)[:, None], grid.shape[:2])
    skin = Mesh(grid.reshape(-1, 3), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), _grid_faces(grid))
    if cap is None:
        return skin
    return merge([skin, _cap(grid[0, :-1], cap, up=False), _cap(grid[-1, :-1], cap, up=True)])


def revolve(profile: list[tuple[float, float]], side: Rect, cap: Rect | None, segments: int = 40) -> Mesh:
    """Return the surface of revolution of (radius, z) points from bottom to top, m."""
    return loft([Section(z, radius, radius) for radius, z in profile], side, cap, segments)


def tube(path: Array, radius: float, rect: Rect, segments: int = 10) -> Mesh:
    """Return a round tube along path (N, 3), m."""
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    helper = np.array([0.0, 1.0, 0.0])  # the paths here lie in the x-z plane
    side = np.cross(helper, tangents)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    normals = np.cos(angles)[None, :, None] * side[:, None] + np.sin(angles)[None, :, None] * helper
    grid = path[:, None] + radius * normals
    u = np.linspace(rect[0], rect[2], len(path))[:, None] + 0 * angles
    v = np.linspace(rect[1], rect[3], segments + 1)[None] + 0 * u
    faces = _grid_faces(grid)
    return Mesh(grid.reshape(-1, 3), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), faces)


def _ring(section: Section, angles: Array) -> Array:
    c, s = np.cos(angles), np.sin(angles)
    radius = (np.abs(c) ** section.power + np.abs(s) ** section.power) ** (-1.0 / section.power)
    x = section.shift_x + section.half_x * radius * c
    return np.stack([x, section.half_y * radius * s, np.full_like(x, section.z)], -1)


def _loft_normals(grid: Array) -> Array:
    around = np.roll(grid[:, :-1], -1, axis=1) - np.roll(grid[:, :-1], 1, axis=1)
    around = np.concatenate([around, around[:, :1]], axis=1)
    along = np.gradient(grid, axis=0)
    normals = np.cross(around, along)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)


def _grid_faces(grid: Array) -> NDArray[np.int32]:
    rows, columns = grid.shape[:2]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns + 1], -1)
    upper = np.stack([corner, corner + columns + 1, corner + columns], -1)
    return np.concatenate([lower, upper]).astype(np.int32)


def _cap(ring: Array, rect: Rect, up: bool) -> Mesh:
    count = len(ring)
    centre = ring.mean(0)
    vertices = np.concatenate([[centre], ring])
    spread = np.abs(ring - centre).max(0)[:2]
    flat = (vertices[:, :2] - centre[:2]) / np.maximum(spread, 1e-9)
    left, top, right, bottom = rect
    uv = np.stack(
        [(left + right) / 2 + flat[:, 0] * (right - left) / 2, (top + bottom) / 2 + flat[:, 1] * (bottom - top) / 2], -1
    )
    follow = np.arange(count)
    following = (follow + 1) % count
    pair = (1 + follow, 1 + following) if up else (1 + following, 1 + follow)
    faces = np.stack([np.zeros(count, int), *pair], -1).astype(np.int32)
    normals = np.tile([0.0, 0.0, 1.0 if up else -1.0], (count + 1, 1))
    return Mesh(vertices, normals, uv, faces)
