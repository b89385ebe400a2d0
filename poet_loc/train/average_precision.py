"""Average precision of a detector, as COCO counts it: detections sorted by score, each true box found once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def overlaps(a: Array, b: Array) -> Array:
    """Return the IoU (N, M) of boxes (N, 4) and (M, 4), x1, y1, x2, y2."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    inner = np.clip(high - low, 0, None).prod(-1)
    area_a, area_b = ((box[:, 2:] - box[:, :2]).prod(-1) for box in (a, b))
    return np.asarray(inner / np.maximum(area_a[:, None] + area_b - inner, 1e-9))


def average_precision(detections: Sequence[Array], truth: Sequence[Array], threshold: float) -> float:
    """Return the area under the precision envelope over recall for one class, 0..1; NaN without true boxes.

    detections (n, 5) x1, y1, x2, y2, score and truth (m, 4) of each image.
    """
    total = sum(len(boxes) for boxes in truth)
    if total == 0:
        return float("nan")
    rows = [(row[4], image, row[:4]) for image, found in enumerate(detections) for row in found]
    rows.sort(key=lambda row: -row[0])
    taken = [np.zeros(len(boxes), bool) for boxes in truth]
    right = np.zeros(len(rows))
    for index, (_, image, box) in enumerate(rows):
        if len(truth[image]) == 0:
            continue
        iou = np.where(taken[image], -1.0, overlaps(box[None], truth[image])[0])
        best = int(np.argmax(iou))
        if iou[best] >= threshold:
            taken[image][best] = True
            right[index] = 1.0
    found = np.cumsum(right)
    precision = found / np.arange(1, len(rows) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1] if len(rows) else precision
    steps = np.diff(np.concatenate([[0.0], found / total]))
    return float((steps * envelope).sum())


def mean_average_precision(
    detections: Sequence[Array], truth: Sequence[Array], thresholds: Sequence[float] = (0.5,)
) -> float:
    """Return the mean over classes and thresholds, 0..1; rows (n, 6) end in score, class, true ones (m, 5) in class."""
    labels = np.unique(np.concatenate([boxes[:, 4] for boxes in truth]))
    values = [
        average_precision(
            [found[found[:, 5] == label][:, :5] for found in detections],
            [boxes[boxes[:, 4] == label][:, :4] for boxes in truth],
            threshold,
        )
        for label in labels
        for threshold in thresholds
    ]
    return float(np.nanmean(values)) if values else float("nan")
