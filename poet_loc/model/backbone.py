"""What stands under the pose network: any detector with three methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class ImageBatch:
    """Images of different sizes in one tensor, padded with zeros at the bottom and at the right."""

    images: Tensor
    """(B, 3, H, W) float32, RGB in [0, 1]."""
    mask: Tensor
    """(B, H, W) bool, True where padded."""
    intrinsics: Tensor | None = None
    """(B, 4) fx, fy, cx, cy in pixels of the images."""

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the padded batch in pixels."""
        return int(self.images.shape[-2]), int(self.images.shape[-1])

    def to(self, device: torch.device | str) -> ImageBatch:
        """Return the same batch on another device."""
        intrinsics = None if self.intrinsics is None else self.intrinsics.to(device)
        return ImageBatch(self.images.to(device), self.mask.to(device), intrinsics)


def batch_images(images: Sequence[Tensor], intrinsics: Tensor | None = None, multiple: int = 1) -> ImageBatch:
    """Stack images (3, h, w), padded to the largest height and width, rounded up to a multiple (px)."""
    height = -(-max(int(image.shape[-2]) for image in images) // multiple) * multiple
    width = -(-max(int(image.shape[-1]) for image in images) // multiple) * multiple
    padded = images[0].new_zeros(len(images), images[0].shape[0], height, width)
    mask = torch.ones(len(images), height, width, dtype=torch.bool, device=padded.device)
    for index, image in enumerate(images):
        padded[index, :, : image.shape[-2], : image.shape[-1]] = image
        mask[index, : image.shape[-2], : image.shape[-1]] = False
    return ImageBatch(padded, mask, intrinsics)


def mask_of_level(mask: Tensor, size: Sequence[int]) -> Tensor:
    """Return the padding mask (B, H, W) at a map's (h, w), by nearest neighbour."""
    return F.interpolate(mask[:, None].float(), size=tuple(size), mode="nearest")[:, 0].bool()


@dataclass(frozen=True)
class BackboneShape:
    """What a network has to know of a backbone before it has seen an image."""

    channels: tuple[int, ...]
    """Of each map, finest first."""
    strides: tuple[int, ...]
    """Pixels per cell of each map."""
    class_count: int
    """Classes it detects, numbered from 1."""
    multiple: int = 1
    """Image sides must be multiples of it (px)."""


@dataclass(frozen=True)
class Features:
    """What `Backbone.extract` found in a batch."""

    maps: tuple[Tensor, ...]
    """(B, C_l, h_l, w_l) each, finest first."""
    image_size: tuple[int, int]
    """(H, W) of the padded batch in pixels."""
    state: Any = None
    """Whatever the backbone's own `detect` needs besides the maps."""


class Backbone(nn.Module, ABC):
    """A detector under the pose network. Its parameters are frozen unless it says otherwise."""

    @abstractmethod
    def shape(self) -> BackboneShape:
        """Return channels, strides and classes."""

    @abstractmethod
    def extract(self, batch: ImageBatch) -> Features:
        """Return the feature maps of a batch."""

    @abstractmethod
    def detect(self, features: Features) -> list[Tensor]:
        """Return per image (n, 6) float32: x1, y1, x2, y2 (px of the batch), score, class >= 1."""
