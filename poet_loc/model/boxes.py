"""Overlap of boxes and what follows from it: IoU, generalised IoU, non-maximum suppression."""

from __future__ import annotations

import torch
from torch import Tensor


def iou(a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection over union of boxes x1, y1, x2, y2: (N, 4), (M, 4) -> (N, M)."""
    return _overlaps(a, b)[0]


def generalised_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return IoU minus the share of the enclosing box that neither covers: (N, 4), (M, 4) -> (N, M).

    Source: H. Rezatofighi et al., "Generalized intersection over union" (2019), algorithm 1.
    """
    overlap, union = _overlaps(a, b)
    lower = torch.minimum(a[:, None, :2], b[None, :, :2])
    upper = torch.maximum(a[:, None, 2:], b[None, :, 2:])
    hull = (upper - lower).clamp(min=0).prod(-1)
    return overlap - (hull - union) / hull


def _overlaps(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    areas_a, areas_b = ((boxes[:, 2:] - boxes[:, :2]).prod(-1) for boxes in (a, b))
    lower = torch.maximum(a[:, None, :2], b[None, :, :2])
    upper = torch.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = (upper - lower).clamp(min=0).prod(-1)
    union = areas_a[:, None] + areas_b[None] - shared
    return shared / union, union


def suppress(boxes: Tensor, scores: Tensor, threshold: float, at_most: int = 300) -> Tensor:
    """Return the indices of at most `at_most` boxes (N, 4) that no better one overlaps by more than `threshold` IoU.

    The best comes first; equal scores keep their order.
    """
    order = torch.argsort(scores, descending=True, stable=True)
    kept: list[Tensor] = []
    while len(order) and len(kept) < at_most:
        best, order = order[0], order[1:]
        kept.append(best)
        order = order[iou(boxes[best][None], boxes[order])[0] <= threshold]
    return torch.stack(kept) if kept else order
