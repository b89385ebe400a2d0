"""Data sets in the official annotation.json format."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from poet_loc.core.input_error import InputError
from poet_loc.data.samples import ImageRecord

FOLDERS = {"val": "val", "test": "test_all", "keyframes": "test_all", "keyframes_bop": "test_all"}
"""Folder of the images of a published split; every other split is in `train`."""


class AnnotationDataset:
    """Images and poses of one annotation file; images without an object are kept, with no targets."""

    def __init__(self, annotations: str | Path, images: str | Path) -> None:
        path = Path(annotations)
        try:
            content = json.loads(path.read_text())
            self._images, self._objects = content["images"], defaultdict(list)
            for row in content["annotations"]:
                self._objects[row["image_id"]].append(row)
            categories = sorted(content["categories"], key=lambda row: row["id"])
            self.names = tuple(str(row["name"]) for row in categories if row["id"] > 0)
            self._ids = tuple(int(row["id"]) for row in categories if row["id"] > 0)
        except FileNotFoundError:
            raise InputError("no such file", path=path) from None
        except (ValueError, KeyError, TypeError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise InputError(f"not an annotation file ({what})", path=path) from None
        self._path, self._folder = path, Path(images)

    @classmethod
    def of_split(cls, root: str | Path, split: str) -> AnnotationDataset:
        """Return a split of a data set as the official code lays it out: annotations/{split}.json and its images."""
        root = Path(root)
        return cls(root / "annotations" / f"{split}.json", root / FOLDERS.get(split, "train"))

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Category of class 1, 2, ..."""
        return self._ids

    def __len__(self) -> int:
        return len(self._images)

    def record(self, index: int) -> ImageRecord:
        """Return an image's record.  Raises InputError for entries that lack a field."""
        image = self._images[index]
        try:
            rows = self._objects.get(image["id"], [])
            poses = [row["relative_pose"] for row in rows]
            scene, number = _scene_and_image(image["file_name"])
            return ImageRecord(
                path=self._folder / image["file_name"],
                size=(int(image["width"]), int(image["height"])),
                intrinsics=_intrinsics(image.get("intrinsics")),
                labels=np.array([self._ids.index(row["category_id"]) + 1 for row in rows], dtype=np.int64),
                boxes_px=np.array([row["bbox"] for row in rows], dtype=float).reshape(-1, 4),
                translations_m=np.array([pose["position"] for pose in poses], dtype=float).reshape(-1, 3),
                rotations=np.array([np.reshape(pose["rotation"], (3, 3)) for pose in poses], float).reshape(-1, 3, 3),
                kind=image.get("type", "real"),
                scene_id=scene,
                image_id=number,
            )
        except (KeyError, ValueError, TypeError) as error:
            name = image.get("file_name", index) if isinstance(image, dict) else index
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise InputError(f"image {name}: {what}", path=self._path) from None


def _intrinsics(numbers: Any) -> tuple[float, float, float, float]:
    if numbers is None:
        return (math.nan, math.nan, math.nan, math.nan)
    matrix = np.reshape(numbers, (3, 3)).astype(float)
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _scene_and_image(file_name: str) -> tuple[int, int]:
    """Return the numbers in a BOP-like name (.../000048/rgb/000001.png), 0 where there are none."""
    parts = Path(file_name).parts
    scene = next((part for part in reversed(parts[:-1]) if part.isdigit()), "0")
    digits = "".join(c for c in Path(file_name).stem if c.isdigit())
    return int(scene), int(digits or 0)
