"""Scaled-YOLOv4-CSP as a backbone: feature maps at strides 8, 16, 32, and boxes decoded from them."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Backbone, BackboneShape, Features, ImageBatch
from poet_loc.model.boxes import suppress
from poet_loc.model.yolov4_layers import Layer, csp_layers

STRIDES = (8, 16, 32)
Anchors = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class YoloOptions:
    """Scaled-YOLOv4-CSP and how its boxes are chosen."""

    class_count: int = 21
    confidence: float = 0.4
    """Least objectness, and least objectness times class probability."""
    overlap: float = 0.5
    """Boxes that overlap a better one by more than this IoU go."""
    agnostic_overlap: bool = False
    """Boxes of different classes suppress each other too."""
    max_detections: int = 300
    anchors: Anchors = (
        *((12.0, 16.0), (19.0, 36.0), (40.0, 28.0)),
        *((36.0, 75.0), (76.0, 55.0), (72.0, 146.0)),
        *((142.0, 110.0), (192.0, 243.0), (459.0, 401.0)),
    )
    """Width and height (px) of nine prior boxes, three per stride."""


class YoloV4Csp(Backbone):
    """Scaled-YOLOv4-CSP; its state dict has the official names `module_list.{i}.Conv2d`, `.BatchNorm2d`."""

    def __init__(self, options: YoloOptions = YoloOptions()) -> None:
        super().__init__()
        self.options = options
        self.layers, self.taps = csp_layers(options.class_count)
        inputs = [3 if i == 0 else self.layers[layer.sources[0]].channels for i, layer in enumerate(self.layers)]
        self.module_list = nn.ModuleList([_module(layer, n) for layer, n in zip(self.layers, inputs)])
        self._kept = {source for i, layer in enumerate(self.layers) for source in layer.sources if source != i - 1}

    def shape(self) -> BackboneShape:
        """Return channels 256, 512, 1024 at strides 8, 16, 32; image sides are multiples of 32."""
        channels = tuple(self.layers[tap].channels for tap in self.taps)
        return BackboneShape(channels, STRIDES, self.options.class_count, multiple=32)

    def extract(self, batch: ImageBatch) -> Features:
        """Return the maps that the detector's heads read.  Raises InputError for sides that 32 does not divide."""
        height, width = batch.size
        if height % 32 or width % 32:
            raise InputError(f"YOLOv4 needs image sides that are multiples of 32, not {width}x{height}")
        kept: dict[int, Tensor] = {}
        x = batch.images
        for number, (layer, module) in enumerate(zip(self.layers, self.module_list)):
            if layer.kind in ("head", "yolo"):
                continue
            if layer.kind == "route":
                parts = [kept.get(source, x) if source == number - 1 else kept[source] for source in layer.sources]
                x = parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)
            elif layer.kind == "add":
                x = x + kept[layer.sources[1]]
            else:
                x = module(x)
            if number in self._kept or number in self.taps:
                kept[number] = x
        return Features(tuple(kept[tap] for tap in self.taps), batch.size)

    def detect(self, features: Features) -> list[Tensor]:
        """Return per image (n, 6): x1, y1, x2, y2 (px, not clipped), objectness times probability, class from 1."""
        decoded = torch.cat([self._decode(level, m) for level, m in enumerate(features.maps)], dim=1)
        return [self._choose(rows) for rows in decoded.float()]

    def _decode(self, level: int, feature_map: Tensor) -> Tensor:
        """Turn a map into rows (B, n, 5 + classes): cx, cy, w, h (px), objectness, class probabilities."""
        raw = self.module_list[self.taps[level] + 1](feature_map)
        batch, _, height, width = raw.shape
        rows = raw.view(batch, 3, -1, height, width).permute(0, 1, 3, 4, 2).sigmoid()
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        cells = torch.stack([x, y], dim=-1).to(rows)
        anchors = torch.tensor(self.options.anchors[3 * level : 3 * level + 3]).to(rows)[:, None, None]
        centre = (2.0 * rows[..., :2] - 0.5 + cells) * STRIDES[level]
        size = (2.0 * rows[..., 2:4]).square() * anchors
        return torch.cat([centre, size, rows[..., 4:]], dim=-1).flatten(1, 3)

    def _choose(self, rows: Tensor) -> Tensor:
        options = self.options
        rows = rows[rows[:, 4] > options.confidence]
        scores = rows[:, 4:5] * rows[:, 5:]
        index, label = (scores > options.confidence).nonzero(as_tuple=True)
        boxes, score = rows[index, :4], scores[index, label]
        corners = torch.cat([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], dim=-1)
        apart = 0.0 if options.agnostic_overlap else 4096.0  # moves classes where they cannot overlap
        kept = suppress(corners + apart * label[:, None], score, options.overlap, options.max_detections)
        return torch.cat([corners[kept], score[kept, None], label[kept, None] + 1.0], dim=-1)

    def load_darknet(self, path: str | Path) -> None:
        """Read a Darknet weight file: a header, then each convolution's norm (or bias) and kernel as float32.

        Raises InputError where its length is not what the layers need.
        """
        data = Path(path).read_bytes()
        if len(data) < 20:
            raise InputError("too short for a Darknet weight file", path=path)
        major, minor = np.frombuffer(data, "<i4", 2)
        start = 20 if major * 10 + minor >= 2 else 16
        if (len(data) - start) % 4:
            raise InputError("no whole number of float32 follows the header", path=path)
        values = torch.from_numpy(np.frombuffer(data, "<f4", offset=start).copy())
        slots = [tensor for module in self.module_list for tensor in _darknet_order(module)]
        needed = sum(slot.numel() for slot in slots)
        if needed != len(values):
            raise InputError(
                f"{len(values)} weights where {needed} are needed for {self.options.class_count} classes", path=path
            )
        with torch.no_grad():
            for slot, part in zip(slots, values.split([slot.numel() for slot in slots])):
                slot.copy_(part.view_as(slot))


def _module(layer: Layer, inputs: int) -> nn.Module:
    if layer.kind == "conv":
        conv = nn.Conv2d(inputs, layer.channels, layer.size, layer.stride, layer.size // 2, bias=False)
        norm = nn.BatchNorm2d(layer.channels, eps=1e-4, momentum=0.03)
        return nn.Sequential(OrderedDict(Conv2d=conv, BatchNorm2d=norm, activation=nn.Mish()))
    if layer.kind == "head":
        return nn.Sequential(OrderedDict(Conv2d=nn.Conv2d(inputs, layer.channels, 1)))
    if layer.kind == "pool":
        return nn.MaxPool2d(layer.size, stride=1, padding=layer.size // 2)
    if layer.kind == "upsample":
        return nn.Upsample(scale_factor=2.0, mode="nearest")
    return nn.Identity()


def _darknet_order(module: nn.Module) -> list[Tensor]:
    if not isinstance(module, nn.Sequential):
        return []
    conv = module.get_submodule("Conv2d")
    assert isinstance(conv, nn.Conv2d)
    if conv.bias is not None:
        return [conv.bias, conv.weight]
    norm = module.get_submodule("BatchNorm2d").state_dict(keep_vars=True)
    return [*(norm[name] for name in ("bias", "weight", "running_mean", "running_var")), conv.weight]
