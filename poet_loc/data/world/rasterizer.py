"""A small rasteriser on numba: which triangle a sample of the image shows, by a z-buffer.

Pixel (0, 0) is centred at (0, 0), as in BOP. Camera axes are OpenCV's. Triangles must lie in front of the near
plane as a whole.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float32]

NEAR = 0.02
"""Triangles with a corner nearer than this (m) are left out."""


@njit(cache=True, fastmath=False)
def rasterize(
    u: Array,
    v: Array,
    weight: Array,
    faces: NDArray[np.int32],
    width: int,
    height: int,
    triangle: NDArray[np.int32],
    buffer: Array,
) -> None:
    """Write, for each sample of a (height, width) grid, the triangle with the largest interpolated weight.

    u, v are sample coordinates of the vertices; weight is 1/z for a perspective image and minus the depth for a
    parallel one: both are linear over the screen. triangle starts as -1, buffer as -inf. A vertex with weight
    nan is left out.
    """
    for index in range(faces.shape[0]):
        a, b, c = faces[index, 0], faces[index, 1], faces[index, 2]
        ua, va, ub, vb, uc, vc = u[a], v[a], u[b], v[b], u[c], v[c]
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        wa, wb, wc = weight[a], weight[b], weight[c]
        if area == 0.0 or np.isnan(wa + wb + wc):
            continue
        left, right = max(int(np.ceil(min(ua, ub, uc))), 0), min(int(np.floor(max(ua, ub, uc))), width - 1)
        top, bottom = max(int(np.ceil(min(va, vb, vc))), 0), min(int(np.floor(max(va, vb, vc))), height - 1)
        scale = 1.0 / area
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                share_b = ((x - ua) * (vc - va) - (uc - ua) * (y - va)) * scale
                share_c = ((ub - ua) * (y - va) - (x - ua) * (vb - va)) * scale
                if share_b < 0.0 or share_c < 0.0 or share_b + share_c > 1.0:
                    continue
                value = wa + share_b * (wb - wa) + share_c * (wc - wa)
                if value > buffer[y, x]:
                    buffer[y, x] = value
                    triangle[y, x] = index


def cover(
    u: Array, v: Array, weight: Array, faces: NDArray[np.int32], width: int, height: int
) -> tuple[NDArray[np.int32], Array]:
    """Return (triangle index or -1, weight) of each sample of a (height, width) grid."""
    triangle = np.full((height, width), -1, np.int32)
    buffer = np.full((height, width), -np.inf, np.float32)
    rasterize(u, v, weight, faces, width, height, triangle, buffer)
    return triangle, buffer


def distance_image(
    points: NDArray[np.float64],
    faces: NDArray[np.int32],
    camera: NDArray[np.float64],
    window: tuple[int, int, int, int],
) -> NDArray[np.float64]:
    """Return how far from the camera's centre the nearest triangle is at each pixel, m, 0 where there is none.

    points (V, 3) in camera axes, m; camera matrix (3, 3); window left, top, width, height in pixels -> (height, width).
    """
    left, top, width, height = window
    inverse = 1.0 / np.where(points[:, 2] > NEAR, points[:, 2], np.nan)
    pixels = (points @ camera.T)[:, :2] * inverse[:, None] - [left, top]
    u, v, weight = np.column_stack([pixels, inverse]).astype(np.float32).T.copy()
    triangle, weight_seen = cover(u, v, weight, faces, width, height)
    columns, rows = np.meshgrid(np.arange(width) + left, np.arange(height) + top)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera).T
    return np.where(triangle >= 0, np.linalg.norm(rays, axis=-1) / np.where(triangle >= 0, weight_seen, 1.0), 0.0)
