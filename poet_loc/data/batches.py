"""Samples in batches: in an order that depends on seed and epoch alone, shared by several processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from poet_loc.data.augmentation import (
    AugmentationOptions,
    augment_colours,
    background_files,
    jitter_boxes,
    maybe_gray,
    paste_over,
    random_stream,
)
from poet_loc.data.samples import ImageRecord, PoseDataset, PoseSample, read_image, targets_of, to_tensor
from poet_loc.model.backbone import ImageBatch, batch_images
from poet_loc.model.matcher import BoxMode, PoseTargets
from poet_loc.model.queries import QueryBoxes, stack_queries


@dataclass(frozen=True)
class TrainingBatch:
    """Images and the objects in them."""

    images: ImageBatch
    targets: tuple[PoseTargets, ...]
    records: tuple[ImageRecord, ...]

    def to(self, device: torch.device | str) -> TrainingBatch:
        """Return the same batch on another device."""
        return TrainingBatch(self.images.to(device), tuple(t.to(device) for t in self.targets), self.records)


class Samples(Dataset[PoseSample]):
    """Reads, augments and tensorises the images of a data set; its keys are (epoch, index)."""

    def __init__(
        self,
        dataset: PoseDataset,
        options: AugmentationOptions | None = None,
        seed: int = 0,
        jitter: bool = False,
    ) -> None:
        self.dataset, self.options, self.seed, self.jitter = dataset, options, seed, jitter
        folder = None if options is None else options.backgrounds
        self.backgrounds = [] if folder is None else background_files(folder)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, key: tuple[int, int]) -> PoseSample:
        epoch, index = key
        record = self.dataset.record(index)
        rng = random_stream(self.seed, epoch, index)
        if record.kind == "synt" and self.backgrounds:
            behind = read_image(self.backgrounds[int(rng.integers(len(self.backgrounds)))])
            image = paste_over(read_image(record.path, "RGBA"), behind, rng)
        else:
            image = read_image(record.path)
        if self.options is not None and self.options.colour:
            image = augment_colours(image, rng)
        if self.options is not None and self.options.grayscale:
            image = maybe_gray(image, rng)
        targets = targets_of(record)
        if self.jitter:
            probability = AugmentationOptions.jitter_probability
            targets = jitter_boxes(
                targets, rng, probability if self.options is None else self.options.jitter_probability
            )
        return PoseSample(to_tensor(image), targets, torch.tensor(record.intrinsics), record)


class EpochBatches(Sampler[list[tuple[int, int]]]):
    """Batches of keys (epoch, index) for one process, from the first batch that is still to do."""

    def __init__(
        self, length: int, batch: int, epoch: int = 0, seed: int = 0, shuffle: bool = True,
        rank: int = 0, world: int = 1, first: int = 0,
    ) -> None:  # fmt: skip
        self.length, self.batch, self.epoch, self.seed, self.shuffle = length, batch, epoch, seed, shuffle
        self.rank, self.world, self.first = rank, world, first

    def __len__(self) -> int:
        whole = self.batch * self.world
        batches = self.length // whole if self.shuffle else -(-self.length // whole)
        return max(batches - self.first, 0)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        order = torch.arange(self.length)
        if self.shuffle:
            generator = torch.Generator().manual_seed((self.seed * 1_000_003 + self.epoch) % 2**31)
            order = torch.randperm(self.length, generator=generator)
        for number in range(self.first, self.first + len(self)):
            start = (number * self.world + self.rank) * self.batch
            yield [(self.epoch, int(index)) for index in order[start : start + self.batch]]


def collate(samples: Sequence[PoseSample], multiple: int = 1) -> TrainingBatch:
    """Pad images to one size and stack them.

    Targets' boxes stay in shares of their own image, as the official code has it; in a batch of different sizes that
    is not the share of the padded batch.
    """
    intrinsics = torch.stack([sample.intrinsics for sample in samples])
    images = batch_images([sample.image for sample in samples], intrinsics, multiple)
    return TrainingBatch(images, tuple(s.targets for s in samples), tuple(s.record for s in samples))


class Collate:
    """`collate` for backbones that want image sides of some multiple; data loader workers can copy it."""

    def __init__(self, multiple: int) -> None:
        self.multiple = multiple

    def __call__(self, samples: Sequence[PoseSample]) -> TrainingBatch:
        """Return the batch of some samples."""
        return collate(samples, self.multiple)


def loader(samples: Samples, batches: EpochBatches, multiple: int, workers: int) -> DataLoader[TrainingBatch]:
    """Return the batches of one epoch."""
    return DataLoader(samples, batch_sampler=batches, collate_fn=Collate(multiple), num_workers=workers)  # type: ignore[arg-type,return-value]


def queries_of_targets(targets: Sequence[PoseTargets], count: int, mode: BoxMode) -> QueryBoxes:
    """Ask about the true boxes, or about the jittered ones."""
    boxes = [_asked(target, mode) for target in targets]
    return stack_queries(boxes, [target.labels for target in targets], count)


def _asked(target: PoseTargets, mode: BoxMode) -> Tensor:
    if mode == "gt" or target.jittered_boxes is None:
        return target.boxes
    return target.jittered_boxes
