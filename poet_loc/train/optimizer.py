"""What moves the weights: AdamW, or Muon for the matrices of hidden layers with AdamW for everything else."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor, nn

OptimizerKind = Literal["adamw", "muon"]

HIDDEN_SIDE = 64
"""A matrix with fewer rows or columns belongs to an input or an output, where Muon does not help."""


class Optimizer:
    """AdamW alone, or beside Muon (K. Jordan et al., "Muon", 2024): its steps have nearly equal singular values.

    Muon's steps are scaled to the size of AdamW's (J. Liu et al., "Muon is scalable for LLM training", 2025, section
    2.2), so one learning rate serves both. A convolution counts as a matrix with one row per output channel.
    """

    def __init__(self, module: nn.Module, kind: OptimizerKind, weight_decay: float) -> None:
        hidden = _hidden_weights(module) if kind == "muon" else []
        seen = {id(weight) for weight in hidden}
        others = [p for p in module.parameters() if p.requires_grad and id(p) not in seen]
        decayed, plain = [p for p in others if p.dim() > 1], [p for p in others if p.dim() <= 1]
        groups = [{"params": decayed, "weight_decay": weight_decay}, {"params": plain, "weight_decay": 0.0}]
        self.parts: dict[str, torch.optim.Optimizer] = {"adamw": torch.optim.AdamW(groups)}
        self._matrices = [(weight, nn.Parameter(_as_matrix(weight.detach(), weight))) for weight in hidden]
        if self._matrices:
            matrices = [matrix for _, matrix in self._matrices]
            self.parts["muon"] = torch.optim.Muon(matrices, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")

    def step(self, rate: float) -> None:
        """Move the weights along their gradients at a learning rate."""
        for weight, matrix in self._matrices:
            matrix.grad = None if weight.grad is None else _as_matrix(weight.grad, weight)
        for part in self.parts.values():
            for group in part.param_groups:
                group["lr"] = rate
            part.step()

    def state_dict(self) -> dict[str, Any]:
        """Return the state of each part."""
        return {name: part.state_dict() for name, part in self.parts.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take a state back.  Raises ValueError for that of another kind."""
        if set(state) != set(self.parts):
            raise ValueError(f"the state is one of {' + '.join(state)}, this optimizer is {' + '.join(self.parts)}")
        for name, part in self.parts.items():
            part.load_state_dict(state[name])


def _hidden_weights(module: nn.Module) -> list[nn.Parameter]:
    layers = [layer for layer in module.modules() if isinstance(layer, nn.Linear | nn.Conv2d)]
    weights = [layer.get_parameter("weight") for layer in layers]
    return [w for w in weights if w.requires_grad and min(len(w), w[0].numel()) >= HIDDEN_SIDE]


def _as_matrix(values: Tensor, weight: Tensor) -> Tensor:
    """Return values in a weight's shape as a matrix in the order of the weight's memory: of the weight, a view."""
    if values.dim() == 4 and weight.is_contiguous(memory_format=torch.channels_last):
        values = values.permute(0, 2, 3, 1)
    return values.flatten(1)
