"""Mask R-CNN and Faster R-CNN of torchvision as backbones; needs the optional package torchvision.

torchvision's compiled part belongs to one version of torch: torch 2.5 with torchvision 0.20, 2.6 with 0.21, 2.7 with
0.22, 2.8 with 0.23 and so on.  A pair that does not fit does not import, and then only these two backbones are missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Backbone, BackboneShape, Features, ImageBatch

LMO_LABELS = ((1, 1), (5, 2), (6, 3), (8, 4), (9, 5), (10, 6), (11, 7), (12, 8))
"""Labels of the published LM-O detector (BOP object ids) and the classes that the pose network was trained with."""


@dataclass(frozen=True)
class TorchvisionOptions:
    """A ResNet-50 FPN detector of torchvision, with the ways of the official wrapper as defaults."""

    masks: bool = True
    """Mask R-CNN; else Faster R-CNN.  Masks are not computed, their weights are kept."""
    label_count: int = 22
    """Labels of the detector with the background: YCB-V 22, LM-O 16."""
    labels: tuple[tuple[int, int], ...] = ()
    """Pairs (detector's label, class); other labels are dropped.  Empty: the label is the class."""
    confidence: float = 0.05
    """Least score; the official code ignores its own threshold and keeps torchvision's."""
    overlap: float = 0.5
    max_detections: int = 100
    normalise: bool = False
    """Subtract ImageNet's mean and divide by its deviation; the official wrapper does not, nor does it resize."""


class TorchvisionDetector(Backbone):
    """Feature maps '2', '3' and 'pool' of the pyramid: 256 channels each at strides 16, 32, 64."""

    def __init__(self, options: TorchvisionOptions = TorchvisionOptions()) -> None:
        super().__init__()
        self.options = options
        model = _build(options)
        self.backbone, self.rpn, self.roi_heads = model.backbone, model.rpn, model.roi_heads
        self.roi_heads.has_mask = _no_masks

    def shape(self) -> BackboneShape:
        """Return three maps of 256 channels at strides 16, 32, 64."""
        classes = len(self.options.labels) or self.options.label_count - 1
        return BackboneShape((256, 256, 256), (16, 32, 64), classes)

    def extract(self, batch: ImageBatch) -> Features:
        """Return the three coarsest maps of the pyramid; `state` keeps all of them for `detect`."""
        images = batch.images
        if self.options.normalise:
            mean, deviation = (
                images.new_tensor(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
            )
            images = (images - mean) / deviation
        pyramid = self.backbone(images)
        return Features((pyramid["2"], pyramid["3"], pyramid["pool"]), batch.size, (images, pyramid))

    def detect(self, features: Features) -> list[Tensor]:
        """Return per image (n, 6): x1, y1, x2, y2 (px), score, class."""
        from torchvision.models.detection.image_list import ImageList

        images, pyramid = features.state
        sizes = [features.image_size] * len(images)
        proposals, _ = self.rpn(ImageList(images, sizes), pyramid)
        found, _ = self.roi_heads(pyramid, proposals, sizes)
        return [self._rows(one) for one in found]

    def _rows(self, found: dict[str, Tensor]) -> Tensor:
        label = found["labels"]
        keep = torch.ones_like(label, dtype=torch.bool)
        if self.options.labels:
            table = torch.zeros(max(self.options.label_count, 256), dtype=label.dtype, device=label.device)
            for detector_label, class_id in self.options.labels:
                table[detector_label] = class_id
            label = table[label]
            keep = label > 0
        rows = torch.cat([found["boxes"], found["scores"][:, None], label[:, None].float()], dim=-1)
        return rows[keep]


def _no_masks() -> bool:
    return False


def _build(options: TorchvisionOptions) -> Any:
    """Return torchvision's model with frozen batch norms, as the official weights have them."""
    try:
        from torchvision.models.detection import FasterRCNN, MaskRCNN
        from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
    except Exception as error:  # a wheel of another torch version fails in many ways
        raise InputError(
            f"the {'Mask' if options.masks else 'Faster'} R-CNN backbone needs torchvision, which does not import here"
            f" ({type(error).__name__})",
            fix=f"install the torchvision that belongs to torch {torch.__version__}, or use another backbone",
        ) from error
    return (MaskRCNN if options.masks else FasterRCNN)(
        resnet_fpn_backbone(backbone_name="resnet50", weights=None),
        num_classes=options.label_count,
        box_score_thresh=options.confidence,
        box_nms_thresh=options.overlap,
        box_detections_per_img=options.max_detections,
    )


def current_names(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return weights of torchvision before 0.13 under the names that it uses now; others stay."""
    renamed = {}
    for name, tensor in weights.items():
        for kind in ("inner_blocks", "layer_blocks"):
            head, found, tail = name.partition(f"fpn.{kind}.")
            if found and tail.count(".") == 1:
                number, leaf = tail.split(".")
                name = f"{head}{found}{number}.0.{leaf}"
        name = name.replace("rpn.head.conv.weight", "rpn.head.conv.0.0.weight")
        name = name.replace("rpn.head.conv.bias", "rpn.head.conv.0.0.bias")
        for layer in range(1, 5):
            name = name.replace(f"mask_head.mask_fcn{layer}.", f"mask_head.{layer - 1}.0.")
        renamed[name] = tensor
    return renamed
