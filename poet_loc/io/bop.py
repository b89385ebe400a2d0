"""BOP scenes: scene_camera.json, scene_gt.json and scene_gt_info.json of one scene folder; millimetres outside.

Source: the format notes of the BOP benchmark (bop_toolkit, docs/bop_datasets_format.md).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.io.input_text import line_of, read_json, read_text
from poet_loc.io.json_fields import FieldError, are_rotations, numbers, required, whole_number
from poet_loc.io.whole_folder import write_whole_file

Array = NDArray[np.float64]

_MM_PER_M = 1000.0
_NEAREST_MEDIAN_MM = 20.0
_FIX = "write it as the BOP format wants it"


@dataclass(frozen=True)
class BopAnnotations:
    """Every annotated object of a scene, G rows, in the order of the images and of the file."""

    image_ids: NDArray[np.int64]
    object_ids: NDArray[np.int64]
    T_cam_obj: RigidTransform
    """m"""
    visible_fractions: Array | None = None
    """(G,) share of the silhouette that is visible, from scene_gt_info.json."""
    boxes_object_px: Array | None = None
    """(G, 4) x, y, width, height of the whole silhouette, hidden parts included."""
    boxes_visible_px: Array | None = None
    """(G, 4) the same of the visible part; -1 where nothing is visible."""

    def __len__(self) -> int:
        return len(self.image_ids)


@dataclass(frozen=True)
class BopScene:
    """A scene: F images with their cameras, and the annotated objects where there are any."""

    image_ids: NDArray[np.int64]
    camera_matrices: Array
    """(F, 3, 3) pixels; pixel (0, 0) is centred at (0, 0)."""
    T_cam_world: RigidTransform | None = None
    """F poses, m; None where an image has no cam_R_w2c and cam_t_w2c."""
    annotations: BopAnnotations | None = None
    depth_scales: Array | None = None
    """(F,) multiply a depth image with it to get millimetres."""

    def __len__(self) -> int:
        return len(self.image_ids)


def read_bop_scene(folder: str | Path) -> BopScene:
    """Read one scene folder; scene_gt.json and scene_gt_info.json may be missing.

    Raises InputError for a malformed file, a matrix that is no rotation, and metres where millimetres belong.
    """
    folder = Path(folder)
    path = folder / "scene_camera.json"
    cameras = _by_image(path)
    for image, camera in cameras.items():
        if not isinstance(camera, dict):
            raise _malformed(path, image, "holds no camera")
    image_ids = np.array(sorted(cameras), np.int64)
    rows = [cameras[image] for image in image_ids.tolist()]
    matrices = [_image_numbers(path, image, camera, "cam_K", 9) for image, camera in zip(image_ids, rows, strict=True)]
    scales = [camera.get("depth_scale") for camera in rows]
    return BopScene(
        image_ids=image_ids,
        camera_matrices=np.reshape(matrices, (-1, 3, 3)),
        T_cam_world=_poses(path, image_ids, rows, "cam_R_w2c", "cam_t_w2c") if _has_world(rows) else None,
        annotations=_annotations(folder) if (folder / "scene_gt.json").exists() else None,
        depth_scales=np.array(scales, float) if all(isinstance(scale, int | float) for scale in scales) else None,
    )


def write_bop_scene(folder: str | Path, scene: BopScene) -> None:
    """Write a scene's JSON files into an existing folder, one image a line."""
    folder = Path(folder)
    cameras: dict[int, dict[str, Any]] = {}
    for index, image in enumerate(scene.image_ids.tolist()):
        cameras[image] = {"cam_K": scene.camera_matrices[index].ravel().tolist()}
        if scene.depth_scales is not None:
            cameras[image]["depth_scale"] = float(scene.depth_scales[index])
        if scene.T_cam_world is not None:
            cameras[image] |= _pose_fields(scene.T_cam_world[index], "cam_R_w2c", "cam_t_w2c")
    _write_by_image(folder / "scene_camera.json", cameras)
    if scene.annotations is not None:
        _write_annotations(folder, scene)


def _has_world(cameras: list[dict[str, Any]]) -> bool:
    return all("cam_R_w2c" in camera and "cam_t_w2c" in camera for camera in cameras)


def _annotations(folder: Path) -> BopAnnotations:
    path = folder / "scene_gt.json"
    content = _lists_by_image(path)
    pairs = [(image, entry) for image in sorted(content) for entry in content[image]]
    if not pairs:
        raise InputError("has no annotated object", path=path, fix=_FIX)
    for image, entry in pairs:
        with _told_with_line(path, image):
            whole_number(required(entry, "obj_id"), "obj_id")
    image_ids = np.array([image for image, _ in pairs], np.int64)
    object_ids = np.array([entry["obj_id"] for _, entry in pairs], np.int64)
    T_cam_obj = _poses(path, image_ids, [entry for _, entry in pairs], "cam_R_m2c", "cam_t_m2c")
    distance = float(np.median(np.linalg.norm(T_cam_obj.translation, axis=-1))) * _MM_PER_M
    if distance < _NEAREST_MEDIAN_MM:
        what = f"cam_t_m2c looks like metres (median length {distance:.3g})"
        raise InputError(what, path=path, fix="multiply by 1000: BOP keeps millimetres")
    info = folder / "scene_gt_info.json"
    if not info.exists():
        return BopAnnotations(image_ids, object_ids, T_cam_obj)
    visible, whole, part = _annotation_info(info, {image: len(entries) for image, entries in content.items()})
    return BopAnnotations(image_ids, object_ids, T_cam_obj, visible, whole, part)


def _annotation_info(path: Path, counts: Mapping[int, int]) -> tuple[Array, Array, Array]:
    content = _lists_by_image(path)
    visible, whole, part = [], [], []
    for image in sorted(counts):
        entries = content.get(image, [])
        if len(entries) != counts[image]:
            raise _malformed(path, image, f"{len(entries)} entries, scene_gt.json has {counts[image]}")
        for entry in entries:
            with _told_with_line(path, image):
                visible.append(float(numbers(required(entry, "visib_fract"), "visib_fract", ())))
                whole.append(numbers(required(entry, "bbox_obj"), "bbox_obj", (4,)))
                part.append(numbers(required(entry, "bbox_visib"), "bbox_visib", (4,)))
    return np.array(visible), np.reshape(whole, (-1, 4)), np.reshape(part, (-1, 4))


def _poses(
    path: Path, image_ids: NDArray[np.int64], entries: list[dict[str, Any]], rotation: str, translation: str
) -> RigidTransform:
    """Return the poses of entries, millimetres turned into metres; image_ids tell where an entry stands."""
    pairs = list(zip(image_ids.tolist(), entries, strict=True))
    matrices = np.array([_image_numbers(path, image, entry, rotation, 9) for image, entry in pairs]).reshape(-1, 3, 3)
    millimetres = np.array([_image_numbers(path, image, entry, translation, 3) for image, entry in pairs])
    bad = ~are_rotations(matrices)
    if bad.any():
        image = int(image_ids[np.argmax(bad)])
        raise _malformed(path, image, f"{rotation} is no rotation")
    return make_pose(Rotation.from_matrix(matrices), millimetres / _MM_PER_M)


def _image_numbers(path: Path, image: int, entry: dict[str, Any], name: str, count: int) -> Array:
    with _told_with_line(path, image):
        return numbers(required(entry, name), name, (count,))


def _by_image(path: Path) -> dict[int, Any]:
    content = read_json(path)
    if not isinstance(content, dict) or not content:
        raise InputError("has no images", path=path, fix=_FIX)
    try:
        return {int(np.int64(int(image))): entry for image, entry in content.items()}
    except (ValueError, OverflowError):
        raise InputError("has a key that is no image number", path=path, fix=_FIX) from None


def _lists_by_image(path: Path) -> dict[int, list[dict[str, Any]]]:
    content = _by_image(path)
    for image, entries in content.items():
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise _malformed(path, image, "holds no list of objects")
    return content


def _malformed(path: Path, image: int, what: str) -> InputError:
    line = line_of(read_text(path), rf'"0*{image}"\s*:')
    return InputError(f"image {image}: {what}", path=path, line=line, fix=_FIX)


@contextmanager
def _told_with_line(path: Path, image: int) -> Iterator[None]:
    try:
        yield
    except FieldError as error:
        raise _malformed(path, image, str(error)) from None


def _pose_fields(T: RigidTransform, rotation: str, translation: str) -> dict[str, list[float]]:
    return {
        rotation: T.rotation.as_matrix().ravel().tolist(),
        translation: (T.translation * _MM_PER_M).tolist(),
    }


def _write_annotations(folder: Path, scene: BopScene) -> None:
    annotations = scene.annotations
    assert annotations is not None
    poses: dict[int, list[Any]] = {image: [] for image in scene.image_ids.tolist()}
    infos: dict[int, list[Any]] = {image: [] for image in scene.image_ids.tolist()}
    visible, whole, part = (
        annotations.visible_fractions,
        annotations.boxes_object_px,
        annotations.boxes_visible_px,
    )
    for row, image in enumerate(annotations.image_ids.tolist()):
        pose = _pose_fields(annotations.T_cam_obj[row], "cam_R_m2c", "cam_t_m2c")
        poses[image].append({**pose, "obj_id": int(annotations.object_ids[row])})
        if visible is not None and whole is not None and part is not None:
            info = {"bbox_obj": whole[row].tolist(), "bbox_visib": part[row].tolist()}
            infos[image].append({**info, "visib_fract": float(visible[row])})
    _write_by_image(folder / "scene_gt.json", poses)
    if visible is not None and whole is not None and part is not None:
        _write_by_image(folder / "scene_gt_info.json", infos)


def _write_by_image(path: Path, content: Mapping[int, Any]) -> None:
    lines = (f' "{image}": {json.dumps(entry)}' for image, entry in content.items())
    write_whole_file(path, ["{\n", ",\n".join(lines), "\n}\n"])
