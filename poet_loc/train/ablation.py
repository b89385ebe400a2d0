"""The ablation on the rendered world: the paper's rows and ours, each trained with the same small budget."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from poet_loc.core.input_error import InputError
from poet_loc.data.packed import PackedImages, load_models, pack
from poet_loc.io.whole_folder import write_whole_file
from poet_loc.model.embedded import load_embedded
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.small_detector import SmallDetector
from poet_loc.train.embedded import EMBEDDED, TrainEmbeddedOptions, pose_figures, predict, train_embedded
from poet_loc.train.steps import StepOptions

FAITHFUL = replace(
    EMBEDDED,
    encoder_layers=3,
    uncertainty="none",
    encoder_maps=None,
    query_features="none",
    box_octaves=None,
    reference_spread="point",
    translation="direct",
    rotation_frame="camera",
)
"""The paper's network at the embedded width, without any variant of ours."""

PAPER_ROWS: dict[str, NetworkOptions] = {
    "Baseline": FAITHFUL,
    "Agnostic": replace(FAITHFUL, class_mode="agnostic"),
    "Small": replace(FAITHFUL, encoder_layers=1, decoder_layers=1, heads=4),
    "RP": replace(FAITHFUL, reference_points="learned"),
    "Q": replace(FAITHFUL, query_embedding="learned"),
    "RP + Q": replace(FAITHFUL, reference_points="learned", query_embedding="learned"),
}
"""T. Jantos et al., "PoET" (CoRL 2022), section 4.3."""

OUR_ROWS: dict[str, NetworkOptions] = {
    "Embedded": replace(EMBEDDED, uncertainty="none"),
    "without RoI features": replace(EMBEDDED, uncertainty="none", query_features="none"),
    "all octaves of the box code": replace(EMBEDDED, uncertainty="none", box_octaves=None),
    "without spread reference points": replace(EMBEDDED, uncertainty="none", reference_spread="point"),
    "translation direct": replace(EMBEDDED, uncertainty="none", translation="direct"),
    "rotation in camera axes": replace(EMBEDDED, uncertainty="none", rotation_frame="camera"),
    "encoder over all maps": replace(EMBEDDED, uncertainty="none", encoder_maps=None),
}
"""The embedded network, and what it loses without each of its variants."""


@dataclass(frozen=True)
class AblationOptions:
    """Train every row of the ablation on the frozen detector of the embedded network."""

    data: Path
    """BOP data set with models/ and the splits train and val (poet-loc render images)."""
    out: Path
    """Folder of caches, checkpoints and figures.json; what is there is not done again."""
    rows: tuple[str, ...] = tuple(PAPER_ROWS)
    """Names of rows; those of ours besides: Embedded, without RoI features, all octaves of the box code, without spread
    reference points, translation direct, rotation in camera axes, encoder over all maps."""
    steps: int = 1000
    """Optimiser steps of each row."""
    batch: int = 16
    """Images per step."""
    val_images: int = 400
    """Validation images that the figures come from."""
    seed: int = 0
    """Seed of weights and of the order of images, the same for every row."""
    max_steps: int | None = None
    """Stop, resumable, after so many steps of each row in this stretch."""


def ablate(options: AblationOptions) -> dict[str, dict[str, float]]:
    """Train the rows as far as the options say and return their validation figures (see embedded.pose_figures).

    Figures are kept in figures.json beside the checkpoints, by row; a row that went on since is measured anew.
    Raises InputError for a row that does not exist.
    """
    networks = PAPER_ROWS | OUR_ROWS
    for name in options.rows:
        if name not in networks:
            raise InputError(f"the ablation has no row '{name}'", fix=f"one of {', '.join(networks)}")
    models = load_models(options.data / "models")
    val = PackedImages(pack(options.data / "val", options.out / "packed" / "val"), models)
    kept = options.out / "figures.json"
    figures = json.loads(kept.read_text()) if kept.exists() else {}
    for name in options.rows:
        trained, cpu_minutes, step = _trained(options, name, networks[name])
        if figures.get(name, {}).get("step") != step:
            found = pose_figures(*predict(trained, val, options.val_images, models), models)
            figures[name] = {"step": step, "cpu_minutes": cpu_minutes, **found}
            write_whole_file(kept, [json.dumps(figures, indent=1) + "\n"])
    return {name: figures[name] for name in networks if name in options.rows}


def _trained(options: AblationOptions, name: str, network: NetworkOptions) -> tuple[PoET, float, float]:
    """Return a row's network, and the CPU minutes and steps that it took."""
    detector = load_embedded()[0].detector
    assert isinstance(detector, SmallDetector)
    steps = StepOptions(
        options.out / name.replace(" ", "_"),
        options.steps,
        options.batch,
        learning_rate=5e-4,
        warmup=options.steps // 10,
        seed=options.seed,
        max_steps=options.max_steps,
    )
    training = TrainEmbeddedOptions(options.data, options.out / "packed", steps, network, val_images=options.val_images)
    trained = train_embedded(training, detector)
    last = json.loads((steps.out / "log.jsonl").read_text().splitlines()[-1])
    return trained, last["cpu_minutes"], last["step"]


def ablation_table(figures: dict[str, dict[str, float]]) -> str:
    """Return the figures as Markdown; medians, with true boxes."""
    lines = ["| network | steps | CPU min | t cm | r deg | AUC ADD-S |", "|---|--:|--:|--:|--:|--:|"]
    for name, row in figures.items():
        spent = f"{row['step']:.0f} | {row['cpu_minutes']:.1f}"
        lines.append(f"| {name} | {spent} | {row['t_cm']:.2f} | {row['r_deg']:.1f} | {row['auc_add_s']:.1f} |")
    return "\n".join(lines)
