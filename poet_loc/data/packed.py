"""BOP scenes packed for quick training: image files in one piece, half-size depth and instances, exact augmentation.

Turning the camera about its optical axis, zooming and shifting the image are all one homography K' R K^-1 that changes
the poses exactly, so the augmented image is one that a real camera could have taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.data.bop_dataset import image_path
from poet_loc.data.coloured_points import blend, spread_over
from poet_loc.io.bop import BopAnnotations, BopScene, read_bop_scene
from poet_loc.io.bop_models import models_of
from poet_loc.io.ply import read_model_mesh

Array = NDArray[np.float64]

SHRINK = 2
"""Pixels per cell of the packed depth and instance maps."""


@dataclass(frozen=True)
class ObjectModels:
    """What training has to know about the shapes: points for boxes and errors, size, symmetry."""

    points: Array
    """(C, P, 3) vertices of classes 1..C, m; their outline gives boxes."""
    surface: Array
    """(C, S, 3) points spread evenly over the surface, m, for errors."""
    diameters: Array
    """(C,) m."""
    symmetry_axes: Array
    """(C, 3) axis of a continuous symmetry, zero where there is none."""
    object_ids: tuple[int, ...]
    """(C,) BOP's number of classes 1..C."""

    def classes_of(self, object_ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the class of each object, 0 where it is none of these."""
        class_of = {number: label for label, number in enumerate(self.object_ids, start=1)}
        return np.array([class_of.get(number, 0) for number in object_ids.tolist()], np.int64)


@dataclass(frozen=True)
class PackedScene:
    """One packed scene folder, mapped from disk."""

    jpegs: NDArray[np.uint8]
    jpeg_starts: NDArray[np.int64]
    """(N + 1,)"""
    depth: NDArray[np.uint16]
    """(N, h, w) 0.1 mm; 0: nothing. (N, 0, 0) where it was packed without."""
    instance: NDArray[np.uint8]
    """(N, h, w) row of the object in the image, plus 1; 0: none. (N, 0, 0) likewise."""
    intrinsics: Array
    """(N, 4)"""
    object_starts: NDArray[np.int64]
    """(N + 1,) rows of image n are [n]:[n + 1]."""
    object_ids: NDArray[np.int64]
    """(M,)"""
    poses: Array
    """(M, 3, 4) T_cam_obj, m."""
    visible: Array
    """(M,) visible share."""

    def __len__(self) -> int:
        return len(self.intrinsics)


@dataclass(frozen=True)
class Sample:
    """One training image with its objects."""

    image: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    intrinsics: Array
    """(4,)"""
    classes: NDArray[np.int64]
    """(n,)"""
    R_cam_obj: Array
    """(n, 3, 3)"""
    t_cam_obj: Array
    """(n, 3) m"""
    boxes: Array
    """(n, 4) x1, y1, x2, y2 of the whole object, clipped to the image, px."""
    visible: Array
    """(n,) visible share before augmentation."""
    surface: Array
    """(h, w, 3) object coordinates over the diameter at the centres of the stride cells; nan: no object."""
    rows: NDArray[np.int64]
    """(n,) which of the scene's objects these are."""
    turn: Array
    """(3, 3) from the camera axes of the packed image to those of this one."""


def load_models(folder: Path, object_ids: Sequence[int] = (), count: int = 400) -> ObjectModels:
    """Read a BOP models folder; class k is the k-th of these objects, of all that are there if none is named.

    Raises InputError for what cannot be read.
    """
    info = models_of(folder / "models_info.json", object_ids)
    points, surface, axes = [], [], np.zeros((len(info), 3))
    for label, (number, model) in enumerate(info.items()):
        vertices, faces = read_model_mesh(folder / f"obj_{number:06d}.ply")
        surface.append(blend(vertices, *spread_over(vertices, faces, 1000, np.random.default_rng(number))))
        points.append(vertices[np.linspace(0, len(vertices) - 1, count).astype(int)])
        if model.symmetry is not None and model.symmetry.order == "continuous":
            axes[label] = model.symmetry.axis
    diameters = np.array([model.diameter_m for model in info.values()])
    return ObjectModels(np.stack(points), np.stack(surface), diameters, axes, tuple(info))


def pack_scene(scene: Path, out: Path, with_depth: bool = True) -> None:
    """Pack a BOP scene folder (images, JSON; depth and mask_visib where asked for) into out, unless it is there."""
    if out.exists():
        return
    read = read_bop_scene(scene)
    found = read.annotations
    if found is None or found.visible_fractions is None:
        raise InputError("has no scene_gt_info.json", path=scene, fix="give a complete BOP scene")
    counts = [int((found.image_ids == image).sum()) for image in read.image_ids]
    coded = [np.fromfile(_image_of(scene, image), np.uint8) for image in read.image_ids.tolist()]
    nothing = np.zeros((len(read), 0, 0))
    depth, instance = _depth_and_instances(scene, read, found) if with_depth else (nothing, nothing)
    arrays = {
        "jpegs": np.concatenate(coded),
        "jpeg_starts": np.cumsum([0] + [len(file) for file in coded]),
        "depth": depth.astype(np.uint16),
        "instance": instance.astype(np.uint8),
        "intrinsics": read.camera_matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]],
        "object_starts": np.cumsum([0, *counts]),
        "classes": found.object_ids,
        "poses": found.T_cam_obj.as_matrix()[:, :3],
        "visible": found.visible_fractions,
    }
    partial = out.with_suffix(".partial")
    partial.mkdir(parents=True, exist_ok=True)
    for name, array in arrays.items():
        np.save(partial / f"{name}.npy", array)
    partial.rename(out)


def _image_of(scene: Path, image: int) -> Path:
    path = image_path(scene, image)
    if path is None:
        raise InputError(f"image {image:06d} is missing", path=scene, fix="it belongs into rgb/ or gray/")
    return path


def _depth_and_instances(scene: Path, read: BopScene, found: BopAnnotations) -> tuple[NDArray, NDArray]:
    """Return depth (N, h, w), 0.1 mm, and instances (N, h, w)."""
    if read.depth_scales is None:
        raise InputError("has no depth scale", path=scene, fix="give a complete BOP scene")
    depths, instances = [], []
    for image, scale in zip(read.image_ids.tolist(), read.depth_scales / 0.1):
        depth = _read(scene / "depth" / f"{image:06d}.png", cv2.IMREAD_UNCHANGED)[::SHRINK, ::SHRINK]
        instance = np.zeros(depth.shape, np.uint8)
        for row in range(int((found.image_ids == image).sum())):
            mask = _read(scene / "mask_visib" / f"{image:06d}_{row:06d}.png", cv2.IMREAD_GRAYSCALE)
            instance[mask[::SHRINK, ::SHRINK] > 0] = row + 1
        depths.append(np.minimum(depth * scale, 65535))
        instances.append(instance)
    return np.stack(depths), np.stack(instances)


def _read(path: Path, flags: int) -> NDArray:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise InputError("is missing or no image", path=path, fix="render the scene again, with depth and masks")
    return image


def open_packed(folder: Path) -> PackedScene:
    """Map a packed scene from disk."""
    fields = ("jpegs", "jpeg_starts", "depth", "instance", "intrinsics", "object_starts", "classes", "poses", "visible")
    large = {"jpegs", "depth", "instance"}
    return PackedScene(*(np.load(folder / f"{name}.npy", mmap_mode="r" if name in large else None) for name in fields))


@dataclass(frozen=True)
class AugmentOptions:
    """How far an image is changed."""

    turn_deg: float = 25.0
    """Largest turn about the optical axis, degrees."""
    zoom: float = 0.18
    """Largest log change of the focal length."""
    shift: float = 0.06
    """Largest shift of the image, share of its width."""
    gain: float = 0.15
    """Standard deviation of the log brightness; half of it for each colour."""
    noise: float = 4.0
    """Largest standard deviation of added noise, of 255."""


NO_CHANGE = AugmentOptions(0.0, 0.0, 0.0, 0.0, 0.0)


class PackedImages:
    """All packed scenes of a folder as one row of samples."""

    def __init__(
        self,
        scenes: list[Path],
        models: ObjectModels,
        stride: int | None = 8,
        least_visible: float = 0.1,
        most: int | None = None,
    ) -> None:
        """stride: pixels per cell of the samples' object coordinates, None: they have none.

        most: so many images at most, evenly spread over all.
        """
        if not scenes:
            raise InputError("there is no packed scene to train on", fix="render and pack first")
        self.scenes = [open_packed(scene) for scene in scenes]
        if stride is not None and not all(scene.instance.size for scene in self.scenes):
            raise InputError("is packed without depth and masks", path=scenes[0], fix="name another cache folder")
        self.models, self.stride, self.least_visible = models, stride, least_visible
        counts = [len(scene) for scene in self.scenes]
        index = [(s, n) for s, count in enumerate(counts) for n in range(count)]
        count = len(index) if most is None else min(most, len(index))
        self.index = [index[place] for place in np.linspace(0, len(index) - 1, count).round().astype(int)]

    def __len__(self) -> int:
        return len(self.index)

    def sample(self, number: int, rng: np.random.Generator, augment: AugmentOptions = NO_CHANGE) -> Sample:
        """Return sample `number`, changed at random."""
        scene, n = self.scenes[self.index[number][0]], self.index[number][1]
        coded = cv2.imdecode(scene.jpegs[scene.jpeg_starts[n] : scene.jpeg_starts[n + 1]], cv2.IMREAD_COLOR)
        image = np.asarray(coded, np.uint8)[..., ::-1]
        height, width = image.shape[:2]
        K, K_new, R_turn = _random_camera(scene.intrinsics[n], width, rng, augment)
        rows = slice(scene.object_starts[n], scene.object_starts[n + 1])
        poses, visible = scene.poses[rows], scene.visible[rows]
        classes = self.models.classes_of(scene.object_ids[rows])
        warp = K_new @ R_turn @ np.linalg.inv(K)
        R_old, t_old = poses[:, :, :3], poses[:, :, 3]
        surface = np.zeros((0, 0, 3))
        if self.stride is not None:
            cells = _cell_centres((height, width), self.stride) @ np.linalg.inv(warp).T
            surface = self._surface(scene, n, R_old, t_old, classes, K, cells)
        if augment != NO_CHANGE:
            image = _shake_colors(
                cv2.warpPerspective(image, warp, (width, height), borderMode=cv2.BORDER_REFLECT), rng, augment
            )
        R, t = R_turn @ R_old, t_old @ R_turn.T
        whole = self._boxes(R, t, np.maximum(classes, 1), K_new)
        boxes = np.clip(whole, 0.0, [width, height, width, height])
        size, whole_size = boxes[:, 2:] - boxes[:, :2], whole[:, 2:] - whole[:, :2]
        keep = (classes > 0) & (visible >= self.least_visible) & (size.min(1) > 6.0) & (t[:, 2] > 0.1)
        keep &= size.prod(1) > 0.2 * whole_size.prod(1)  # turned or shifted out of the image
        flat = np.array([K_new[0, 0], K_new[1, 1], K_new[0, 2], K_new[1, 2]])
        return Sample(
            np.ascontiguousarray(image), flat, classes[keep], R[keep], t[keep], boxes[keep], visible[keep], surface,
            np.arange(rows.start, rows.stop)[keep], R_turn,
        )  # fmt: skip

    def _boxes(self, R: Array, t: Array, classes: NDArray[np.int64], K: Array) -> Array:
        points = self.models.points[classes - 1] @ R.mT + t[:, None]
        z = np.maximum(points[..., 2], 1e-3)
        u, v = K[0, 0] * points[..., 0] / z + K[0, 2], K[1, 1] * points[..., 1] / z + K[1, 2]
        return np.stack([u.min(1), v.min(1), u.max(1), v.max(1)], -1) + 0.5  # from pixel centres to edges

    def _surface(
        self, scene: PackedScene, n: int, R: Array, t: Array, classes: NDArray[np.int64], K: Array, old: Array
    ) -> Array:
        """Object coordinates where the new image's cells (h, w, 3) are in the old one, from its depth."""
        x, y = (
            np.rint(old[..., 0] / old[..., 2] / SHRINK).astype(int),
            np.rint(old[..., 1] / old[..., 2] / SHRINK).astype(int),
        )
        instance, depth = scene.instance[n], scene.depth[n]
        inside = (x >= 0) & (y >= 0) & (x < instance.shape[1]) & (y < instance.shape[0])
        x, y = np.where(inside, x, 0), np.where(inside, y, 0)
        row = np.where(inside, instance[y, x], 0).astype(int) - 1
        surface = np.full(old.shape, np.nan)
        hit = (row >= 0) & (np.append(classes, 0)[row] > 0)
        if hit.any():
            z = depth[y[hit], x[hit]] * 1e-4
            ray = np.stack(
                [(x[hit] * SHRINK - K[0, 2]) / K[0, 0], (y[hit] * SHRINK - K[1, 2]) / K[1, 1], np.ones(len(z))], -1
            )
            turned = canonical_rotation(R, t, self.models.symmetry_axes[np.maximum(classes, 1) - 1])
            point = np.einsum("ni,nij->nj", ray * z[:, None] - t[row[hit]], turned[row[hit]])
            surface[hit] = point / self.models.diameters[classes[row[hit]] - 1, None]
        return surface


def _cell_centres(size: tuple[int, int], stride: int) -> Array:
    rows, columns = -(-size[0] // stride), -(-size[1] // stride)
    v, u = np.mgrid[0:rows, 0:columns] * stride + (stride - 1) / 2
    return np.stack([u, v, np.ones_like(u)], -1)


def canonical_rotation(R: Array, t: Array, axes: Array) -> Array:
    """Turn objects (n, 3, 3), (n, 3) about their symmetry axis (n, 3) so that the camera lies over the half plane of x.

    A zero axis leaves the rotation as it is; only axes along z are turned in closed form, others raise ValueError.
    """
    symmetric = np.abs(axes).sum(1) > 0
    if np.any(np.abs(axes[symmetric] - [0, 0, 1]).max(initial=0) > 1e-9):
        raise ValueError("only a continuous symmetry about z is supported")
    eye = -np.einsum("nji,nj->ni", R, t)  # the camera in object axes
    angle = np.where(symmetric, np.arctan2(eye[:, 1], eye[:, 0]), 0.0)
    c, s, one, zero = np.cos(angle), np.sin(angle), np.ones(len(R)), np.zeros(len(R))
    turn = np.stack([np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, one], -1)], -2)
    return R @ turn


def _random_camera(
    intrinsics: Array, width: int, rng: np.random.Generator, augment: AugmentOptions
) -> tuple[Array, Array, Array]:
    fx, fy, cx, cy = intrinsics
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    turn = np.deg2rad(augment.turn_deg) * rng.uniform(-1, 1)
    zoom, shift = np.exp(augment.zoom * rng.uniform(-1, 1)), augment.shift * width * rng.uniform(-1, 1, 2)
    K_new = np.array([[fx * zoom, 0, cx + shift[0]], [0, fy * zoom, cy + shift[1]], [0, 0, 1.0]])
    c, s = np.cos(turn), np.sin(turn)
    return K, K_new, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _shake_colors(image: NDArray, rng: np.random.Generator, augment: AugmentOptions) -> NDArray[np.uint8]:
    gain = np.exp(rng.normal(0, augment.gain) + rng.normal(0, augment.gain / 2, 3)).astype(np.float32)
    table = np.clip(np.arange(256, dtype=np.float32)[:, None] * gain, 0, 255).astype(np.uint8)
    changed = cv2.LUT(image, table.reshape(256, 1, 3))
    if rng.random() < 0.3:
        noise = np.empty(image.shape, np.int16)
        cv2.setRNGSeed(int(rng.integers(2**31)))
        cv2.randn(noise, np.zeros(3), np.full(3, augment.noise * rng.random()))
        changed = np.clip(changed + noise, 0, 255).astype(np.uint8)
    return np.asarray(changed, np.uint8)


def scenes_of(split: Path) -> list[Path]:
    """Return a BOP split's whole scenes in order.  Raises InputError where there is none."""
    folders = sorted(split.iterdir()) if split.is_dir() else []
    scenes = [path for path in folders if path.suffix != ".partial" and (path / "scene_gt.json").exists()]
    if not scenes:
        raise InputError("no BOP split: it has no folders like 000001 with scene_gt.json", path=split)
    return scenes


def pack(split: Path, out: Path, jobs: int = 2, with_depth: bool = True) -> list[Path]:
    """Pack every whole scene of a BOP split that is not packed yet and return the packed folders in order."""
    scenes = scenes_of(split)
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(lambda scene: pack_scene(scene, out / scene.name, with_depth), scenes))
    return [out / scene.name for scene in scenes]
