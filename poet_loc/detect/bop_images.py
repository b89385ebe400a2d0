"""Images of a BOP scene or split, with the camera of each and, where asked for, the true boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.data.bop_dataset import BopDataset, image_path, read_keyframes
from poet_loc.data.samples import clipped_corners
from poet_loc.io.bop import read_bop_scene


@dataclass(frozen=True)
class BopPlace:
    """Where in a BOP split an image is."""

    scene: int
    image: int
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy px."""


def is_bop(folder: Path) -> bool:
    """Return whether a folder is a BOP scene, or a split of scenes."""
    return bool(_scene_folders(folder))


def bop_files(folder: Path, keyframes: Path | None = None) -> tuple[list[Path], list[BopPlace]]:
    """Return the image files of a scene or of all scenes of a split, and their places.

    keyframes: file of lines like 0048/000001 that restricts them.  Raises InputError where no image is left.
    """
    wanted = None if keyframes is None else read_keyframes(keyframes)
    files, places = [], []
    for scene_folder in _scene_folders(folder):
        scene, number = read_bop_scene(scene_folder), int(scene_folder.name)
        for image, matrix in zip(scene.image_ids.tolist(), scene.camera_matrices.tolist()):
            if wanted is None or (number, image) in wanted:
                files.append(image_path(scene_folder, image) or scene_folder / "rgb" / f"{image:06d}.png")
                places.append(BopPlace(number, image, (matrix[0][0], matrix[1][1], matrix[0][2], matrix[1][2])))
    if not files:
        raise InputError("no image is a key frame", path=keyframes or folder)
    return files, places


class TrueBoxes:
    """Boxes and classes of the objects that are there, as in training with true boxes."""

    def __init__(self, folder: Path, object_ids: Sequence[int], class_count: int) -> None:
        """object_ids: id of class 1, 2, ...; empty: the class is the id."""
        if not is_bop(folder):
            raise InputError(
                "is no BOP scene or split, it has no true boxes", path=folder, fix="leave out --true-boxes"
            )
        scenes = _scene_folders(folder)
        known = tuple(object_ids) or tuple(range(1, class_count + 1))
        numbers = [int(scene.name) for scene in scenes]
        self._dataset = BopDataset(scenes[0].parent, known, keep_empty=True, scenes=numbers)
        self._index = {place: index for index, place in enumerate(self._dataset.places())}

    def of(self, place: BopPlace) -> tuple[Tensor, Tensor]:
        """Return x1, y1, x2, y2 (n, 4) in px, clipped to the image, and classes (n,)."""
        record = self._dataset.record(self._index[place.scene, place.image])
        corners, keep = clipped_corners(record)
        return corners[keep], torch.from_numpy(record.labels)[keep]


def _scene_folders(folder: Path) -> list[Path]:
    if (folder / "scene_camera.json").exists():
        return [folder] if folder.resolve().name.isdigit() else []
    return sorted(p for p in folder.glob("*") if p.name.isdigit() and (p / "scene_camera.json").exists())
