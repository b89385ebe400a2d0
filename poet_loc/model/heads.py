"""From a decoder state to a pose: one small network per decoder layer, quantity and class."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Mlp(nn.Module):
    """Three linear layers with ReLU between them."""

    def __init__(self, dim: int, output_dim: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(dim, dim), nn.Linear(dim, dim), nn.Linear(dim, output_dim)])

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., d) to (..., output_dim)."""
        for layer in self.layers[:-1]:
            x = F.relu(layer(x))
        return self.layers[-1](x)  # type: ignore[no-any-return]


def heads_per_layer(dim: int, output_dim: int, layers: int) -> nn.ModuleList:
    """Return one head per decoder layer, all equal at the start."""
    head = Mlp(dim, output_dim)
    return nn.ModuleList([copy.deepcopy(head) for _ in range(layers)])


def pick_class(output: Tensor, classes: Tensor, slots: int) -> Tensor:
    """Take the class's slot of a head's output (B, Q, slots n) -> (B, Q, n); dummies take slot 0.

    Raises IndexError for a class beyond the head's slots.
    """
    if slots == 1:
        return output
    rows = output.unflatten(-1, (slots, -1))
    index = torch.where(classes > 0, classes, 0)[..., None, None].expand(*classes.shape, 1, rows.shape[-1])
    return rows.gather(-2, index).squeeze(-2)


def rotation_from_6d(numbers: Tensor) -> Tensor:
    """Turn two 3-vectors (..., 6) into rotation matrices (..., 3, 3) with columns x, y, z.

    Source: Y. Zhou et al., "On the continuity of rotation representations in neural networks" (2019), eq. 15, with the
    second vector fixing z first.
    """
    a, b = numbers[..., :3], numbers[..., 3:]
    x = F.normalize(a, dim=-1, eps=1e-12)
    z = F.normalize(torch.linalg.cross(x, b), dim=-1, eps=1e-12)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def matrix_from_quaternion_wxyz(quaternion: Tensor) -> Tensor:
    """Turn unit quaternions w, x, y, z (..., 4) into rotation matrices (..., 3, 3)."""
    w, x, y, z = F.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def rotation_matrices(rotation: Tensor) -> Tensor:
    """Return matrices (..., 3, 3) of a network's rotations, matrices or quaternions w, x, y, z."""
    return matrix_from_quaternion_wxyz(rotation) if rotation.shape[-1] == 4 else rotation


def cholesky_factor(numbers: Tensor) -> Tensor:
    """Return the lower factor L (..., 3, 3) of a covariance L L^T from six numbers: log diagonal, then 10, 20, 21."""
    diagonal = numbers[..., :3].clamp(-15.0, 10.0).exp()
    zero = torch.zeros_like(diagonal[..., 0])
    below = numbers[..., 3:]
    rows = [
        torch.stack([diagonal[..., 0], zero, zero], dim=-1),
        torch.stack([below[..., 0], diagonal[..., 1], zero], dim=-1),
        torch.stack([below[..., 1], below[..., 2], diagonal[..., 2]], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def covariance_matrices(numbers: Tensor) -> Tensor:
    """Return covariances (..., 3, 3) of an uncertainty head: three log variances, or six Cholesky numbers."""
    if numbers.shape[-1] == 3:
        return torch.diag_embed(numbers.exp())
    factor = cholesky_factor(numbers)
    return factor @ factor.mT
