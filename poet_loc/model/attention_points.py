"""Where the decoder looks: the sampling points of each query and how much each counts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from poet_loc.model.backbone import ImageBatch
from poet_loc.model.deformable_attention import DeformableAttention
from poet_loc.model.poet import PoET, PoseOutput
from poet_loc.model.queries import QueryBoxes


@dataclass(frozen=True)
class AttentionPoints:
    """What the queries of one image looked at, by decoder layer."""

    points: Tensor
    """(layers, Q, K, 2) x, y in pixels, edges of the image at 0 and its size; K = heads x levels x points."""
    weights: Tensor
    """(layers, Q, K); they add up to one over the points of a head."""


@torch.no_grad()
def attend(network: PoET, batch: ImageBatch, queries: QueryBoxes | None = None) -> tuple[PoseOutput, AttentionPoints]:
    """Return the poses of a batch of one image and where the decoder looked for them.

    Raises ValueError for more than one image.
    """
    if len(batch.images) != 1:
        raise ValueError(f"attention is shown for one image, not for {len(batch.images)}")
    height, width = batch.size
    size = torch.tensor([width, height], dtype=torch.float32, device=batch.images.device)
    with _recorded(network) as calls:
        output = network(batch, queries)
    points = torch.stack([locations[0].flatten(1, 3) * size for locations, _ in calls])
    weights = torch.stack([weights[0].flatten(1, 3) for _, weights in calls])
    return output, AttentionPoints(points, weights)


@contextmanager
def _recorded(network: PoET) -> Iterator[list[tuple[Tensor, Tensor]]]:
    """Note locations and weights of each cross-attention while the network runs."""
    calls: list[tuple[Tensor, Tensor]] = []

    def note(module: Any, arguments: tuple[Any, ...], _: Tensor) -> None:
        query, reference, _source, shapes, _padding = arguments
        calls.append(module.where_and_how_much(query, reference, shapes))

    attentions = [layer.get_submodule("cross_attn") for layer in network.transformer.decoder.layers]
    handles = [a.register_forward_hook(note) for a in attentions if isinstance(a, DeformableAttention)]
    try:
        yield calls
    finally:
        for handle in handles:
            handle.remove()
