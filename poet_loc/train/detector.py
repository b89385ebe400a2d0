"""Trains the small detector on packed BOP scenes: heat map, box sides, object coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from poet_loc.data.packed import AugmentOptions, PackedImages, Sample, load_models, pack
from poet_loc.model.backbone import ImageBatch, batch_images
from poet_loc.model.small_detector import STRIDE, DetectorHeads, SmallDetector, SmallDetectorOptions
from poet_loc.train.steps import Losses, StepOptions, train_steps


@dataclass(frozen=True)
class DetectorTargets:
    """What the heads should say, one row per image."""

    heat: Tensor
    """(B, C, h, w) 1 at centres, a Gaussian around them."""
    sides: Tensor
    """(B, 4, h, w) log distances (cells)."""
    weight: Tensor
    """(B, 1, h, w) weight of the sides."""
    points: Tensor
    """(B, 3, h, w)"""
    seen: Tensor
    """(B, 1, h, w)"""


def image_batch(samples: list[Sample], multiple: int = 16) -> ImageBatch:
    """Return the samples' images as the network wants them, padded to multiples (px)."""
    images = [torch.from_numpy(sample.image).permute(2, 0, 1).float() / 255.0 for sample in samples]
    return batch_images(images, torch.from_numpy(np.stack([sample.intrinsics for sample in samples])).float(), multiple)


def targets_of(samples: list[Sample], size: tuple[int, int], class_count: int) -> DetectorTargets:
    """Return the heads' targets for maps of size (h, w) cells."""
    height, width = size
    count = len(samples)
    heat = np.zeros((count, class_count, height, width), np.float32)
    sides, weight = np.zeros((count, 4, height, width), np.float32), np.zeros((count, 1, height, width), np.float32)
    points, seen = np.zeros((count, 3, height, width), np.float32), np.zeros((count, 1, height, width), np.float32)
    y, x = np.mgrid[0:height, 0:width] + 0.5
    for row, sample in enumerate(samples):
        for label, box in zip(sample.classes, sample.boxes / STRIDE):
            middle, reach = (box[:2] + box[2:]) / 2, np.maximum(0.11 * (box[2:] - box[:2]), 0.45)
            bump = np.exp(-0.5 * (((x - middle[0]) / reach[0]) ** 2 + ((y - middle[1]) / reach[1]) ** 2))
            peak = int(np.clip(middle[1], 0, height - 1)), int(np.clip(middle[0], 0, width - 1))
            bump[peak] = 1.0
            distances = np.stack([x - box[0], y - box[1], box[2] - x, box[3] - y])
            here = (bump > 0.3) & (bump > weight[row, 0]) & (distances.min(0) > 0.1)
            sides[row][:, here] = np.log(distances[:, here])
            weight[row, 0][here] = bump[here]
            heat[row, label - 1] = np.maximum(heat[row, label - 1], bump)
        rows, columns = sample.surface.shape[:2]
        known = ~np.isnan(sample.surface[..., 0])
        seen[row, 0, :rows, :columns] = known
        points[row, :, :rows, :columns] = np.nan_to_num(sample.surface).transpose(2, 0, 1)
    return DetectorTargets(*(torch.from_numpy(array) for array in (heat, sides, weight, points, seen)))


def detector_losses(heads: DetectorHeads, targets: DetectorTargets) -> Losses:
    """Return the losses: penalty-reduced focal loss (CornerNet, 2018, eq. 1), sides, object coordinates, seen."""
    share = heads.heat.sigmoid().clamp(1e-4, 1 - 1e-4)
    centres = targets.heat == 1
    hit = -((1 - share) ** 2 * share.log())[centres].sum()
    miss = -((1 - targets.heat) ** 4 * share**2 * (1 - share).log())[~centres].sum()
    total = targets.weight.sum().clamp(min=1.0)
    sides = ((heads.sides - targets.sides).abs() * targets.weight).sum() / total
    overlap = (targets.weight * (1 - _overlap(heads.sides, targets.sides))).sum() / total
    cells = targets.seen.sum().clamp(min=1.0)
    points = F.smooth_l1_loss(heads.points, targets.points, beta=0.05, reduction="none")
    return {
        "heat": (hit + miss) / centres.sum().clamp(min=1),
        "sides": 0.5 * sides + overlap,
        "points": 4.0 * (points * targets.seen).sum() / cells,
        "seen": 0.5 * F.binary_cross_entropy_with_logits(heads.seen, targets.seen),
    }


def _overlap(sides: Tensor, true_sides: Tensor) -> Tensor:
    """Return the IoU (B, 1, h, w) of boxes around the same cell given by log distances."""
    a, b = sides.clamp(max=5.0).exp(), true_sides.exp()
    both = torch.minimum(a, b)
    inner = (both[:, 0] + both[:, 2]) * (both[:, 1] + both[:, 3])
    area_a, area_b = ((s[:, 0] + s[:, 2]) * (s[:, 1] + s[:, 3]) for s in (a, b))
    return (inner / (area_a + area_b - inner).clamp(min=1e-6))[:, None]


@dataclass(frozen=True)
class TrainDetectorOptions:
    """Train the small detector."""

    data: Path
    """BOP data set with models/ and the splits."""
    cache: Path
    """Folder of the packed scenes."""
    steps: StepOptions
    """Length and speed."""
    network: SmallDetectorOptions = field(default_factory=SmallDetectorOptions)
    augment: AugmentOptions = field(default_factory=AugmentOptions)
    train_split: str = "train"
    val_split: str = "val"
    val_images: int = 200
    """Images of the validation split that are looked at."""
    scenes: tuple[str, ...] = field(default_factory=tuple)
    """Names of the training scenes; empty: all that are there at the start."""


def batch_numbers(step: int, batch: int, total: int, seed: int) -> np.ndarray:
    """Return the samples of a step: a new order in each pass over the data, from the step alone."""
    places = np.arange(step * batch, (step + 1) * batch)
    orders = {
        int(turn): np.random.default_rng([seed, 20, int(turn)]).permutation(total)
        for turn in np.unique(places // total)
    }
    return np.array([orders[int(place // total)][place % total] for place in places])


def train_detector(options: TrainDetectorOptions) -> SmallDetector:
    """Train (or go on training) a detector and return its averaged weights."""
    models = load_models(options.data / "models")
    scenes = pack(options.data / options.train_split, options.cache / options.train_split)
    train = PackedImages([s for s in scenes if not options.scenes or s.name in options.scenes], models)
    val = PackedImages(pack(options.data / options.val_split, options.cache / options.val_split), models)
    torch.manual_seed(options.steps.seed)
    network = SmallDetector(options.network)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    seed = options.steps.seed

    def losses(module: SmallDetector, step: int) -> Losses:
        module.train()
        numbers = batch_numbers(step, options.steps.batch, len(train), seed)
        samples = [
            train.sample(n, np.random.default_rng([seed, 21, step, i]), options.augment) for i, n in enumerate(numbers)
        ]
        batch = image_batch(samples)
        heads = module.extract(batch).state
        with torch.autocast("cpu", enabled=False):
            return detector_losses(heads, targets_of(samples, heads.heat.shape[-2:], options.network.class_count))

    def report(module: SmallDetector, step: int) -> dict[str, float]:
        return validate_detector(module, val, options.val_images, options.network.class_count)

    return train_steps(network, losses, options.steps, report)


@torch.no_grad()
def validate_detector(module: SmallDetector, val: PackedImages, count: int, class_count: int) -> dict[str, float]:
    """Return losses, and precision and recall at IoU 0.5, on validation images."""
    module.eval()
    sums: dict[str, float] = {}
    found, right, present, distance = 0, 0, 0, 0.0
    starts = range(0, min(count, len(val)), 10)
    for start in starts:
        samples = [val.sample(n, np.random.default_rng(0)) for n in range(start, min(start + 10, len(val)))]
        features = module.extract(image_batch(samples))
        targets = targets_of(samples, features.state.heat.shape[-2:], class_count)
        for name, value in detector_losses(features.state, targets).items():
            sums["val_" + name] = sums.get("val_" + name, 0.0) + float(value) / len(starts)
        error = (features.state.points - targets.points).norm(dim=1, keepdim=True)[targets.seen > 0]
        distance += float(error.median()) / len(starts)
        for sample, rows in zip(samples, module.detect(features)):
            found, present = found + len(rows), present + len(sample.classes)
            right += sum(_is_right(row, sample) for row in rows.numpy())
    return {**sums, "val_point_error": distance, "precision": right / max(found, 1), "recall": right / max(present, 1)}


def _is_right(row: np.ndarray, sample: Sample) -> bool:
    same = sample.boxes[sample.classes == int(row[5])]
    if not len(same):
        return False
    low, high = np.maximum(same[:, :2], row[:2]), np.minimum(same[:, 2:], row[2:4])
    inner = np.clip(high - low, 0, None).prod(1)
    areas = (same[:, 2:] - same[:, :2]).prod(1) + (row[2:4] - row[:2]).prod()
    return bool(np.any(inner / (areas - inner) > 0.5))
