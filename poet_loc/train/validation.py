"""How good the poses of a data set are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from poet_loc.data.batches import TrainingBatch, queries_of_targets
from poet_loc.model.heads import rotation_matrices
from poet_loc.model.losses import rotation_vector
from poet_loc.model.matcher import BoxMode, match
from poet_loc.model.poet import PoET
from poet_loc.model.queries import QueryBoxes
from poet_loc.train.processes import total_over_processes

LEVER_M = 0.1


@dataclass(frozen=True)
class Validation:
    """Mean errors over the matched objects of a data set."""

    translation_m: float
    rotation_rad: float
    matched: int
    objects: int

    @property
    def score(self) -> float:
        """Translation error plus rotation error at a lever of 0.1 m: about the ADD of a hand-sized object, in m."""
        return self.translation_m + LEVER_M * self.rotation_rad

    def to_json(self) -> dict[str, float]:
        """Return the numbers by name; without a match there are no errors."""
        counts: dict[str, float] = {"matched": self.matched, "objects": self.objects}
        return {**asdict(self), "score": self.score} if self.matched else counts


def asked_queries(network: PoET, batch: TrainingBatch, mode: BoxMode) -> QueryBoxes | None:
    """Return the queries of a batch, None where the detector is to find them."""
    return None if mode == "backbone" else queries_of_targets(batch.targets, network.options.queries, mode)


@torch.no_grad()
def validate(network: PoET, batches: Iterable[TrainingBatch], mode: BoxMode, device: torch.device) -> Validation:
    """Compare the poses of every matched query with the truth; the shares of several processes are added up."""
    was_training = network.training
    network.eval()
    total = torch.zeros(4, dtype=torch.float64)
    for batch in batches:
        batch = batch.to(device)
        queries = asked_queries(network, batch, mode)
        output = network(batch.images, queries)
        pairs = match(output.queries, batch.targets, mode, network.options.class_mode == "specific")
        t, r = matched_errors(output.translation, output.rotation, batch, pairs.images, pairs.queries, pairs.targets)
        total += torch.tensor([t.sum(), r.sum(), len(pairs), sum(len(x.labels) for x in batch.targets)])
    network.train(was_training)
    translation, rotation, matched, objects = total_over_processes(total).tolist()
    return Validation(translation / max(matched, 1), rotation / max(matched, 1), int(matched), int(objects))


def matched_errors(
    translation: Tensor, rotation: Tensor, batch: TrainingBatch, images: Tensor, queries: Tensor, targets: Tensor
) -> tuple[Tensor, Tensor]:
    """Return distances (K,) in m and angles (K,) in rad of matched poses."""
    pairs = list(zip(images.tolist(), targets.tolist()))
    if not pairs:
        return torch.zeros(0), torch.zeros(0)
    true_t = torch.stack([batch.targets[image].translation[target] for image, target in pairs])
    true_r = torch.stack([batch.targets[image].rotation[target] for image, target in pairs])
    found_r = rotation_matrices(rotation[images, queries])
    distance = (translation[images, queries] - true_t).norm(dim=-1)
    return distance.cpu(), rotation_vector(found_r @ true_r.mT).norm(dim=-1).cpu()
