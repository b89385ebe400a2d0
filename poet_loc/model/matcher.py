"""Which query answers for which target object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from poet_loc.model.boxes import generalised_iou
from poet_loc.model.queries import QueryBoxes, corners_of_boxes

BoxMode = Literal["gt", "jitter", "backbone"]
MIN_GENERALISED_IOU = 0.5
_TIE_BREAK = 1e-3  # of jittered boxes; below what a wrong class costs


@dataclass(frozen=True)
class PoseTargets:
    """The objects of one image."""

    boxes: Tensor
    """(n, 4) cx, cy, w, h in shares of the image."""
    labels: Tensor
    """(n,) int64 classes, from 1."""
    translation: Tensor
    """(n, 3) m, camera axes."""
    rotation: Tensor
    """(n, 3, 3) of T_cam_obj."""
    jittered_boxes: Tensor | None = None
    """(n, 4) boxes to ask about instead of the exact ones."""

    def to(self, device: torch.device | str) -> PoseTargets:
        """Return the same targets on another device."""
        jittered = None if self.jittered_boxes is None else self.jittered_boxes.to(device)
        boxes, labels = self.boxes.to(device), self.labels.to(device)
        return PoseTargets(boxes, labels, self.translation.to(device), self.rotation.to(device), jittered)


@dataclass(frozen=True)
class Matches:
    """Pairs of queries and targets of a whole batch, in order of the images."""

    images: Tensor
    """(K,) int64."""
    queries: Tensor
    """(K,) int64, index within the image's queries."""
    targets: Tensor
    """(K,) int64, index within the image's targets."""

    def __len__(self) -> int:
        return len(self.images)


@torch.no_grad()
def match(
    queries: QueryBoxes,
    targets: Sequence[PoseTargets],
    mode: BoxMode,
    class_specific: bool = True,
    cost_box: float = 1.0,
    cost_class: float = 1.0,
) -> Matches:
    """Assign each target at most one query of its image, at the least total cost.

    gt: by the distance of the boxes; jitter: by class, ties by distance; backbone: by the distance of the centres and
    class, and a pair counts only with a generalised IoU of at least 0.5 and, where heads are class-specific, the same
    class.
    """
    images, rows, columns = [], [], []
    for image, (target, count) in enumerate(zip(targets, queries.counts)):
        boxes, classes = queries.boxes[image, :count], queries.classes[image, :count]
        if count == 0 or len(target.labels) == 0:
            continue
        wrong_class = (classes[:, None] != target.labels[None]).float()
        if mode == "gt":
            cost = cost_box * torch.cdist(boxes, target.boxes, p=1)
        elif mode == "jitter":
            cost = cost_class * wrong_class + _TIE_BREAK * torch.cdist(boxes, target.boxes, p=1)
        else:
            cost = cost_box * torch.cdist(boxes[:, :2], target.boxes[:, :2], p=1) + cost_class * wrong_class
        row, column = (torch.as_tensor(index) for index in linear_sum_assignment(cost.cpu().numpy()))
        if mode == "backbone":
            overlap = generalised_iou(corners_of_boxes(boxes.cpu()[row]), corners_of_boxes(target.boxes.cpu()[column]))
            keep = overlap.diagonal() >= MIN_GENERALISED_IOU
            if class_specific:
                keep &= wrong_class.cpu()[row, column] == 0
            row, column = row[keep], column[keep]
        images.append(torch.full_like(row, image))
        rows.append(row)
        columns.append(column)
    device = queries.boxes.device
    if not images:
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        return Matches(empty, empty, empty)
    return Matches(*(torch.cat(index).to(device) for index in (images, rows, columns)))
