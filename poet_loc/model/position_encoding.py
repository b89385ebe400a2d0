"""Where a token or a box is: sine codes of map cells, a learned table, and the code of a box."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from poet_loc.core.input_error import InputError


class SinePositionEncoding(nn.Module):
    """Sines of the row and the column of each cell, counted over the cells that are not padded.

    Source: N. Carion et al., "End-to-end object detection with transformers" (2020), appendix A.4.
    """

    def __init__(self, dim: int, temperature: float = 10000.0) -> None:
        super().__init__()
        self.dim, self.temperature = dim, temperature

    def forward(self, mask: Tensor) -> Tensor:
        """Encode a padding mask (B, h, w), True where padded -> (B, d, h, w), rows first, then columns."""
        valid = ~mask
        rows, columns = (valid.cumsum(axis, dtype=torch.float32) for axis in (1, 2))
        rows = (rows - 0.5) / (rows[:, -1:, :] + 1e-6) * (2 * math.pi)
        columns = (columns - 0.5) / (columns[:, :, -1:] + 1e-6) * (2 * math.pi)
        return torch.cat([self._waves(rows), self._waves(columns)], dim=3).permute(0, 3, 1, 2)

    def _waves(self, angle: Tensor) -> Tensor:
        half = self.dim // 2
        index = torch.arange(half, dtype=torch.float32, device=angle.device)
        period = self.temperature ** (2 * torch.div(index, 2, rounding_mode="floor") / half)
        phase = angle[..., None] / period
        return torch.stack([phase[..., 0::2].sin(), phase[..., 1::2].cos()], dim=-1).flatten(-2)


class LearnedPositionEncoding(nn.Module):
    """One learned vector per row and per column, 50 of each."""

    def __init__(self, dim: int, entries: int = 50) -> None:
        super().__init__()
        self.row_embed = nn.Embedding(entries, dim // 2)
        self.col_embed = nn.Embedding(entries, dim // 2)
        nn.init.uniform_(self.row_embed.weight)
        nn.init.uniform_(self.col_embed.weight)

    def forward(self, mask: Tensor) -> Tensor:
        """Encode a padding mask (B, h, w) -> (B, d, h, w), columns first, then rows.

        Raises InputError for maps with more rows or columns than the table.
        """
        batch, height, width = mask.shape
        entries = self.row_embed.num_embeddings
        if max(height, width) > entries:
            what = f"a learned position encoding has {entries} rows and columns, the map is {height}x{width}"
            raise InputError(what, fix="give smaller images, or use the sine encoding")
        columns = self.col_embed(torch.arange(width, device=mask.device))
        rows = self.row_embed(torch.arange(height, device=mask.device))
        code = torch.cat(
            [columns[None].expand(height, -1, -1), rows[:, None].expand(-1, width, -1)], dim=-1
        )  # (h, w, d)
        return code.permute(2, 0, 1)[None].expand(batch, -1, -1, -1)


def box_code(boxes: Tensor, dim: int, octaves: int | None = None) -> Tensor:
    """Encode normalised boxes (..., 4) as sines and cosines of powers of two times each number -> (..., d).

    With d = 256 the top frequency is 2^31: the last bit of a float32 box changes the upper channels, so boxes must be
    computed in the published order of operations.  Source: B. Mildenhall et al., "NeRF" (2020), eq. 4, without pi.
    """
    frequencies = 2.0 ** torch.arange(dim // 8, dtype=boxes.dtype, device=boxes.device)
    phase = boxes[..., None] * frequencies  # (..., 4, K)
    kept = torch.arange(dim // 8, device=boxes.device) < (dim // 8 if octaves is None else octaves)
    return torch.cat([phase.sin() * kept, phase.cos() * kept], dim=-1).flatten(-2)
