"""How much of an object's visible surface a pose gets right: BOP's VSD, by a depth renderer."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.input_error import InputError
from poet_loc.core.symmetric_errors import vsd
from poet_loc.io.bop import BopScene, read_bop_scene
from poet_loc.io.ply import read_model_mesh

Array = NDArray[np.float64]
Window = tuple[int, int, int, int]
"""Left, top, width, height in pixels."""
SurfaceSource = Literal["none", "depth", "rendered"]

_MM_PER_M = 1000.0


class VisibleSurface:
    """Measures poses against what a BOP split's cameras saw.

    source depth: the split's depth images, as the benchmark does; rendered: the true poses of all annotated objects,
    for splits without depth images, where only objects hide each other.  The scene read last is kept, and its last
    image, so ask image by image.
    """

    def __init__(self, split: Path, models: Path, source: SurfaceSource) -> None:
        self.split, self.models, self.source = split, models, source
        self._mesh = lru_cache(None)(lambda number: read_model_mesh(models / f"obj_{number:06d}.ply"))
        self._scene = lru_cache(1)(lambda number: read_bop_scene(split / folder_name(split, number)))
        self._seen = lru_cache(1)(self._read_scene_distance if source == "depth" else self._render_scene)

    def errors(
        self, place: tuple[int, int], number: int, est: RigidTransform, ref: RigidTransform, taus: ArrayLike
    ) -> Array:
        """Return VSD (T,) of an estimated pose T_cam_obj for tolerances (T,) in m.

        place is scene and image, number the object.  Raises InputError where a depth image or a model is missing.
        """
        seen, camera = self._seen(*place), self._camera(*place)
        window = self._window([est, ref], number, camera, seen.shape)
        if window is None:
            return np.ones(np.shape(taus))
        left, top, width, height = window
        part = seen[top : top + height, left : left + width]
        shown = [self._distance(T, number, camera, window) for T in (est, ref)]
        return vsd(shown[0], shown[1], part, taus)

    def _camera(self, scene: int, image: int) -> Array:
        found: BopScene = self._scene(scene)
        return np.asarray(found.camera_matrices[np.searchsorted(found.image_ids, image)])

    def _distance(self, T_cam_obj: RigidTransform, number: int, camera: Array, window: Window) -> Array:
        from poet_loc.data.world.rasterizer import distance_image

        points, faces = self._mesh(number)
        return distance_image(T_cam_obj.apply(points), faces, camera, window)

    def _window(self, poses: list[RigidTransform], number: int, camera: Array, shape: tuple[int, ...]) -> Window | None:
        """Return the part of the image that holds the object in all poses; None where it is outside."""
        points = np.concatenate([T.apply(self._mesh(number)[0]) for T in poses])
        rays = points[points[:, 2] > 0] @ camera.T
        if len(rays) == 0:
            return None
        pixels = rays[:, :2] / rays[:, 2:]
        low = np.clip(np.floor(pixels.min(axis=0)), 0, None)
        high = np.minimum(np.ceil(pixels.max(axis=0)), [shape[1] - 1, shape[0] - 1])
        if (high < low).any():
            return None
        width, height = (high - low + 1).astype(int).tolist()
        return int(low[0]), int(low[1]), width, height

    def _read_scene_distance(self, scene: int, image: int) -> Array:
        from PIL import Image

        found, folder = self._scene(scene), self.split / folder_name(self.split, scene)
        path = next(iter(sorted((folder / "depth").glob(f"{image:06d}.*"))), folder / "depth" / f"{image:06d}.png")
        if found.depth_scales is None:
            raise InputError("has no depth_scale", path=folder / "scene_camera.json", fix="--vsd rendered needs none")
        try:
            with Image.open(path) as content:
                raw = np.asarray(content, float)
        except FileNotFoundError:
            raise InputError("no such depth image", path=path, fix="--vsd rendered needs none") from None
        except (OSError, ValueError, SyntaxError) as error:
            raise InputError(f"not a whole depth image ({type(error).__name__})", path=path) from None
        depth = raw * (found.depth_scales[np.searchsorted(found.image_ids, image)] / _MM_PER_M)
        return np.asarray(depth * ray_lengths(self._camera(scene, image), depth.shape))

    def _render_scene(self, scene: int, image: int) -> Array:
        """Return the nearest surface of all annotated objects of an image; its size is that of the scene's images."""
        rows, camera = self._scene(scene).annotations, self._camera(scene, image)
        assert rows is not None  # the true poses were read from there
        width, height = image_size(self.split / folder_name(self.split, scene))
        nearest = np.full((height, width), np.inf)
        for row in np.flatnonzero(rows.image_ids == image):
            distance = self._distance(rows.T_cam_obj[row], int(rows.object_ids[row]), camera, (0, 0, width, height))
            nearest = np.minimum(nearest, np.where(distance > 0, distance, np.inf))
        return np.where(np.isfinite(nearest), nearest, 0.0)


def ray_lengths(camera: Array, shape: tuple[int, ...]) -> Array:
    """Return how long the ray to each pixel of an image (h, w) is at depth 1."""
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera).T
    return np.asarray(np.linalg.norm(rays, axis=-1))


def image_size(folder: Path) -> tuple[int, int]:
    """Return (width, height) px of a scene's images; 640 x 480 where there are none."""
    from PIL import Image

    for name in ("rgb", "gray", "depth"):
        for path in sorted((folder / name).glob("*"))[:1]:
            with Image.open(path) as image:
                return int(image.size[0]), int(image.size[1])
    return 640, 480


def folder_name(split: Path, scene: int) -> str:
    """Return the name of a scene's folder in a split, whatever zeros it starts with."""
    return next((p.name for p in split.glob("*") if p.name.isdigit() and int(p.name) == scene), f"{scene:06d}")
