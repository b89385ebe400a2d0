"""Multi-scale deformable attention (X. Zhu et al., "Deformable DETR", 2021, eq. 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Shapes = Sequence[tuple[int, int]]


def sample_plain(value: Tensor, shapes: Shapes, locations: Tensor, weights: Tensor) -> Tensor:
    """Sum weighted bilinear samples of every level; zeros outside a map.  The oracle of the fused sampler.

    value (B, S, M, D), shapes L x (h, w) with sum h w = S, locations (B, Q, M, L, P, 2) x, y in shares of a level,
    weights (B, Q, M, L, P) -> (B, Q, M D).
    """
    batch, _, heads, depth = value.shape
    queries = locations.shape[1]
    grids = 2.0 * locations - 1.0
    sampled = []
    for level, (part, (height, width)) in enumerate(zip(value.split([h * w for h, w in shapes], dim=1), shapes)):
        level_map = part.flatten(2).transpose(1, 2).reshape(batch * heads, depth, height, width)
        grid = grids[:, :, :, level].transpose(1, 2).flatten(0, 1)  # (B M, Q, P, 2)
        sampled.append(F.grid_sample(level_map, grid, mode="bilinear", padding_mode="zeros", align_corners=False))
    stacked = torch.stack(sampled, dim=-2).flatten(-2)  # (B M, D, Q, L P)
    share = weights.transpose(1, 2).reshape(batch * heads, 1, queries, -1)
    return (stacked * share).sum(-1).view(batch, heads * depth, queries).transpose(1, 2).contiguous()


def sample(value: Tensor, shapes: Shapes, locations: Tensor, weights: Tensor) -> Tensor:
    """Do what `sample_plain` does with the fastest code there is for this device and type."""
    if value.device.type == "cpu" and torch.is_autocast_enabled("cpu"):  # the fused sampler beats half-width values
        value, locations, weights = value.float(), locations.float(), weights.float()
    if value.device.type == "cpu" and value.dtype == torch.float32 and not torch.compiler.is_exporting():
        from poet_loc.model.fused_sampler import FusedSample

        return FusedSample.apply(value, tuple(shapes), locations, weights)  # type: ignore[no-any-return]
    return sample_plain(value, shapes, locations, weights)


class DeformableAttention(nn.Module):
    """Each query looks at P points per head and level around its reference point."""

    def __init__(self, dim: int, levels: int, heads: int, points: int) -> None:
        super().__init__()
        self.levels, self.heads, self.points = levels, heads, points
        self.sampling_offsets = nn.Linear(dim, heads * levels * points * 2)
        self.attention_weights = nn.Linear(dim, heads * levels * points)
        self.value_proj = nn.Linear(dim, dim)
        self.output_proj = nn.Linear(dim, dim)
        self.reset()

    def reset(self) -> None:
        """Start with one direction per head, point k at k + 1 cells, and equal weights."""
        angle = torch.arange(self.heads, dtype=torch.float32) * (2.0 * math.pi / self.heads)
        direction = torch.stack([angle.cos(), angle.sin()], dim=-1)
        direction = direction / direction.abs().max(dim=-1, keepdim=True).values
        steps = torch.arange(1, self.points + 1, dtype=torch.float32)
        offsets = direction[:, None, None] * steps[None, None, :, None]  # (M, 1, P, 2)
        with torch.no_grad():
            nn.init.zeros_(self.sampling_offsets.weight)
            self.sampling_offsets.bias.copy_(offsets.expand(-1, self.levels, -1, -1).reshape(-1))
            for layer in (self.attention_weights,):
                nn.init.zeros_(layer.weight)
                nn.init.zeros_(layer.bias)
            for layer in (self.value_proj, self.output_proj):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)

    def forward(
        self, query: Tensor, reference: Tensor, source: Tensor, shapes: Shapes, padding: Tensor | None
    ) -> Tensor:
        """Attend from queries (B, Q, d) to tokens (B, S, d).

        reference (B, Q, L, 2) x, y in shares of each level, or (B, Q, L, 4) with w, h that scale the offsets;
        padding (B, S) True where a token counts as zero -> (B, Q, d).
        """
        value = self.value_proj(source)
        if padding is not None:
            value = value.masked_fill(padding[..., None], 0.0)
        locations, weights = self.where_and_how_much(query, reference, shapes)
        return self.output_proj(sample(value.unflatten(-1, (self.heads, -1)), shapes, locations, weights))

    def where_and_how_much(self, query: Tensor, reference: Tensor, shapes: Shapes) -> tuple[Tensor, Tensor]:
        """Return sampling locations (B, Q, M, L, P, 2) and weights (B, Q, M, L, P) of queries (B, Q, d)."""
        layout = (self.heads, self.levels, self.points)
        offsets = self.sampling_offsets(query).unflatten(-1, (*layout, 2))
        weights = self.attention_weights(query).unflatten(-1, (self.heads, -1)).softmax(-1).unflatten(-1, layout[1:])
        centre = reference[:, :, None, :, None, :2]
        if reference.shape[-1] == 4:  # Deformable DETR, appendix A.4: offsets in halves of the box
            return centre + offsets * reference[:, :, None, :, None, 2:] * (0.5 / self.points), weights
        cells = torch.tensor([[w, h] for h, w in shapes], dtype=query.dtype, device=query.device)
        return centre + offsets / cells[:, None], weights
