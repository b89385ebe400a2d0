"""The preset `embedded`: from rendered images to a calibrated checkpoint, resumable at every stage."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from poet_loc.data.packed import PackedImages, load_models, pack
from poet_loc.model.checkpoint import ModelConfig, save_model
from poet_loc.model.poet import PoET
from poet_loc.model.small_detector import SmallDetector, SmallDetectorOptions
from poet_loc.train.add_refiner import AddRefinerOptions
from poet_loc.train.calibration import calibrate
from poet_loc.train.detector import TrainDetectorOptions, train_detector
from poet_loc.train.embedded import EMBEDDED, TrainEmbeddedOptions, train_embedded
from poet_loc.train.optimizer import OptimizerKind
from poet_loc.train.refiner import TrainRefinerOptions, train_refiner
from poet_loc.train.steps import Precision, StepOptions, last_row

Stage = Literal["detector", "joint", "refiner"]
STAGES: tuple[Stage, ...] = ("detector", "joint", "refiner")


@dataclass(frozen=True)
class EmbeddedPresetOptions:
    """Render, train and calibrate the embedded detector and pose network; run it again to go on."""

    out: Path
    """Folder of data, caches, checkpoints and the result embedded.safetensors."""
    train_images: int = 20000
    """Rendered training images."""
    val_images: int = 1000
    """Rendered validation images, of other scenes."""
    detector_steps: int = 700
    """Steps of the detector alone, before the pose network joins."""
    joint_steps: int = 15500
    """Steps of detector and pose network together."""
    refiner_steps: int = AddRefinerOptions.steps
    """Steps of the refiner, once the pose network has done all of its own."""
    batch: int = 16
    """Images per step."""
    seed: int = 0
    """Seed of data and weights."""
    precision: Precision = StepOptions.precision
    """auto: bfloat16 where the CPU has matrix units for it, else float32."""
    max_steps: int | None = None
    """Stop, resumable, after so many steps of each stage in this stretch."""
    world: Path | None = None
    """Folder of the rendered data set; without it out/world."""
    jobs: int = -1
    """Processes that render; -1: one per core."""


def train_preset(options: EmbeddedPresetOptions) -> Path:
    """Do whatever is missing and return the checkpoint."""
    from poet_loc.data.render import RenderOptions, render

    world, cache = options.world or options.out / "world", options.out / "packed"
    shared = {"out": world, "seed": options.seed, "jobs": options.jobs}
    render(RenderOptions(split="val", images=options.val_images, first_scene=900_000, **shared))  # type: ignore[arg-type]
    render(RenderOptions(split="train", images=options.train_images, **shared))  # type: ignore[arg-type]
    train_detector(TrainDetectorOptions(world, cache, _steps(options, "detector")))
    detector = SmallDetector(SmallDetectorOptions())
    detector.load_state_dict(torch.load(options.out / "detector" / "checkpoint.pt", weights_only=True)["module"])
    network = train_embedded(TrainEmbeddedOptions(world, cache, _steps(options, "joint"), fine_tune=True), detector)
    if _done(options.out / "joint") >= options.joint_steps:
        asked = TrainRefinerOptions(world / "train", world / "val", world / "models", cache, _steps(options, "refiner"))
        refiner = train_refiner(asked, network)
        if _done(options.out / "refiner") >= options.refiner_steps:
            network.refiner = refiner
    return finish(network, world, cache, options.out / "embedded.safetensors", history(options.out))


def _steps(options: EmbeddedPresetOptions, stage: Stage) -> StepOptions:
    stages: dict[Stage, tuple[int, float, OptimizerKind]] = {
        "detector": (options.detector_steps, 1e-3, "adamw"),
        "joint": (options.joint_steps, 7e-4, "muon"),
        "refiner": (options.refiner_steps, AddRefinerOptions.learning_rate, "muon"),
    }
    count, rate, kind = stages[stage]
    return StepOptions(
        options.out / stage,
        steps=count,
        batch=options.batch,
        learning_rate=rate,
        optimizer=kind,
        precision=options.precision,
        seed=options.seed,
        max_steps=options.max_steps,
    )


def _done(stage: Path) -> float:
    return last_row(stage).get("step", 0.0)


def history(folder: Path) -> dict[str, object]:
    """Return what a run's logs say about its length, for the record in the checkpoint."""
    last = {stage: last_row(folder / stage) for stage in STAGES}
    told: dict[str, object] = {
        stage: {key: row[key] for key in ("step", "cpu_minutes")} for stage, row in last.items() if row
    }
    return {"preset": "embedded", **told}


def finish(network: PoET, world: Path, cache: Path, out: Path, source: dict[str, object]) -> Path:
    """Calibrate a network on the validation images, for the detector's boxes, and write it in half precision."""
    val = PackedImages(pack(world / "val", cache / "val"), load_models(world / "models"))
    found = calibrate(network, val)
    names = json.loads((world / "models" / "names.json").read_text())
    ids = tuple(sorted(int(key) for key in names))
    detector = network.detector
    assert isinstance(detector, SmallDetector)
    config = ModelConfig(
        EMBEDDED,
        detector.options,
        ids,
        tuple(names[str(number)] for number in ids),
        image_size=(320, 240),
        refiner=None if network.refiner is None else network.refiner.options,
        source={**source, **found},
    )
    save_model(out, network, config, half=True)
    return out
