"""Shading on numba: perspective-correct textures with mip levels, a shadow map, three lights.

The table is a plane met by a ray, so it never needs clipping.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float32]

# counting references to the arrays in tuples would cost a third of the time; numba does not say that it can be left out
_UNCOUNTED: dict[str, Any] = {"cache": True, "_nrt": False}
kernel = njit(**_UNCOUNTED)
inlined = njit(**_UNCOUNTED, inline="always")


class Things(NamedTuple):
    """The triangles of the things in camera axes."""

    points: Array  # (V, 3) m
    normals: Array  # (V, 3)
    uv: Array  # (V, 2)
    faces: NDArray[np.int32]  # (F, 3)
    texture: NDArray[np.int32]  # (F,)
    level: NDArray[np.int32]  # (F,) of the texture's mip levels
    gain: Array  # (F, 4) rgb gain and shine


class Textures(NamedTuple):
    """All images with their mip levels in one array."""

    texels: NDArray[np.uint8]
    table: NDArray[np.int64]  # (T, levels, 3) start, width, height
    linear: Array  # (256,) linear light of a stored value


class Light(NamedTuple):
    """The lights in camera axes and the shadow of the sun."""

    colours: Array  # (7, 3) (up), (sky rgb), (ground rgb), (towards sun), (sun rgb), (towards fill), (fill rgb)
    shadow: Array  # (N, N) minus the distance from the light of what is nearest to it, m
    axes: Array  # (3, 3) right, down, away from the sun
    frame: Array  # (4,) offset u, offset v, samples per m, bias m


class Table(NamedTuple):
    """The table top, a square."""

    texture: int
    numbers: Array  # (3,) half its size, m, 0: none; how often the texture repeats along a side; shine
    axes: Array  # (4, 3) origin, x, y, normal in camera axes


class Met(NamedTuple):
    """What a ray met, in camera axes."""

    point: Array  # (3,) m
    normal: Array  # (3,)
    albedo: Array  # (3,)
    colour: Array  # (3,) linear light that comes from there


@inlined
def _texel(textures: Textures, texture: int, level: int, s: float, t: float, out: Array) -> None:
    """Bilinear sample of one stored image at (s, t) in 0..1, texel centres at .5, edges held; linear light into out."""
    texels, linear = textures.texels, textures.linear
    start, size_u, size_v = textures.table[texture, level]
    x, y = s * size_u, t * size_v
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


@inlined
def _lit(point: Array, light: Light) -> float:
    """Share of light at a point, 3x3 percentage-closer filtering of the shadow map."""
    shadow, light_axes, light_frame = light.shadow, light.axes, light.frame
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


@inlined
def _illuminate(met: Met, light: Light, shine: float) -> None:
    """Lambert and Blinn-Phong under a sky, a sun with shadow and a fill light."""
    albedo, normal, point, lights, lit = met.albedo, met.normal, met.point, light.colours, _lit(met.point, light)
    reach = np.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
    up = 0.5 + 0.5 * (normal[0] * lights[0, 0] + normal[1] * lights[0, 1] + normal[2] * lights[0, 2])
    sun = max(normal[0] * lights[3, 0] + normal[1] * lights[3, 1] + normal[2] * lights[3, 2], 0.0) * lit
    fill = max(normal[0] * lights[5, 0] + normal[1] * lights[5, 1] + normal[2] * lights[5, 2], 0.0)
    hx, hy, hz = lights[3, 0] - point[0] / reach, lights[3, 1] - point[1] / reach, lights[3, 2] - point[2] / reach
    half = np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-9
    gloss = max((normal[0] * hx + normal[1] * hy + normal[2] * hz) / half, 0.0) ** 40 * shine * lit
    for k in range(3):
        light = lights[2, k] + (lights[1, k] - lights[2, k]) * up + lights[4, k] * sun + lights[6, k] * fill
        met.colour[k] = albedo[k] * light + lights[4, k] * gloss


@kernel
def _meet_triangle(index: int, ray_x: float, ray_y: float, things: Things, met: Met) -> tuple[float, float]:
    """Put the point where the ray (ray_x, ray_y, 1) meets a triangle and its normal, return its texture coordinates.

    Cramer's rule on share_a A + share_b B + share_c C = depth ray; the shares add up to one.
    """
    points, normals, uv, point, normal = things.points, things.normals, things.uv, met.point, met.normal
    a, b, c = things.faces[index, 0], things.faces[index, 1], things.faces[index, 2]
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


@inlined
def _volume(p: Array, q: Array, ray_x: float, ray_y: float) -> float:
    return (p[1] * q[2] - p[2] * q[1]) * ray_x + (p[2] * q[0] - p[0] * q[2]) * ray_y + (p[0] * q[1] - p[1] * q[0])


@kernel
def _meet_table(ray_x: float, ray_y: float, table: Table, point: Array) -> tuple[bool, float, float, float]:
    """Put the point where a ray meets the table top; return whether it does, where on the table (m), and the slope."""
    half, axes = table.numbers[0], table.axes
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


@inlined
def _look_at_thing(index: int, ray_x: float, ray_y: float, things: Things, textures: Textures, met: Met) -> float:
    """Put what a ray meets on a triangle, return its shine."""
    s, t = _meet_triangle(index, ray_x, ray_y, things, met)
    _texel(textures, things.texture[index], things.level[index], s, t, met.albedo)
    for k in range(3):
        met.albedo[k] *= things.gain[index, k]
    return things.gain[index, 3]


@inlined
def _look_at_table(ray_x: float, ray_y: float, focal: float, table: Table, textures: Textures, met: Met) -> bool:
    """Put what a ray meets on the table; False: it meets nothing."""
    hit, s, t, slope = _meet_table(ray_x, ray_y, table, met.point)
    if not hit:
        return False
    half, repeats, sizes = table.numbers[0], table.numbers[1], textures.table
    texels_per_m = repeats * sizes[table.texture, 0, 1] / max(2 * half, 1e-3)
    footprint = met.point[2] / focal * texels_per_m / max(-slope, 0.2)
    level = min(max(int(np.log2(max(footprint, 0.1)) + 0.3), 0), sizes.shape[1] - 1)
    s, t = (s / half + 1) * 0.5 * repeats, (t / half + 1) * 0.5 * repeats
    _texel(textures, table.texture, level, s - np.floor(s), t - np.floor(t), met.albedo)
    for k in range(3):
        met.normal[k] = table.axes[3, k]
    return True


def shade(
    triangle: NDArray[np.int32],
    factor: int,
    intrinsics: Array,
    things: Things,
    table: Table,
    textures: Textures,
    light: Light,
    backdrop: Array,
) -> Array:
    """Return a (H, W, 3) image in linear light of factor x factor samples a pixel, one shading per triangle and pixel.

    triangle (factor H, factor W) is what each sample shows, -1 where no thing is; intrinsics fx, fy, cx, cy, px;
    backdrop (H, W, 3) is seen beside the table.
    """
    image = np.zeros_like(backdrop)
    met = Met(*np.zeros((4, 3), np.float32))
    _shade(triangle, factor, intrinsics, things, table, textures, light, backdrop, met, image)
    return image


@kernel
def _shade(
    triangle: NDArray[np.int32],
    factor: int,
    intrinsics: Array,
    things: Things,
    table: Table,
    textures: Textures,
    light: Light,
    backdrop: Array,
    met: Met,
    image: Array,
) -> None:
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
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
                    seen, shine = True, table.numbers[2]
                    if index >= 0:
                        shine = _look_at_thing(index, ray_x, ray_y, things, textures, met)
                    else:
                        seen = _look_at_table(ray_x, ray_y, fx, table, textures, met)
                    if seen:
                        _illuminate(met, light, shine)
                    else:
                        for k in range(3):
                            met.colour[k] = backdrop[y, x, k]
                for k in range(3):
                    image[y, x, k] += met.colour[k] * weight
