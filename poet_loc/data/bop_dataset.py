"""BOP data sets read as they are: one split folder of scenes, real, rendered or pbr."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from poet_loc.core.input_error import InputError
from poet_loc.data.samples import ImageRecord, class_of_object
from poet_loc.io.bop import BopScene, read_bop_scene

IMAGE_FOLDERS = (("rgb", ".png"), ("rgb", ".jpg"), ("gray", ".png"), ("gray", ".tif"))


class BopDataset:
    """Images of a split, e.g. `ycbv/train_pbr`, with the objects that are visible enough."""

    def __init__(
        self,
        split: str | Path,
        object_ids: Sequence[int] = (),
        least_visible: float = 0.05,
        keyframes: str | Path | None = None,
        keep_empty: bool = False,
        scenes: Sequence[int] = (),
    ) -> None:
        """Read the scenes of a split folder.

        object_ids: id of class 1, 2, ...; empty: the ids that occur, sorted.  least_visible: share of the silhouette
        below which an object does not count.  keyframes: file of lines like 0048/000001 that restricts the images.
        scenes: numbers of the scenes to read; empty: all.
        """
        self.split = Path(split)
        folders = sorted(p for p in self.split.glob("*") if p.name.isdigit()) if self.split.is_dir() else []
        folders = [folder for folder in folders if not scenes or int(folder.name) in scenes]
        if not folders:
            raise InputError("no BOP split: it has no folders like 000001", path=split)
        wanted = None if keyframes is None else read_keyframes(keyframes)
        found = [(int(folder.name), folder, read_bop_scene(folder)) for folder in folders]
        self._ids = tuple(object_ids) or tuple(sorted({int(i) for _, _, s in found for i in _objects(s)}))
        self._class_of = class_of_object(self._ids)
        self._places: list[tuple[int, Path, BopScene, int, np.ndarray]] = []
        for number, folder, scene in found:
            rows_of_image = self._rows(scene, least_visible)
            for position, image in enumerate(scene.image_ids.tolist()):
                rows = rows_of_image.get(image, np.empty(0, np.intp))
                if (len(rows) or keep_empty) and (wanted is None or (number, image) in wanted):
                    self._places.append((number, folder, scene, position, rows))
        self._sizes: dict[tuple[int, str], tuple[int, int]] = {}

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Object id of class 1, 2, ..."""
        return self._ids

    def __len__(self) -> int:
        return len(self._places)

    def places(self) -> list[tuple[int, int]]:
        """Return scene and image number of every record."""
        return [(number, int(scene.image_ids[position])) for number, _, scene, position, _ in self._places]

    def record(self, index: int) -> ImageRecord:
        """Return an image's record; its boxes are those of the whole object, as in the published annotations."""
        number, folder, scene, position, rows = self._places[index]
        image = int(scene.image_ids[position])
        path = image_path(folder, image)
        if path is None:
            raise InputError(f"image {image:06d} is missing", path=folder, fix="it belongs into rgb/ or gray/")
        matrix = scene.camera_matrices[position]
        found = scene.annotations
        empty = found is None or len(rows) == 0
        T = None if found is None or empty else found.T_cam_obj[rows]
        boxes = None if found is None or empty else found.boxes_object_px
        return ImageRecord(
            path=path,
            size=self._size(number, path),
            intrinsics=(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])),
            labels=np.array(
                [] if found is None else [self._class_of[i] for i in found.object_ids[rows]], dtype=np.int64
            ),
            boxes_px=np.zeros((0, 4)) if boxes is None else boxes[rows],
            translations_m=np.zeros((0, 3)) if T is None else T.translation,
            rotations=np.zeros((0, 3, 3)) if T is None else T.rotation.as_matrix(),
            kind=_kind(self.split.name),
            scene_id=number,
            image_id=image,
        )

    def _rows(self, scene: BopScene, least_visible: float) -> dict[int, np.ndarray]:
        found = scene.annotations
        if found is None:
            return {}
        if found.boxes_object_px is None:
            raise InputError("scene_gt_info.json with the boxes is missing", path=self.split)
        keep = np.isin(found.object_ids, self._ids)
        if found.visible_fractions is not None:
            keep &= found.visible_fractions >= least_visible
        rows = np.flatnonzero(keep)
        images = found.image_ids[rows]
        order = np.argsort(images, kind="stable")
        values, starts = np.unique(images[order], return_index=True)
        return dict(zip(values.tolist(), np.split(rows[order], starts[1:])))

    def _size(self, scene: int, path: Path) -> tuple[int, int]:
        """Return (width, height), read once per scene: BOP scenes have one camera."""
        key = scene, path.suffix
        if key not in self._sizes:
            from PIL import Image

            with Image.open(path) as image:
                self._sizes[key] = image.size
        return self._sizes[key]


def read_keyframes(path: str | Path) -> set[tuple[int, int]]:
    """Read lines scene/image.  Raises InputError, with the line, for anything else."""
    pairs = set()
    try:
        lines = Path(path).read_text().splitlines()
    except FileNotFoundError:
        raise InputError("no such file", path=path) from None
    for number, line in enumerate(lines, start=1):
        if line.strip():
            scene, _, image = line.strip().partition("/")
            if not (scene.isdigit() and image.isdigit()):
                raise InputError(f"{line.strip()!r} is no key frame", path=path, line=number, fix="write 0048/000001")
            pairs.add((int(scene), int(image)))
    return pairs


def _objects(scene: BopScene) -> set[int]:
    return set() if scene.annotations is None else set(scene.annotations.object_ids.tolist())


def image_path(folder: Path, image: int) -> Path | None:
    """Return the file of an image of a scene folder, None where there is none."""
    for name, suffix in IMAGE_FOLDERS:
        path = folder / name / f"{image:06d}{suffix}"
        if path.exists():
            return path
    return None


def _kind(split: str) -> str:
    return "pbr" if "pbr" in split else "synt" if "synt" in split else "real"
