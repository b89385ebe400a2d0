"""Writes a rendered scene as a BOP scene folder: rgb, depth, masks and their JSON files (millimetres at this edge)."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.data.world.mesh import Mesh
from poet_loc.data.world.objects import WorldObject
from poet_loc.data.world.view import Assets, Geometry, Scene, depth_and_things, silhouette

Intrinsics = tuple[float, float, float, float]
DEPTH_SCALE = 0.1
"""Millimetres per unit of a depth image."""


def write_models(folder: Path, objects: tuple[WorldObject, ...]) -> None:
    """Write obj_NNNNNN.ply (mm) with their textures, models_info.json and names.json."""
    folder.mkdir(parents=True, exist_ok=True)
    info: dict[str, Any] = {}
    for thing in objects:
        name = f"obj_{thing.object_id:06d}"
        cv2.imwrite(str(folder / f"{name}.png"), thing.texture[..., ::-1])
        _write_ply(folder / f"{name}.ply", thing.mesh, f"{name}.png")
        low, size = thing.mesh.vertices.min(0) * 1e3, thing.extent * 1e3
        entry: dict[str, Any] = {"diameter": round(thing.diameter * 1e3, 4)}
        entry |= {f"min_{axis}": round(float(value), 4) for axis, value in zip("xyz", low)}
        entry |= {f"size_{axis}": round(float(value), 4) for axis, value in zip("xyz", size)}
        if thing.symmetry is not None and thing.symmetry.order == "continuous":
            entry["symmetries_continuous"] = [{"axis": list(thing.symmetry.axis), "offset": [0, 0, 0]}]
        info[str(thing.object_id)] = entry
    (folder / "models_info.json").write_text(json.dumps(info, indent=1))
    names = {str(thing.object_id): thing.name for thing in objects}
    (folder / "names.json").write_text(json.dumps(names, indent=1))


def _write_ply(path: Path, mesh: Mesh, texture: str) -> None:
    header = ["ply", "format ascii 1.0", f"comment TextureFile {texture}", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "texture_u", "texture_v")]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    uv = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], -1)  # in a PLY v points up
    rows = np.concatenate([mesh.vertices * 1e3, mesh.normals, uv], 1)
    lines = [" ".join(f"{value:.5f}" for value in row) for row in rows]
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    path.write_text("\n".join(header + lines) + "\n")


@dataclass
class SceneWriter:
    """One BOP scene folder in the making; `close` writes the JSON files."""

    folder: Path
    assets: Assets
    size: tuple[int, int]
    """(width, height) pixels"""
    masks: bool = True
    depth: bool = True
    _ground_truth: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    _info: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    _cameras: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("rgb", *(["depth"] if self.depth else []), *(["mask", "mask_visib"] if self.masks else [])):
            (self.folder / name).mkdir(parents=True, exist_ok=True)

    def add(
        self, number: int, image: NDArray[np.uint8], quality: int, scene: Scene, T_cam_world: RigidTransform,
        intrinsics: Intrinsics, geometry: Geometry,
    ) -> None:  # fmt: skip
        """Write image number with its depth and masks, and keep its annotations."""
        stem = f"{number:06d}"
        cv2.imwrite(str(self.folder / "rgb" / f"{stem}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        depth, seen = depth_and_things(geometry, self.size)
        if self.depth:
            depth_units = np.where(np.isfinite(depth), depth * (1e3 / DEPTH_SCALE), 0).clip(0, 65535).astype(np.uint16)
            cv2.imwrite(str(self.folder / "depth" / f"{stem}.png"), depth_units, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        fx, fy, cx, cy = intrinsics
        self._cameras[str(number)] = {
            "cam_K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], "depth_scale": DEPTH_SCALE,
            **_pose_entry("cam_R_w2c", "cam_t_w2c", T_cam_world),
        }  # fmt: skip
        self._ground_truth[str(number)], self._info[str(number)] = [], []
        for place, thing in enumerate(scene.things):
            if thing < len(self.assets.objects):
                T_cam_obj = T_cam_world * scene.T_world_thing[place]
                self._annotate(number, place, self.assets.objects[thing], T_cam_obj, geometry, seen == place)

    def _annotate(
        self, number: int, place: int, thing: WorldObject, T_cam_obj: RigidTransform, geometry: Geometry,
        visible: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        entries = self._ground_truth[str(number)]
        canvas = _canvas_of(geometry, place, self.size)
        whole = silhouette(geometry, place, canvas) if canvas is not None else np.zeros((1, 1), np.bool_)
        left, top = canvas[:2] if canvas is not None else (0, 0)
        if self.masks:
            name = f"{number:06d}_{len(entries):06d}.png"
            inside = _crop(whole, left, top, self.size)
            for kind, mask in (("mask", inside), ("mask_visib", visible)):
                cv2.imwrite(
                    str(self.folder / kind / name), mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_COMPRESSION, 1]
                )
        entries.append({**_pose_entry("cam_R_m2c", "cam_t_m2c", T_cam_obj), "obj_id": thing.object_id})
        total, seen = int(whole.sum()), int(visible.sum())
        self._info[str(number)].append(
            {
                "bbox_obj": _box_of(whole, left, top), "bbox_visib": _box_of(visible, 0, 0), "px_count_all": total,
                "px_count_valid": seen, "px_count_visib": seen, "visib_fract": round(seen / total, 5) if total else 0.0,
            }
        )  # fmt: skip

    def close(self) -> None:
        """Write scene_gt.json, scene_gt_info.json and scene_camera.json."""
        files = (("scene_camera", self._cameras), ("scene_gt_info", self._info), ("scene_gt", self._ground_truth))
        for name, content in files:
            rows = [f'  "{key}": {json.dumps(value)}' for key, value in content.items()]
            (self.folder / f"{name}.json").write_text("{\n" + ",\n".join(rows) + "\n}\n")


def _pose_entry(rotation_key: str, translation_key: str, T: RigidTransform) -> dict[str, list[float]]:
    rotation, millimetres = T.rotation.as_matrix().reshape(-1), T.translation * 1e3
    return {
        rotation_key: [round(float(x), 9) for x in rotation],
        translation_key: [round(float(x), 6) for x in millimetres],
    }


def _canvas_of(geometry: Geometry, place: int, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """Return the part (left, top, width, height) of a threefold image that holds a thing, None where none does."""
    corners = np.unique(geometry.faces[geometry.face_thing == place])
    u, v = geometry.u[corners], geometry.v[corners]
    if not np.all(np.isfinite(u)):
        return None
    width, height = size
    left, right = max(int(np.floor(u.min())), -width), min(int(np.ceil(u.max())), 2 * width - 1)
    top, bottom = max(int(np.floor(v.min())), -height), min(int(np.ceil(v.max())), 2 * height - 1)
    return (left, top, right - left + 1, bottom - top + 1) if right >= left and bottom >= top else None


def _crop(mask: NDArray[np.bool_], left: int, top: int, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the (height, width) image of a mask whose corner lies at pixel (left, top)."""
    image = np.zeros((size[1], size[0]), np.bool_)
    x0, y0 = max(left, 0), max(top, 0)
    part = mask[y0 - top : max(size[1] - top, 0), x0 - left : max(size[0] - left, 0)]
    image[y0 : y0 + part.shape[0], x0 : x0 + part.shape[1]] = part
    return image


def _box_of(mask: NDArray[np.bool_], left: int, top: int) -> list[int]:
    """Return [x, y, width, height] of a mask, -1 where it is empty, as BOP does."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if len(rows) == 0:
        return [-1, -1, -1, -1]
    return [left + int(columns[0]), top + int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1]
