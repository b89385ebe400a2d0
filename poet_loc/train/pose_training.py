"""Trains a pose network: the stage behind `poet-loc train`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Symmetry
from poet_loc.data.batches import EpochBatches, Samples, TrainingBatch, loader
from poet_loc.data.open_dataset import open_dataset
from poet_loc.data.samples import PoseDataset
from poet_loc.model.checkpoint import ModelConfig
from poet_loc.model.device import device_of
from poet_loc.model.losses import PoseLoss
from poet_loc.model.poet import PoET
from poet_loc.train.options import RecipeOptions, TrainOptions
from poet_loc.train.processes import average_gradients, process_group, rank_and_world, share_first, wait_for_all
from poet_loc.train.run_files import Progress, begin, load_progress, log_row, save_network, save_progress
from poet_loc.train.start import starting_network, trainable
from poet_loc.train.validation import Validation, asked_queries, validate

ATTENTION = ("reference_points", "sampling_offsets")


def train(options: TrainOptions) -> Path:
    """Train as the options say, and return the run's folder.

    Started by torchrun, several processes share each batch's gradients; the batch of the options is that of one of
    them.  Raises InputError for data, weights or folders that do not fit.
    """
    device = device_of(options.device)
    with process_group(device):
        return _Run(options, device).work()


class _Run:
    """What the steps of one run share."""

    def __init__(self, options: TrainOptions, device: torch.device) -> None:
        torch.manual_seed(options.seed)
        self.options, self.device = options, device
        data = options.data
        self.dataset: PoseDataset = open_dataset(data.train, data.train_images, data.object_ids, data.least_visible)
        ids = self.dataset.object_ids
        self.validation = _validation_set(options, ids)
        self.network, self.config, anew = starting_network(options, ids)
        if self.config.network.needs_intrinsics and not all(map(math.isfinite, self.dataset.record(0).intrinsics)):
            raise InputError("tells no intrinsics, which this network needs", path=data.train)
        self.network.to(device)
        trainable(options, self.network)
        share_first(self.network.state_dict().values())
        self.optimizer = make_optimizer(self.network, options.recipe)
        self.loss = PoseLoss(self.network.options, options.loss, options.boxes, _symmetries(options, ids))
        self.multiple = self.network.detector.shape().multiple
        self.rank, self.world = rank_and_world()
        if len(self.dataset) < options.recipe.batch * self.world:
            whole = options.recipe.batch * self.world
            raise InputError(f"{len(self.dataset)} images do not fill one batch of {whole}", path=data.train)
        self.progress = Progress()
        if options.resume:
            self.progress = load_progress(options, self.network, self.optimizer)
        elif self.rank == 0:
            begin(options, self.config, anew)
        wait_for_all()

    def work(self) -> Path:
        """Go through the epochs that are left."""
        options, first = self.options, self.progress.step
        with _scoreboard(options.out, self.rank) as board, _progress_bar(self, self.rank) as advance:
            while self.progress.epoch < options.recipe.epochs:
                for batch in self._batches():
                    self._step(batch, board)
                    advance()
                    if options.max_steps is not None and self.progress.step - first >= options.max_steps:
                        self._save()
                        return options.out
                self._finish_epoch(board)
        if self.rank == 0:
            save_network(options, "network.safetensors", self.network, self._config(), {"epochs": self.progress.epoch})
        wait_for_all()
        return options.out

    def _batches(self) -> Iterator[TrainingBatch]:
        options, at = self.options, self.progress
        jitter = options.boxes == "jitter"
        samples = Samples(self.dataset, options.augmentation, options.seed, jitter)
        order = EpochBatches(
            len(samples), options.recipe.batch, at.epoch, options.seed, True, self.rank, self.world, at.batch
        )
        yield from loader(samples, order, self.multiple, options.data.workers)

    def _step(self, batch: TrainingBatch, board: Any) -> None:
        options, recipe = self.options, self.options.recipe
        # dropout depends on step and process alone, so a resumed run is the uninterrupted one
        torch.manual_seed((options.seed * 1_000_003 + self.progress.step) * 1009 + self.rank)
        rate = learning_rate(recipe, self.progress.epoch)
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["factor"]
        self.network.train()
        batch = batch.to(self.device)
        low = recipe.mixed_precision and self.device.type == "cuda"
        with torch.autocast("cuda", torch.bfloat16) if low else nullcontext():
            output = self.network(batch.images, asked_queries(self.network, batch, options.boxes))
        losses = self.loss(output, batch.targets)
        self.optimizer.zero_grad(set_to_none=True)
        losses["total"].backward()
        average_gradients(self.network.parameters())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), recipe.clip if recipe.clip > 0 else math.inf)
        if torch.isfinite(norm):
            self.optimizer.step()
        at = self.progress
        self.progress = replace(at, step=at.step + 1, batch=at.batch + 1)
        values = {name: float(value.detach()) for name, value in losses.items()}
        board("train", {**values, "gradient_norm": float(norm), "learning_rate": rate}, self.progress)
        if self.progress.step % options.save_every == 0:
            self._save()

    def _finish_epoch(self, board: Any) -> None:
        options, at = self.options, self.progress
        self.progress = replace(at, epoch=at.epoch + 1, batch=0)
        if self.validation is not None and self.progress.epoch % options.validate_every == 0:
            found = self._validate(self.validation)
            board("validation", found.to_json(), self.progress)
            score = found.score if found.matched else math.inf
            if self.progress.best is None or score < self.progress.best:
                self.progress = replace(self.progress, best=score)
                if self.rank == 0:
                    about = {"epochs": self.progress.epoch, "validation": found.to_json()}
                    save_network(options, "best.safetensors", self.network, self._config(), about)
        self._save()

    def _validate(self, dataset: PoseDataset) -> Validation:
        options = self.options
        samples = Samples(dataset, None, options.seed, jitter=options.boxes == "jitter")
        order = EpochBatches(len(samples), options.recipe.batch, 0, options.seed, False, self.rank, self.world)
        batches = loader(samples, order, self.multiple, options.data.workers)
        return validate(self.network, batches, options.boxes, self.device)

    def _save(self) -> None:
        if self.rank == 0:
            save_progress(self.options, self.network, self.optimizer, self.progress)
        wait_for_all()

    def _config(self) -> ModelConfig:
        record = self.dataset.record(0)
        known = record.intrinsics if all(math.isfinite(v) for v in record.intrinsics) else None
        return replace(self.config, image_size=record.size, intrinsics=known)


def make_optimizer(network: PoET, recipe: RecipeOptions) -> torch.optim.AdamW:
    """Return AdamW with two groups: sampling offsets and reference points learn more slowly."""
    named = [(name, p) for name, p in network.named_parameters() if p.requires_grad]
    slow = [p for name, p in named if any(part in name for part in ATTENTION)]
    rest = [p for name, p in named if not any(part in name for part in ATTENTION)]
    groups = [{"params": rest, "factor": 1.0}, {"params": slow, "factor": recipe.attention_rate}]
    return torch.optim.AdamW(
        [g for g in groups if g["params"]], lr=recipe.learning_rate, weight_decay=recipe.weight_decay
    )


def learning_rate(recipe: RecipeOptions, epoch: int) -> float:
    """Return the learning rate of an epoch, counted from 0."""
    return recipe.learning_rate * 0.1 ** (epoch // recipe.drop_epochs)


def _validation_set(options: TrainOptions, ids: tuple[int, ...]) -> PoseDataset | None:
    data = options.data
    if data.validation is None:
        return None
    folder = data.validation.suffix != ".json"
    found = open_dataset(
        data.validation, data.validation_images, ids if folder else (), data.least_visible, data.keyframes
    )
    if found.object_ids != ids:
        raise InputError(f"has objects {found.object_ids}, the training data {ids}", path=data.validation)
    return found


def _symmetries(options: TrainOptions, ids: tuple[int, ...]) -> dict[int, Symmetry]:
    if options.models_info is None:
        if options.loss.symmetry_aware:
            raise InputError("the symmetry-aware loss needs to know the symmetries", fix="give --models-info")
        return {}
    from poet_loc.io.bop_models import read_models_info

    models = read_models_info(options.models_info)
    symmetries = {label: models[i].symmetry for label, i in enumerate(ids, start=1) if i in models}
    return {label: symmetry for label, symmetry in symmetries.items() if symmetry is not None}


@contextmanager
def _scoreboard(folder: Path, rank: int) -> Iterator[Any]:
    """Give a function (kind, numbers, progress) that writes log.jsonl and, where tensorboard is there, its events."""
    if rank != 0:
        yield lambda kind, numbers, progress: None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter

        writer = SummaryWriter(str(folder / "tensorboard"))
    except ImportError:
        writer = None

    def note(kind: str, numbers: dict[str, float], progress: Progress) -> None:
        log_row(folder, {"kind": kind, "step": progress.step, "epoch": progress.epoch, **numbers})
        if writer is not None:
            for name, value in numbers.items():
                writer.add_scalar(f"{kind}/{name}", value, progress.step)

    try:
        yield note
    finally:
        if writer is not None:
            writer.close()


@contextmanager
def _progress_bar(run: _Run, rank: int) -> Iterator[Any]:
    """Give a function that moves the bar one step on; silent where the output is no terminal."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    per_epoch = len(run.dataset) // (run.options.recipe.batch * run.world)
    with Bar(console=console, disable=rank != 0 or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("training", total=per_epoch * run.options.recipe.epochs, completed=run.progress.step)
        yield lambda: bar.advance(task)
