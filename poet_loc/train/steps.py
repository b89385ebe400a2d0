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
    options.out.mkdir(parents=True, exist_ok=True)
    parameters = [p for p in module.parameters() if p.requires_grad]
    optimizer = Optimizer(module, options.optimizer, options.weight_decay)
    averaged = Averaged(module, options.averaging)
    step, spent = _resume(options.out / "checkpoint.pt", module, averaged, optimizer)
    start = time.process_time()
    mean: dict[str, float] = {}
    low = low_precision(options.precision)
    last = options.steps if options.max_steps is None else min(options.steps, step + options.max_steps)
    for _ in _shown(range(step, last), options):
        torch.manual_seed((options.seed << 32) + step)  # dropout of a resumed run is that of an uninterrupted one
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            parts = losses(module, step)
        total = torch.stack(list(parts.values())).sum()
        module.zero_grad(set_to_none=True)
        total.backward()
        norm = nn.utils.clip_grad_norm_(parameters, options.clip)
        if torch.isfinite(norm):
            optimizer.step(learning_rate_at(step, options))
        averaged.update(module, step)
        step += 1
        for name, value in {
            **{name: float(part.detach()) for name, part in parts.items()},
            "norm": float(norm),
        }.items():
            mean[name] = 0.98 * mean.get(name, value) + 0.02 * value
        if step % options.save_every == 0 or step == last:
            minutes = spent + (time.process_time() - start) / 60
            found = (
                report(averaged.module, step) if report and (step % report_every == 0 or step == options.steps) else {}
            )
            _log(options.out / "log.jsonl", {"step": step, "cpu_minutes": minutes, **mean, **found})
            _save(options.out / "checkpoint.pt", module, averaged, optimizer, step, minutes)
    return averaged.module


def _shown(numbers: range, options: StepOptions) -> Iterator[int]:
    """Yield numbers under a bar."""
    with progress_bar("training", f"steps of {options.out.name}", options.steps, already=numbers.start) as advance:
        for number in numbers:
            yield number
            advance(1)


def _resume(path: Path, module: Network, averaged: Averaged[Network], optimizer: Optimizer) -> tuple[int, float]:
    if not path.exists():
        return 0, 0.0
    state = torch.load(path, weights_only=True)
    module.load_state_dict(state["module"])
    averaged.module.load_state_dict(state["averaged"])
    try:
        optimizer.load_state_dict(state["optimizer"])
    except ValueError as error:
        raise InputError(str(error), path=path, fix="go on with the same optimizer, or in a new folder") from error
    return int(state["step"]), float(state["cpu_minutes"])


def _save(
    path: Path,
    module: Network,
    averaged: Averaged[Network],
    optimizer: Optimizer,
    step: int,
    minutes: float,
) -> None:
    state = {
        "module": module.state_dict(), "averaged": averaged.module.state_dict(), "optimizer": optimizer.state_dict(),
        "step": step, "cpu_minutes": minutes,
    }  # fmt: skip
    partial = path.with_suffix(".partial")
    torch.save(state, partial)
    partial.replace(path)


def last_row(folder: Path) -> dict[str, float]:
    """Return the last row of a run's log.jsonl, {} where there is none."""
    path = folder / "log.jsonl"
    rows = path.read_text().splitlines() if path.exists() else []
    return dict(json.loads(rows[-1])) if rows else {}


def _log(path: Path, row: dict[str, float]) -> None:
    with path.open("a") as file:
        file.write(json.dumps({key: round(float(value), 6) for key, value in row.items()}) + "\n")
