"""Coloured points on the surfaces of BOP models, for the refiner's views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.io.bop_models import models_of
from poet_loc.io.ply import ColouredMesh, read_coloured_mesh

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_BLUR = 9
"""Texels that a point stands for, per side."""

_GRAY = 128


def coloured_points(folder: Path, count: int, object_ids: Sequence[int] = ()) -> tuple[Array, Bytes, Array]:
    """Return points (C, count, 3) m, colours (C, count, 3) RGB and diameters (C,) m of a models folder's objects.

    In the order that is named, else all by number.
    Points are spread evenly over each surface; colours are those of texture or vertices, gray where there are none.
    The same folder gives the same points.  Raises InputError for what cannot be read.
    """
    info = models_of(folder / "models_info.json", object_ids)
    points, colours = [], []
    for number in info:
        mesh = read_coloured_mesh(folder / f"obj_{number:06d}.ply")
        corners, shares = spread_over(mesh.vertices, mesh.triangles, count, np.random.default_rng(number))
        points.append(blend(mesh.vertices, corners, shares))
        colours.append(_colours(mesh, corners, shares))
    return np.stack(points), np.stack(colours), np.array([model.diameter_m for model in info.values()])


def spread_over(
    vertices: Array, triangles: NDArray[np.int32], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int32], Array]:
    """Return corners (count, 3) and barycentric shares (count, 3) of random points, as many per area everywhere."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    cut = np.sort(rng.random((count, 2)), axis=1)  # two cuts of a unit length give barycentric shares
    return triangles[chosen], np.stack([cut[:, 0], cut[:, 1] - cut[:, 0], 1 - cut[:, 1]], -1)


def blend(values: Array, corners: NDArray[np.int32], shares: Array) -> Array:
    """Return values of vertices (V, n) at points given by corners (K, 3) and shares (K, 3)."""
    return np.asarray(np.einsum("kc,kcn->kn", shares, values[corners]))


def _colours(mesh: ColouredMesh, corners: NDArray[np.int32], shares: Array) -> Bytes:
    if mesh.texture is None or mesh.texture_places is None:
        known = np.full(mesh.vertices.shape, _GRAY) if mesh.colours is None else mesh.colours
        return np.rint(blend(known.astype(float), corners, shares)).astype(np.uint8)
    image = cv2.imread(str(mesh.texture), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError("is missing or no image", path=mesh.texture, fix="give the model's texture")
    smooth, (height, width) = cv2.blur(image, (_BLUR, _BLUR))[..., ::-1], image.shape[:2]
    places = blend(mesh.texture_places, corners, shares)
    column = np.clip((places[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1.0 - places[:, 1]) * height).astype(int), 0, height - 1)
    return np.asarray(smooth[row, column], np.uint8)
