"""The official fixture A: a small network with random weights, its inputs and what the official code made of them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from poet_loc.model.backbone import Features
from poet_loc.model.matcher import PoseTargets
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.queries import QueryBoxes, queries_from_detections

OPTIONS_A = NetworkOptions(
    hidden_dim=64,
    heads=4,
    encoder_layers=2,
    decoder_layers=2,
    feedforward_dim=96,
    decoder_points=3,
    queries=5,
    class_count=3,
    map_channels=(16, 24, 32),
)


def tensors(path: Path) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in np.load(path).items()}


def without_dropout(network: nn.Module) -> nn.Module:
    """Switch to training mode (gradients, auxiliary outputs) with dropout off."""
    network.train()
    for module in network.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
        elif isinstance(module, nn.MultiheadAttention):
            module.dropout = 0.0
    return network


@dataclass(frozen=True)
class FixtureA:
    folder: Path

    def __getattr__(self, name: str) -> dict[str, Tensor]:
        return tensors(self.folder / f"A_{name}.npz")

    def network(self, aleatoric: bool = False) -> PoET:
        network = PoET(replace(OPTIONS_A, uncertainty="aleatoric") if aleatoric else OPTIONS_A)
        extra = self.extra_aleatoric if aleatoric else {}
        network.load_state_dict(self.state_dict | extra, strict=True)
        return network.eval()

    @property
    def features(self) -> Features:
        inputs = self.inputs
        return Features(tuple(inputs[f"backbone_feat_{level}"] for level in range(3)), (96, 128))

    @property
    def mask(self) -> Tensor:
        return self.inputs["image_mask"]

    @property
    def queries(self) -> QueryBoxes:
        inputs = self.inputs
        return queries_from_detections([inputs[f"detections_{i}"] for i in range(3)], (96, 128), 5)

    @property
    def pose_targets(self) -> list[PoseTargets]:
        target = self.targets
        names = ("boxes", "labels", "relative_position", "relative_rotation")
        return [PoseTargets(*(target[f"{name}_{i}"] for name in names)) for i in range(3)]

    @property
    def losses(self) -> dict:
        return json.loads((self.folder / "A_losses.json").read_text())


def small_options(**changes: object) -> NetworkOptions:
    return replace(OPTIONS_A, **changes)


def random_features(batch: int = 2, size: tuple[int, int] = (96, 128), seed: int = 0) -> Features:
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    maps = [
        torch.randn(batch, channels, height // stride, width // stride, generator=generator)
        for channels, stride in zip(OPTIONS_A.map_channels, OPTIONS_A.map_strides)
    ]
    return Features(tuple(maps), size)


def randomise(network: nn.Module, seed: int = 0) -> nn.Module:
    """Give every parameter a value that matters, sampling offsets and attention weights included."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            scale = 0.1 if parameter.dim() > 1 else 0.3
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return network
