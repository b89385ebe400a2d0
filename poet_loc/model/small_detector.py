"""A small anchor-free detector that is trained from scratch: residual trunk, one pyramid level, centre heat map.

Heat map and box distances at stride 8 as in X. Zhou et al., "Objects as points" (2019), with distances to the four
sides (Z. Tian et al., "FCOS", 2019). A third head says for each cell which point of the object it sees (object
coordinates, as in H. Wang et al., "NOCS", 2019) and whether it sees one: it teaches the trunk about poses, and its
output belongs to the stride-8 map that the pose network reads.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from poet_loc.model.backbone import Backbone, BackboneShape, Features, ImageBatch
from poet_loc.model.residual import ResidualBlock, convolve

STRIDE = 8
"""Pixels per cell of the heads."""


@dataclass(frozen=True)
class SmallDetectorOptions:
    """Everything that the weights of a small detector depend on, and its thresholds."""

    class_count: int = 10
    """Object classes, numbered from 1."""
    widths: tuple[int, int, int, int] = (64, 128, 256, 256)
    """Channels at strides 4, 8, 16, 32; multiples of 32 keep matrix units busy."""
    blocks: tuple[int, int, int, int] = (1, 2, 2, 2)
    """Residual blocks at strides 4, 8, 16, 32."""
    pyramid_dim: int = 96
    """Channels of the stride-8 pyramid map."""
    score_threshold: float = 0.3
    """Detections below it are left out."""
    one_per_class: bool = True
    """Keep only the best peak of each class: every object is there at most once."""
    max_detections: int = 20
    """Per image."""


@dataclass(frozen=True)
class DetectorHeads:
    """What the heads say about each cell of the stride-8 map."""

    heat: Tensor
    """(B, C, h, w) logits of object centres."""
    sides: Tensor
    """(B, 4, h, w) log distances (cells) from the cell's centre to left, top, right, bottom."""
    points: Tensor
    """(B, 3, h, w) object coordinates in shares of the diameter."""
    seen: Tensor
    """(B, 1, h, w) logit of seeing an object."""


class SmallDetector(Backbone):
    """The detector of the embedded pose sensor; maps at strides 8, 16 and 32."""

    def __init__(self, options: SmallDetectorOptions) -> None:
        super().__init__()
        self.options = options
        widths, pyramid = options.widths, options.pyramid_dim
        # 4x4 pixels become the channels of one cell: no map is ever finer than stride 4
        self.patches = nn.PixelUnshuffle(4)
        entries = [convolve(48, widths[0])] + [convolve(a, b, 2) for a, b in pairwise(widths)]
        self.stages = nn.ModuleList(
            nn.Sequential(entry, *[ResidualBlock(width) for _ in range(count)])
            for entry, width, count in zip(entries, widths, options.blocks)
        )
        self.lateral = nn.ModuleList(nn.Conv2d(width, pyramid, 1) for width in widths[1:])
        self.merge = convolve(pyramid, pyramid)
        self.heat = _head(pyramid, options.class_count, -4.6)  # a prior of 1 %, T.-Y. Lin et al., "RetinaNet" (2017)
        self.sides = _head(pyramid, 4, 1.0)
        self.surface = _head(pyramid, 4, 0.0)

    def shape(self) -> BackboneShape:
        """Return channels, strides and classes."""
        widths = self.options.widths
        channels = (self.options.pyramid_dim + 4, widths[2], widths[3])
        return BackboneShape(channels, (8, 16, 32), self.options.class_count, multiple=16)

    def extract(self, batch: ImageBatch) -> Features:
        """Return the maps: stride 8 holds the pyramid, the object coordinates and the share seen."""
        finer = self.patches((batch.images - 0.45) / 0.25).contiguous(memory_format=torch.channels_last)
        maps = []
        for stage in self.stages:
            finer = stage(finer)
            maps.append(finer)
        level = self.lateral[2](maps[3])
        for lateral, source in ((self.lateral[1], maps[2]), (self.lateral[0], maps[1])):
            level = lateral(source) + F.interpolate(level, size=source.shape[-2:], mode="nearest")
        level = self.merge(level)
        surface = self.surface(level)
        heads = DetectorHeads(
            self.heat(level).float(), self.sides(level).float(), surface[:, :3].float(), surface[:, 3:].float()
        )
        shown = torch.cat([level.float(), heads.points.clamp(-1.5, 1.5), heads.seen.sigmoid()], dim=1)
        return Features((shown, maps[2].float(), maps[3].float()), batch.size, heads)

    def detect(self, features: Features) -> list[Tensor]:
        """Return per image (n, 6) float32: x1, y1, x2, y2 (px of the batch), score, class >= 1."""
        heads: DetectorHeads = features.state
        heat = heads.heat.sigmoid()
        peaks = heat * (F.max_pool2d(heat, 3, stride=1, padding=1) == heat)
        return [self._detect_one(*rows) for rows in zip(peaks, heads.sides)]

    def _detect_one(self, peaks: Tensor, sides: Tensor) -> Tensor:
        width = peaks.shape[-1]
        count = 1 if self.options.one_per_class else min(self.options.max_detections, peaks[0].numel())
        scores, cells = peaks.flatten(1).topk(count, dim=1)  # (C, count)
        classes = torch.arange(1, len(peaks) + 1, device=peaks.device)[:, None].expand_as(cells)
        scores, order = scores.flatten().sort(descending=True, stable=True)
        keep = order[: self.options.max_detections][
            scores[: self.options.max_detections] > self.options.score_threshold
        ]
        cells, classes, scores = cells.flatten()[keep], classes.flatten()[keep], scores[: len(keep)]
        centre = torch.stack([cells % width, torch.div(cells, width, rounding_mode="floor")], -1).float() + 0.5
        reach = sides.flatten(1)[:, cells].T.exp()  # (n, 4)
        corners = torch.cat([centre - reach[:, :2], centre + reach[:, 2:]], dim=1) * STRIDE
        return torch.cat([corners, scores[:, None], classes[:, None].float()], dim=1)


def _head(inputs: int, outputs: int, bias: float) -> nn.Sequential:
    last = nn.Conv2d(inputs, outputs, 1)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.constant_(last.bias, bias)  # type: ignore[arg-type]
    return nn.Sequential(nn.Conv2d(inputs, inputs, 3, padding=1, bias=False), nn.BatchNorm2d(inputs), nn.ReLU(), last)
