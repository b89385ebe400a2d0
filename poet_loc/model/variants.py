"""What the embedded pose network does differently from the published one, each an option of its own.

Queries that read features aligned to their box; translation along the box's viewing ray; rotation seen along that ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from poet_loc.model.options import NetworkOptions
from poet_loc.model.queries import QueryBoxes

if TYPE_CHECKING:
    from poet_loc.model.poet import QueryContext

ROI_CELLS = 8
"""Cells per side of the features aligned to a box."""

_TYPICAL_SIZE = 0.2  # m: diagonal of a household object, where the depth estimate starts


class RoiQueryFeatures(nn.Module):
    """Features of every map sampled on a grid over the box, narrowed to one vector per query, plus a class code.

    Source: K. He et al., "Mask R-CNN" (2017), RoIAlign with one sample per cell.
    """

    def __init__(self, options: NetworkOptions, width: int = 64, hidden: int = 192) -> None:
        super().__init__()
        self.narrow = nn.ModuleList(nn.Conv2d(channels, width, 1) for channels in options.map_channels)
        self.mix = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, width, 3, padding=1), nn.ReLU(),
        )  # fmt: skip
        self.join = nn.Sequential(
            nn.Linear(width * ROI_CELLS**2, options.hidden_dim),
            nn.ReLU(),
            nn.Linear(options.hidden_dim, options.hidden_dim),
        )
        self.class_code = nn.Embedding(options.class_count + 1, options.hidden_dim)

    def forward(self, maps: Sequence[Tensor], queries: QueryBoxes) -> Tensor:
        """Return (B, Q, d) from maps (B, C_l, h_l, w_l) and boxes in shares of the image."""
        grid = box_grid(queries.boxes, ROI_CELLS)  # (B, Q, n, n, 2)
        batch, count = grid.shape[:2]
        total = None
        for narrow, level in zip(self.narrow, maps):
            sampled = F.grid_sample(narrow(level).float(), grid.flatten(1, 2), align_corners=False)  # (B, w, Q n, n)
            total = sampled if total is None else total + sampled
        assert total is not None
        patches = total.unflatten(2, (count, ROI_CELLS)).transpose(1, 2).flatten(0, 1)  # (B Q, w, n, n)
        joined = self.join(self.mix(F.relu(patches)).flatten(1))
        return joined.unflatten(0, (batch, count)) + self.class_code(queries.classes.clamp(min=0))


def box_grid(boxes: Tensor, cells: int) -> Tensor:
    """Return the centres of n x n cells over boxes (B, Q, 4) as grid_sample wants them: (B, Q, n, n, 2) in [-1, 1]."""
    steps = (torch.arange(cells, device=boxes.device, dtype=boxes.dtype) + 0.5) / cells - 0.5
    x = boxes[..., 0, None] + boxes[..., 2, None] * steps  # (B, Q, n)
    y = boxes[..., 1, None] + boxes[..., 3, None] * steps
    grid = torch.stack([x[..., None, :].expand(-1, -1, cells, -1), y[..., :, None].expand(-1, -1, -1, cells)], dim=-1)
    return 2.0 * grid - 1.0


def translation_along_ray(numbers: Tensor, context: QueryContext) -> Tensor:
    """Turn (shift x, shift y in boxes, log depth ratio) (B, Q, 3) into translations in camera axes, m.

    The depth ratio is to the depth at which a thing of 0.2 m is as large as the box's diagonal; intrinsics have pixel
    centres at integers (BOP), boxes reach from edge to edge. Raises ValueError without intrinsics.
    """
    if context.intrinsics is None:
        raise ValueError("a translation along the ray needs intrinsics")
    focal, centre = context.intrinsics[:, None, :2], context.intrinsics[:, None, 2:]
    height, width = context.image_size
    scale = torch.tensor([width, height], dtype=numbers.dtype, device=numbers.device)
    size = context.boxes[..., 2:].clamp(min=1e-3) * scale
    pixel = context.boxes[..., :2] * scale - 0.5 + numbers[..., :2] * size
    diagonal = (size / focal).norm(dim=-1, keepdim=True)
    depth = _TYPICAL_SIZE / diagonal * numbers[..., 2:].clamp(-3.0, 3.0).exp()
    return torch.cat([(pixel - centre) / focal * depth, depth], dim=-1)


def egocentric_rotation(allocentric: Tensor, translation: Tensor) -> Tensor:
    """Turn rotations seen along the ray to the object (..., 3, 3) into rotations in camera axes.

    R = R_ray R_allocentric with the smallest rotation R_ray that takes the optical axis to the ray; translation
    (..., 3) gives the ray and gets no gradient.  Source: A. Kundu et al., "3D-RCNN" (2018), section 3.2.
    """
    return ray_rotation(translation.detach()) @ allocentric


def ray_rotation(translation: Tensor) -> Tensor:
    """Return the smallest rotations (..., 3, 3) that take the optical axis (0, 0, 1) to the rays (..., 3).

    Rodrigues' formula for axis z x ray: I + [v] + [v]^2 / (1 + cos), defined for every ray but the opposite one.
    """
    ray = F.normalize(translation, dim=-1)
    x, y, z = ray.unbind(-1)
    share = 1.0 / (1.0 + z).clamp(min=1e-6)
    rows = [
        [1 - x * x * share, -x * y * share, x],
        [-x * y * share, 1 - y * y * share, y],
        [-x, -y, z],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
