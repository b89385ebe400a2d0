"""A small rasteriser on numba: z-buffer, perspective-correct textures with mip levels, shadow map, shading.

Pixel (0, 0) is centred at (0, 0), as in BOP. Camera axes are OpenCV's. Triangles must lie in front of the near
plane as a whole; the table is a plane met by a ray, so it never needs clipping.
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


@njit(cache=True, inline="always")
def _texel(
    texels: NDArray[np.uint8], start: int, size_u: int, size_v: int, x: float, y: float, linear: Array, out: Array
) -> None:
    """Bilinear sample of one stored image at (x, y) in texels, centres at .5, edges held; linear light into out."""
    x, y = min(max(x - 0.5, 0.0), size_u - 1.001), min(max(y - 0.5, 0.0), size_v - 1.001)
    column, row = int(x), int(y)
    fx, fy = np.float32(x - column), np.float32(y - row)
    base = start + 3 * (row * size_u + column)
    right = 3 if size_u > 1 else 0
    down = 3 * size_u if size_v > 1 else 0
    for k in range(3):
        upper = linear[texels[base + k]] * (1 - fx) + linear[texels[base + right + k]] * fx
        lower = linear[texels[base + down + k]] * (1 - fx) + linear[texels[base + down + right + k]] * fx
        out[k] = upper * (1 - fy) + lower * fy


@njit(cache=True, inline="always")
def _lit(point: Array, shadow: Array, light_axes: Array, light_frame: Array) -> float:
    """Share of light at a point, 3x3 percentage-closer filtering of the shadow map.

    light_axes rows are right, down, away from the light; light_frame is (offset u, offset v, samples per m, bias m).
    """
    size = shadow.shape[0]
    x = (
        light_axes[0, 0] * point[0] + light_axes[0, 1] * point[1] + light_axes[0, 2] * point[2] - light_frame[0]
    ) * light_frame[2]
    y = (
        light_axes[1, 0] * point[0] + light_axes[1, 1] * point[1] + light_axes[1, 2] * point[2] - light_frame[1]
    ) * light_frame[2]
    away = light_axes[2, 0] * point[0] + light_axes[2, 1] * point[1] + light_axes[2, 2] * point[2]
    column, row = int(np.floor(x)), int(np.floor(y))
    if column < 1 or row < 1 or column > size - 4 or row > size - 4:
        return 1.0
    limit = -(away - light_frame[3])
    fx, fy = x - column, y - row
    total = 0.0
    for dy in range(-1, 3):  # a 4x4 patch with linear weights at its rim moves smoothly
        wy = 1 - fy if dy == -1 else fy if dy == 2 else 1.0
        for dx in range(-1, 3):
            wx = 1 - fx if dx == -1 else fx if dx == 2 else 1.0
            if shadow[row + dy, column + dx] <= limit:
                total += wx * wy
    return total / 9.0


@njit(cache=True, inline="always")
def _illuminate(
    albedo: Array, normal: Array, point: Array, lights: Array, lit: float, shine: float, out: Array
) -> None:
    """Lambert and Blinn-Phong under a sky, a sun with shadow and a fill light; point and normal in camera axes.

    lights rows: (up, -), (sky rgb), (ground rgb), (towards sun), (sun rgb), (towards fill), (fill rgb).
    """
    reach = np.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
    up = 0.5 + 0.5 * (normal[0] * lights[0, 0] + normal[1] * lights[0, 1] + normal[2] * lights[0, 2])
    sun = max(normal[0] * lights[3, 0] + normal[1] * lights[3, 1] + normal[2] * lights[3, 2], 0.0) * lit
    fill = max(normal[0] * lights[5, 0] + normal[1] * lights[5, 1] + normal[2] * lights[5, 2], 0.0)
    hx, hy, hz = lights[3, 0] - point[0] / reach, lights[3, 1] - point[1] / reach, lights[3, 2] - point[2] / reach
    half = np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-9
    gloss = max((normal[0] * hx + normal[1] * hy + normal[2] * hz) / half, 0.0) ** 40 * shine * lit
    for k in range(3):
        light = lights[2, k] + (lights[1, k] - lights[2, k]) * up + lights[4, k] * sun + lights[6, k] * fill
        out[k] = albedo[k] * light + lights[4, k] * gloss


@njit(cache=True)
def _meet_triangle(
    corners: NDArray[np.int32],
    ray_x: float,
    ray_y: float,
    points: Array,
    normals: Array,
    uv: Array,
    point: Array,
    normal: Array,
) -> tuple[float, float]:
    """Put the point where the ray (ray_x, ray_y, 1) meets a triangle and its normal, return its texture coordinates.

    Cramer's rule on share_a A + share_b B + share_c C = depth ray; the shares add up to one.
    """
    a, b, c = corners[0], corners[1], corners[2]
    share_a, share_b, share_c = (
        _volume(points[b], points[c], ray_x, ray_y),
        _volume(points[c], points[a], ray_x, ray_y),
        _volume(points[a], points[b], ray_x, ray_y),
    )
    total = share_a + share_b + share_c
    share_a, share_b, share_c = share_a / total, share_b / total, share_c / total
    length, facing = 0.0, 0.0
    for k in range(3):
        point[k] = share_a * points[a, k] + share_b * points[b, k] + share_c * points[c, k]
        normal[k] = share_a * normals[a, k] + share_b * normals[b, k] + share_c * normals[c, k]
        length += normal[k] * normal[k]
        facing += normal[k] * point[k]
    scale = (-1.0 if facing > 0 else 1.0) / np.sqrt(length + 1e-12)  # thin walls are seen from both sides
    for k in range(3):
        normal[k] *= scale
    s = share_a * uv[a, 0] + share_b * uv[b, 0] + share_c * uv[c, 0]
    t = share_a * uv[a, 1] + share_b * uv[b, 1] + share_c * uv[c, 1]
    return s, t


@njit(cache=True, inline="always")
def _volume(p: Array, q: Array, ray_x: float, ray_y: float) -> float:
    return (p[1] * q[2] - p[2] * q[1]) * ray_x + (p[2] * q[0] - p[0] * q[2]) * ray_y + (p[0] * q[1] - p[1] * q[0])


@njit(cache=True)
def _meet_table(ray_x: float, ray_y: float, half: float, axes: Array, point: Array) -> tuple[bool, float, float, float]:
    """Put the point where a ray meets the table top; return whether it does, x and y on the table (m), and the slope.

    axes (4, 3) = origin, x, y, normal in camera axes.
    """
    slope = ray_x * axes[3, 0] + ray_y * axes[3, 1] + axes[3, 2]
    if slope >= 0:
        return False, 0.0, 0.0, slope
    depth = (axes[0, 0] * axes[3, 0] + axes[0, 1] * axes[3, 1] + axes[0, 2] * axes[3, 2]) / slope
    point[0], point[1], point[2] = ray_x * depth, ray_y * depth, depth
    s, t = 0.0, 0.0
    for k in range(3):
        s += (point[k] - axes[0, k]) * axes[1, k]
        t += (point[k] - axes[0, k]) * axes[2, k]
    return depth > 0 and abs(s) < half and abs(t) < half, s, t, slope


@njit(cache=True)
def shade(
    triangle: NDArray[np.int32], factor: int, intrinsics: Array, points: Array, normals: Array, uv: Array,
    faces: NDArray[np.int32], face_texture: NDArray[np.int32], face_level: NDArray[np.int32], face_gain: Array,
    texels: NDArray[np.uint8], texture_table: NDArray[np.int64], linear: Array, lights: Array, shadow: Array,
    light_axes: Array, light_frame: Array, table: Array, table_axes: Array, backdrop: Array, image: Array,
) -> None:  # fmt: skip
    """Add to a (H, W, 3) image in linear light factor x factor samples a pixel, one shading per triangle and pixel.

    points, normals (V, 3) in camera axes; face_gain (F, 4) rgb gain and shine; texture_table (T, levels, 3) start,
    width, height; table (4,) = texture, half size m (0: none), repeats, shine; table_axes as in `_meet_table`.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    albedo, color = np.zeros(3, np.float32), np.zeros(3, np.float32)
    point, normal = np.zeros(3, np.float32), np.zeros(3, np.float32)
    half, repeats, texture = table[1], table[2], int(table[0])
    texels_per_m = repeats * texture_table[texture, 0, 1] / max(2 * half, 1e-3)
    weight = np.float32(1.0 / (factor * factor))
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            last = -2
            for sub in range(factor * factor):
                row, column = y * factor + sub // factor, x * factor + sub % factor
                index = triangle[row, column]
                if index != last:
                    last = index
                    ray_x, ray_y = ((column + 0.5) / factor - 0.5 - cx) / fx, ((row + 0.5) / factor - 0.5 - cy) / fy
                    hit, shine = True, table[3]
                    if index >= 0:
                        s, t = _meet_triangle(faces[index], ray_x, ray_y, points, normals, uv, point, normal)
                        start, size_u, size_v = texture_table[face_texture[index], face_level[index]]
                        _texel(texels, start, size_u, size_v, s * size_u, t * size_v, linear, albedo)
                        albedo *= face_gain[index, :3]
                        shine = face_gain[index, 3]
                    else:
                        hit, s, t, slope = _meet_table(ray_x, ray_y, half, table_axes, point)
                        if hit:
                            footprint = point[2] / fx * texels_per_m / max(-slope, 0.2)
                            level = min(max(int(np.log2(max(footprint, 0.1)) + 0.3), 0), texture_table.shape[1] - 1)
                            s, t = (s / half + 1) * 0.5 * repeats, (t / half + 1) * 0.5 * repeats
                            start, size_u, size_v = texture_table[texture, level]
                            _texel(
                                texels,
                                start,
                                size_u,
                                size_v,
                                (s - np.floor(s)) * size_u,
                                (t - np.floor(t)) * size_v,
                                linear,
                                albedo,
                            )
                            normal[:] = table_axes[3]
                    if hit:
                        _illuminate(
                            albedo, normal, point, lights, _lit(point, shadow, light_axes, light_frame), shine, color
                        )
                    else:
                        color[:] = backdrop[y, x]
                for k in range(3):
                    image[y, x, k] += color[k] * weight
