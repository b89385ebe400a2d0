"""A plain training loop: one cycle, averaged weights, and checkpoints from which a run goes on exactly."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

import torch
from torch import Tensor, nn

from poet_loc.core.input_error import InputError
from poet_loc.data.render import progress_bar
from poet_loc.train.optimizer import Optimizer, OptimizerKind

Precision = Literal["auto", "bfloat16", "float32"]


@dataclass(frozen=True)
class StepOptions:
    """How long and how fast."""

    out: Path
    """Folder of checkpoint.pt and log.jsonl; a run that finds its checkpoint there goes on."""
    steps: int = 5000
    """Optimiser steps in all."""
    batch: int = 16
    """Images per step."""
    learning_rate: float = 1e-3
    """Peak of the one-cycle schedule."""
    optimizer: OptimizerKind = "adamw"
    """muon: orthogonalised steps for the matrices of hidden layers; from equal images it learns about twice as much."""
    weight_decay: float = 1e-2
    warmup: int = 200
    """Steps of linear rise."""
    final_share: float = 0.01
    """Learning rate at the end, share of the peak."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    averaging: float = 0.999
    """Decay of the averaged weights."""
    precision: Precision = "auto"
    """auto: bfloat16 where the CPU has matrix units for it, else float32."""
    seed: int = 0
    save_every: int = 250
    """Steps between checkpoints."""
    max_steps: int | None = None
    """Stop, resumable, after so many steps of this stretch."""


Losses = dict[str, Tensor]
Network = TypeVar("Network", bound=nn.Module)


def low_precision(choice: Precision) -> bool:
    """Return whether to compute in bfloat16."""
    if choice == "auto":
        return bool(torch.cpu._is_amx_tile_supported())
    return choice == "bfloat16"


def learning_rate_at(step: int, options: StepOptions) -> float:
    """Return the rate of a step: linear rise, then a cosine down to the final share."""
    if step < options.warmup:
        return options.learning_rate * (step + 1) / options.warmup
    share = min((step - options.warmup) / max(options.steps - options.warmup, 1), 1.0)
    cosine = 0.5 * (1 + math.cos(math.pi * share))
    return options.learning_rate * (options.final_share + (1 - options.final_share) * cosine)


class Averaged(Generic[Network]):
    """An exponential average of a module's weights and statistics."""

    def __init__(self, module: Network, decay: float) -> None:
        self.module: Network = copy.deepcopy(module).eval()
        self.decay = decay
        self.module.requires_grad_(False)

    @torch.no_grad()
    def update(self, module: nn.Module, step: int) -> None:
        """Move the average towards a module; early steps count more."""
        decay = min(self.decay, (1 + step) / (10 + step))
        for mean, value in zip(self.module.state_dict().values(), module.state_dict().values()):
            if mean.dtype.is_floating_point:
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)


def train_steps(
    module: Network, losses: Callable[[Network, int], Losses], options: StepOptions,
    report: Callable[[Network, int], dict[str, float]] | None = None, report_every: int = 1000,
) -> Network:  # fmt: skip
    """Train a module in place on losses(module, step) and return its average; batches must depend on step alone.

    report(averaged module, step) is validation, and goes into log.jsonl beside the losses.
    """
    run = _Run(module, options)
    last = options.steps if options.max_steps is None else min(options.steps, run.step + options.max_steps)
    for _ in _shown(range(run.step, last), options):
        run.learn(losses)
        if run.step % options.save_every == 0 or run.step == last:
            due = run.step % report_every == 0 or run.step == options.steps
            run.save(report(run.averaged.module, run.step) if report and due else {})
    return run.averaged.module


class _Run(Generic[Network]):
    """A module with its average, its optimiser, and how far it is: what a checkpoint holds."""

    def __init__(self, module: Network, options: StepOptions) -> None:
        options.out.mkdir(parents=True, exist_ok=True)
        self.module, self.options = module, options
        self.parameters = [p for p in module.parameters() if p.requires_grad]
        self.optimizer = Optimizer(module, options.optimizer, options.weight_decay)
        self.averaged = Averaged(module, options.averaging)
        self.low = low_precision(options.precision)
        self.step, self.minutes = 0, 0.0
        self.checkpoint = options.out / "checkpoint.pt"
        if self.checkpoint.exists():
            self._resume()
        self.began = time.process_time() - 60.0 * self.minutes
        self.mean: dict[str, float] = {}

    def learn(self, losses: Callable[[Network, int], Losses]) -> None:
        """Do one step; its losses enter their running means."""
        torch.manual_seed((self.options.seed << 32) + self.step)  # dropout of a resumed run is the uninterrupted one's
        with torch.autocast("cpu", torch.bfloat16, enabled=self.low):
            parts = losses(self.module, self.step)
        total = torch.stack(list(parts.values())).sum()
        self.module.zero_grad(set_to_none=True)
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.options.clip)
        if torch.isfinite(norm):
            self.optimizer.step(learning_rate_at(self.step, self.options))
        self.averaged.update(self.module, self.step)
        self.step += 1
        now = {name: float(part.detach()) for name, part in parts.items()} | {"norm": float(norm)}
        for name, value in now.items():
            self.mean[name] = 0.98 * self.mean.get(name, value) + 0.02 * value

    def save(self, found: dict[str, float]) -> None:
        """Write the checkpoint, whole or not at all, and a row of log.jsonl with what validation found."""
        self.minutes = (time.process_time() - self.began) / 60.0
        row = {"step": self.step, "cpu_minutes": self.minutes, **self.mean, **found}
        with (self.options.out / "log.jsonl").open("a") as file:
            file.write(json.dumps({key: round(float(value), 6) for key, value in row.items()}) + "\n")
        state = {
            "module": self.module.state_dict(),
            "averaged": self.averaged.module.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "cpu_minutes": self.minutes,
        }
        partial = self.checkpoint.with_suffix(".partial")
        torch.save(state, partial)
        partial.replace(self.checkpoint)

    def _resume(self) -> None:
        state = torch.load(self.checkpoint, weights_only=True)
        self.module.load_state_dict(state["module"])
        self.averaged.module.load_state_dict(state["averaged"])
        try:
            self.optimizer.load_state_dict(state["optimizer"])
        except ValueError as error:
            fix = "go on with the same optimizer, or in a new folder"
            raise InputError(str(error), path=self.checkpoint, fix=fix) from error
        self.step, self.minutes = int(state["step"]), float(state["cpu_minutes"])


def _shown(numbers: range, options: StepOptions) -> Iterator[int]:
    """Yield numbers under a bar."""
    with progress_bar("training", f"steps of {options.out.name}", options.steps, already=numbers.start) as advance:
        for number in numbers:
            yield number
            advance(1)


def last_row(folder: Path) -> dict[str, float]:
    """Return the last row of a run's log.jsonl, {} where there is none."""
    path = folder / "log.jsonl"
    rows = path.read_text().splitlines() if path.exists() else []
    return dict(json.loads(rows[-1])) if rows else {}
