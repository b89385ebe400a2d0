"""Object queries from boxes: one query per box, dummies up to a fixed number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

DUMMY_BOX = -1.0
DUMMY_CODE = -10.0


@dataclass(frozen=True)
class QueryBoxes:
    """The boxes that are asked about, dummies filled in."""

    boxes: Tensor
    """(B, Q, 4) cx, cy, w, h in shares of the image's width and height; -1 for dummies."""
    classes: Tensor
    """(B, Q) int64; -1 for dummies."""
    scores: Tensor
    """(B, Q); 0 for dummies."""
    counts: tuple[int, ...]
    """Queries per image that are no dummies; they come first."""

    def to(self, device: torch.device | str) -> QueryBoxes:
        """Return the same queries on another device."""
        return QueryBoxes(self.boxes.to(device), self.classes.to(device), self.scores.to(device), self.counts)


def normalise_boxes(corners: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Turn x1, y1, x2, y2 (px) into cx, cy, w, h in shares of (H, W); float32, in the published order of operations."""
    corners = corners.float()
    height, width = image_size
    x1, y1, x2, y2 = corners.unbind(-1)
    return torch.stack([(x1 + x2) / 2 / width, (y1 + y2) / 2 / height, (x2 - x1) / width, (y2 - y1) / height], dim=-1)


def corners_of_boxes(boxes: Tensor) -> Tensor:
    """Turn cx, cy, w, h into x1, y1, x2, y2, in the same units."""
    cx, cy, w, h = boxes.unbind(-1)
    return torch.stack([cx - 0.5 * w, cy - 0.5 * h, cx + 0.5 * w, cy + 0.5 * h], dim=-1)


def queries_from_detections(
    detections: Sequence[Tensor | None], image_size: tuple[int, int], count: int, device: torch.device | str = "cpu"
) -> QueryBoxes:
    """Make `count` queries per image of detections (n, 6): x1, y1, x2, y2 (px), score, class.

    Boxes are divided by the size (H, W) of the padded batch.  More than `count`: the best by score, in order of
    score; else the detector's order is kept.
    """
    boxes, classes, scores = [], [], []
    for found in detections:
        rows = torch.zeros(0, 6, device=device) if found is None else found.to(device).float()
        if len(rows) > count:
            rows = rows[torch.sort(rows[:, 4], descending=True, stable=True).indices[:count]]
        boxes.append(normalise_boxes(rows[:, :4], image_size))
        scores.append(rows[:, 4])
        classes.append(rows[:, 5].long())
    return stack_queries(boxes, classes, count, scores)


def stack_queries(
    boxes: Sequence[Tensor], classes: Sequence[Tensor], count: int, scores: Sequence[Tensor] | None = None
) -> QueryBoxes:
    """Fill boxes (n, 4) cx, cy, w, h (shares) and classes (n,) of each image with dummies.

    Every image gets `count` queries, or as many as the image with the most boxes.
    """
    count = max([count, *(len(rows) for rows in boxes)])
    device = boxes[0].device
    filled = torch.full((len(boxes), count, 4), DUMMY_BOX, device=device)
    labels = torch.full((len(boxes), count), -1, dtype=torch.int64, device=device)
    values = torch.zeros(len(boxes), count, device=device)
    for index, rows in enumerate(boxes):
        filled[index, : len(rows)] = rows
        labels[index, : len(rows)] = classes[index]
        values[index, : len(rows)] = 1.0 if scores is None else scores[index]
    return QueryBoxes(filled, labels, values, tuple(len(rows) for rows in boxes))


def real_queries(queries: QueryBoxes) -> Tensor:
    """Return (B, Q) bool, True where a query is no dummy."""
    counts = torch.tensor(queries.counts, device=queries.boxes.device)
    return torch.arange(queries.boxes.shape[1], device=queries.boxes.device)[None] < counts[:, None]
