"""The files of a training run: what was asked, what happened, and where to go on."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from poet_loc.core.input_error import InputError
from poet_loc.model.checkpoint import ModelConfig, save_model
from poet_loc.model.poet import PoET
from poet_loc.train.options import TrainOptions

NOTHING_TO_GO_ON_WITH = {"options.json", "log.jsonl", "tensorboard", "last.pt.part"}
"""What a run leaves that failed before it was first saved; the next one may begin there."""
MAY_CHANGE = ("out", "resume", "max_steps", "save_every", "device")


@dataclass(frozen=True)
class Progress:
    """Where a run stands."""

    epoch: int = 0
    batch: int = 0
    """Batches of the epoch that are done."""
    step: int = 0
    best: float | None = None
    """Least validation score so far, m."""


def plain(options: Any) -> Any:
    """Return options as JSON values."""
    return json.loads(json.dumps(asdict(options), default=str))


def begin(options: TrainOptions, config: ModelConfig, anew: list[str]) -> None:
    """Make the run's folder and write what was asked.  Raises InputError for a folder that already has a run."""
    there = {path.name for path in options.out.iterdir()} if options.out.is_dir() else set()
    if there - NOTHING_TO_GO_ON_WITH:
        raise InputError("already holds a run", path=options.out, fix="give --resume, or another folder")
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "log.jsonl").unlink(missing_ok=True)
    about = {
        "options": plain(options),
        "model": config.to_json(),
        "started_at_random": anew,
        "versions": {"python": platform.python_version(), "torch": torch.__version__},
        "threads": torch.get_num_threads(),
    }
    (options.out / "options.json").write_text(json.dumps(about, indent=1) + "\n")


def log_row(folder: Path, row: Mapping[str, Any]) -> None:
    """Append a row to log.jsonl."""
    with (folder / "log.jsonl").open("a") as file:
        file.write(json.dumps(dict(row)) + "\n")


def save_progress(options: TrainOptions, network: PoET, optimizer: torch.optim.Optimizer, progress: Progress) -> None:
    """Write last.pt, whole or not at all: weights without the frozen detector, optimiser, place in the schedule."""
    content = {
        "weights": {name: t for name, t in network.state_dict().items() if not name.startswith("backbone.0.")},
        "optimizer": optimizer.state_dict(),
        "progress": asdict(progress),
        "options": plain(options),
    }
    unfinished = options.out / "last.pt.part"
    torch.save(content, unfinished)
    unfinished.replace(options.out / "last.pt")


def load_progress(options: TrainOptions, network: PoET, optimizer: torch.optim.Optimizer) -> Progress:
    """Read last.pt into network and optimiser.  Raises InputError where the run was another one."""
    path = options.out / "last.pt"
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise InputError("there is no run to go on with", path=path, fix="start without --resume") from None
    except Exception as error:
        raise InputError(f"cannot be read ({type(error).__name__})", path=path) from None
    asked = {key: value for key, value in plain(options).items() if key not in MAY_CHANGE}
    before = {key: value for key, value in content["options"].items() if key not in MAY_CHANGE}
    other = sorted(key for key in asked if asked[key] != before.get(key))
    if other:
        raise InputError(
            f"the run had other options: {', '.join(other)}", path=path, fix="give the same, or start anew"
        )
    detector = {name: t for name, t in network.state_dict().items() if name.startswith("backbone.0.")}
    network.load_state_dict({**detector, **content["weights"]}, strict=True)
    optimizer.load_state_dict(content["optimizer"])
    progress = Progress(**content["progress"])
    forget_after(options.out, progress.step)
    return progress


def forget_after(folder: Path, step: int) -> None:
    """Drop the rows of log.jsonl that a resumed run will write again."""
    path = folder / "log.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    kept = [line for line in lines if json.loads(line)["step"] <= step]
    if len(kept) < len(lines):
        path.write_text("".join(line + "\n" for line in kept))


def save_network(
    options: TrainOptions, name: str, network: PoET, config: ModelConfig, about: Mapping[str, Any]
) -> None:
    """Write a network's weights and configuration into the run's folder."""
    save_model(options.out / name, network, replace(config, source={**config.source, **about}))
