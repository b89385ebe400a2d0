"""The deformable encoder and decoder; attribute names are those of the official weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from poet_loc.model.deformable_attention import DeformableAttention, Shapes
from poet_loc.model.options import NetworkOptions


@dataclass(frozen=True)
class Tokens:
    """The cells of all levels in one row: levels in order, cells row by row."""

    values: Tensor
    """(B, S, d)."""
    positions: Tensor
    """(B, S, d) position code plus level embedding."""
    padding: Tensor | None
    """(B, S) True where padded; None where no image is padded."""
    shapes: Shapes
    """(h, w) of each level."""
    valid_ratios: Tensor
    """(B, L, 2) share of each level's width and height that is not padded."""

    def of_levels(self, levels: tuple[int, ...]) -> tuple[Tokens, Tensor]:
        """Return the tokens of some levels, and their indices (S',) among all."""
        sizes = [h * w for h, w in self.shapes]
        starts = [sum(sizes[:level]) for level in range(len(sizes))]
        index = torch.cat([torch.arange(starts[level], starts[level] + sizes[level]) for level in levels])
        index = index.to(self.values.device)
        padding = None if self.padding is None else self.padding[:, index]
        shapes = [self.shapes[level] for level in levels]
        ratios = self.valid_ratios[:, list(levels)]
        return Tokens(self.values[:, index], self.positions[:, index], padding, shapes, ratios), index


def valid_ratios(mask: Tensor) -> Tensor:
    """Return the share of a level (B, h, w) that is not padded -> (B, 2), of its width, then of its height."""
    valid = ~mask
    return torch.stack([valid[:, 0].float().mean(1), valid[:, :, 0].float().mean(1)], dim=-1)


def encoder_references(shapes: Shapes, ratios: Tensor) -> Tensor:
    """Return where each token itself is, seen from every level: (B, S, L, 2) in shares of that level."""
    centres = []
    for level, (height, width) in enumerate(shapes):
        rows = torch.arange(height, dtype=torch.float32, device=ratios.device) + 0.5
        columns = torch.arange(width, dtype=torch.float32, device=ratios.device) + 0.5
        x = columns[None] / (ratios[:, level, 0, None] * width)
        y = rows[None] / (ratios[:, level, 1, None] * height)
        grid = torch.stack([x[:, None].expand(-1, height, -1), y[:, :, None].expand(-1, -1, width)], dim=-1)
        centres.append(grid.flatten(1, 2))
    return torch.cat(centres, dim=1)[:, :, None] * ratios[:, None]


class EncoderLayer(nn.Module):
    """Deformable self-attention and a feed-forward part, each followed by its norm."""

    def __init__(self, options: NetworkOptions, levels: int) -> None:
        super().__init__()
        dim = options.hidden_dim
        self.self_attn = DeformableAttention(dim, levels, options.heads, options.encoder_points)
        self.norm1 = nn.LayerNorm(dim)
        self.linear1 = nn.Linear(dim, options.feedforward_dim)
        self.linear2 = nn.Linear(options.feedforward_dim, dim)
        self.norm2 = nn.LayerNorm(dim)
        self.dropout = nn.Dropout(options.dropout)

    def forward(self, x: Tensor, tokens: Tokens, references: Tensor) -> Tensor:
        """Refine token values x (B, S, d)."""
        attended = self.self_attn(x + tokens.positions, references, x, tokens.shapes, tokens.padding)
        x = self.norm1(x + self.dropout(attended))
        return self.norm2(x + self.dropout(self.linear2(self.dropout(F.relu(self.linear1(x))))))


class DecoderLayer(nn.Module):
    """Self-attention of the queries (norm2), deformable attention to the image (norm1), feed-forward (norm3)."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        dim = options.hidden_dim
        self.cross_attn = DeformableAttention(dim, options.levels, options.heads, options.decoder_points)
        self.norm1 = nn.LayerNorm(dim)
        self.self_attn = nn.MultiheadAttention(dim, options.heads, dropout=options.dropout, batch_first=True)
        self.norm2 = nn.LayerNorm(dim)
        self.linear1 = nn.Linear(dim, options.feedforward_dim)
        self.linear2 = nn.Linear(options.feedforward_dim, dim)
        self.norm3 = nn.LayerNorm(dim)
        self.dropout = nn.Dropout(options.dropout)

    def attend_to_queries(self, x: Tensor, query_position: Tensor) -> Tensor:
        """Let queries see each other, dummies included."""
        q = x + query_position
        return self.norm2(x + self.dropout(self.self_attn(q, q, x, need_weights=False)[0]))

    def finish(self, x: Tensor, attended: Tensor) -> Tensor:
        """Add what cross-attention found, and the feed-forward part."""
        x = self.norm1(x + self.dropout(attended))
        return self.norm3(x + self.dropout(self.linear2(self.dropout(F.relu(self.linear1(x))))))

    def forward(self, x: Tensor, query_position: Tensor, references: Tensor, memory: Tensor, tokens: Tokens) -> Tensor:
        """Refine query contents x (B, Q, d)."""
        x = self.attend_to_queries(x, query_position)
        attended = self.cross_attn(x + query_position, references, memory, tokens.shapes, tokens.padding)
        return self.finish(x, attended)


class Stack(nn.Module):
    """Layers under the name that the official weights use."""

    def __init__(self, layers: Sequence[nn.Module]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(layers)


class DeformableTransformer(nn.Module):
    """Encoder over the tokens of all levels and decoder over the object queries."""

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        self.options = options
        encoder_levels = options.levels if options.encoder_maps is None else len(options.encoder_maps)
        self.level_embed = nn.Parameter(torch.empty(options.levels, options.hidden_dim))
        self.encoder = Stack([EncoderLayer(options, encoder_levels) for _ in range(options.encoder_layers)])
        self.decoder = Stack([DecoderLayer(options) for _ in range(options.decoder_layers)])
        self.reference_points = nn.Linear(options.hidden_dim, 2)
        self._reset()

    def _reset(self) -> None:
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)
        for module in self.modules():
            if isinstance(module, DeformableAttention):
                module.reset()
        nn.init.zeros_(self.reference_points.bias)
        nn.init.normal_(self.level_embed)

    def tokens(self, maps: list[Tensor], masks: list[Tensor], codes: list[Tensor]) -> Tokens:
        """Lay out projected maps (B, d, h, w) with their masks (B, h, w) and position codes (B, d, h, w)."""
        positions = [code.flatten(2).transpose(1, 2) + self.level_embed[i] for i, code in enumerate(codes)]
        padding = torch.cat([mask.flatten(1) for mask in masks], dim=1)
        return Tokens(
            torch.cat([m.flatten(2).transpose(1, 2) for m in maps], dim=1),
            torch.cat(positions, dim=1),
            padding,
            [(int(m.shape[-2]), int(m.shape[-1])) for m in maps],
            torch.stack([valid_ratios(mask) for mask in masks], dim=1),
        )

    def encode(self, tokens: Tokens) -> Tensor:
        """Return the memory (B, S, d); levels that do not take part keep their values."""
        chosen = self.options.encoder_maps
        if not self.encoder.layers or chosen == ():
            return tokens.values
        part, index = (tokens, None) if chosen is None else tokens.of_levels(chosen)
        references = encoder_references(part.shapes, part.valid_ratios)
        x = part.values
        for layer in self.encoder.layers:
            x = layer(x, part, references)
        return x if index is None else tokens.values.index_copy(1, index, x)

    def references(self, query_position: Tensor, boxes: Tensor, ratios: Tensor) -> Tensor:
        """Return the decoder's reference points (B, Q, L, 2), or boxes (B, Q, L, 4), seen from every level."""
        spread = self.options.reference_spread == "box"
        if self.options.reference_points == "learned":
            centre = self.reference_points(query_position).sigmoid()
            points = torch.cat([centre, boxes[..., 2:].clamp(min=0.0)], dim=-1) if spread else centre
        else:
            points = torch.cat([boxes[..., :2], boxes[..., 2:].clamp(min=0.0)], dim=-1) if spread else boxes[..., :2]
        scale = torch.cat([ratios, ratios], dim=-1) if spread else ratios
        return points[:, :, None] * scale[:, None]

    def decode(self, memory: Tensor, tokens: Tokens, content: Tensor, query_position: Tensor, boxes: Tensor) -> Tensor:
        """Return the queries after each layer (layers, B, Q, d); boxes (B, Q, 4) are normalised."""
        references = self.references(query_position, boxes, tokens.valid_ratios)
        x, states = content, []
        for layer in self.decoder.layers:
            x = layer(x, query_position, references, memory, tokens)
            states.append(x)
        return torch.stack(states)
