"""Boxes and classes that come from elsewhere: ground truth, a file, another program."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from poet_loc.model.backbone import Backbone, BackboneShape, Features, ImageBatch


class ExternalBoxes(Backbone):
    """Takes the feature maps of one backbone and the boxes that `supply` was given.

    The maps are what the pose network was trained on, so the backbone stays; only its detections are replaced.
    """

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone = backbone
        self._boxes: list[Tensor] = []

    def supply(self, boxes: Sequence[Tensor]) -> None:
        """Give the boxes of the next batch, per image (n, 6): x1, y1, x2, y2 (px of the batch), score, class."""
        self._boxes = [rows.float() for rows in boxes]

    def shape(self) -> BackboneShape:
        """Return the shape of the backbone underneath."""
        return self.backbone.shape()

    def extract(self, batch: ImageBatch) -> Features:
        """Return the maps of the backbone underneath."""
        features = self.backbone.extract(batch)
        return Features(features.maps, features.image_size)

    def detect(self, features: Features) -> list[Tensor]:
        """Return the boxes that were supplied.  Raises ValueError where their number is not the batch's."""
        if len(self._boxes) != len(features.maps[0]):
            raise ValueError(f"boxes of {len(self._boxes)} images were supplied for a batch of {len(features.maps[0])}")
        return [rows.to(features.maps[0].device) for rows in self._boxes]


def no_boxes() -> Tensor:
    """Return the rows of an image without a detection."""
    return torch.zeros(0, 6)
