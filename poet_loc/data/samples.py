"""What every pose data set gives: an image, its camera, and the objects in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.model.matcher import PoseTargets
from poet_loc.model.queries import normalise_boxes


@dataclass(frozen=True)
class ImageRecord:
    """One image of a data set and what is known about it; no pixels yet."""

    path: Path
    size: tuple[int, int]
    """(width, height) px."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy px; NaN where the data set does not tell."""
    labels: NDArray[np.int64]
    """(n,) classes from 1."""
    boxes_px: NDArray[np.float64]
    """(n, 4) x, y, width, height of the whole object."""
    translations_m: NDArray[np.float64]
    """(n, 3) of T_cam_obj."""
    rotations: NDArray[np.float64]
    """(n, 3, 3) of T_cam_obj."""
    kind: str = "real"
    """real, synt (RGBA, to be pasted over a background) or pbr."""
    scene_id: int = 0
    image_id: int = 0


@dataclass(frozen=True)
class PoseSample:
    """One image ready for the network."""

    image: Tensor
    """(3, h, w) float32, RGB in [0, 1]."""
    targets: PoseTargets
    intrinsics: Tensor
    """(4,) fx, fy, cx, cy px."""
    record: ImageRecord


class PoseDataset(Protocol):
    """Image records by index."""

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Object id of class 1, 2, ..."""
        ...

    def __len__(self) -> int: ...

    def record(self, index: int) -> ImageRecord:
        """Return an image's record."""
        ...


def read_image(path: str | Path, mode: str = "RGB") -> NDArray[np.uint8]:
    """Read an image (h, w, channels).  Raises InputError where it cannot be read."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert(mode))
    except FileNotFoundError:
        raise InputError("no such image", path=path) from None
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"not a readable image ({error})", path=path) from None


def to_tensor(image: NDArray[np.uint8]) -> Tensor:
    """Turn RGB bytes (h, w, 3) into (3, h, w) float32 in [0, 1]; no resize, no normalisation, as published."""
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255.0


def targets_of(record: ImageRecord) -> PoseTargets:
    """Clip boxes to the image, drop the empty ones, and divide by the image's size."""
    corners, keep = clipped_corners(record)
    return PoseTargets(
        normalise_boxes(corners[keep], (record.size[1], record.size[0])),
        torch.from_numpy(np.asarray(record.labels, dtype=np.int64))[keep],
        torch.from_numpy(np.array(record.translations_m, dtype=np.float32).reshape(-1, 3))[keep],
        torch.from_numpy(np.array(record.rotations, dtype=np.float32).reshape(-1, 3, 3))[keep],
    )


def clipped_corners(record: ImageRecord) -> tuple[Tensor, Tensor]:
    """Return x1, y1, x2, y2 (n, 4) of an image's boxes within the image, px, and which of them are not empty (n,)."""
    width, height = record.size
    corners = torch.from_numpy(np.array(record.boxes_px, dtype=np.float32).reshape(-1, 4))
    corners[:, 2:] += corners[:, :2]
    corners[:, 0::2].clamp_(0, width)
    corners[:, 1::2].clamp_(0, height)
    return corners, (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])


def class_of_object(object_ids: Sequence[int]) -> dict[int, int]:
    """Return the class, from 1, of each object id."""
    return {object_id: label for label, object_id in enumerate(object_ids, start=1)}
