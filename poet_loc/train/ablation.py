"""The ablation on the rendered world: the paper's rows and ours, each trained with the same small budget."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from poet_loc.data.packed import PackedImages, load_models, pack
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
    """BOP data set with models/ and the splits train and val."""
    out: Path
    """Folder of caches and checkpoints; rows that are there go on where they stopped."""
    rows: tuple[str, ...] = ()
    """Names of rows; empty: all."""
    steps: int = 1000
    """Optimiser steps of each row."""
    batch: int = 16
    val_images: int = 400
    seed: int = 0


def ablate(options: AblationOptions) -> dict[str, dict[str, float]]:
    """Train the rows and return their validation figures (see embedded.pose_figures)."""
    models = load_models(options.data / "models")
    val = PackedImages(pack(options.data / "val", options.out / "packed" / "val"), models)
    figures = {}
    for name, network_options in (PAPER_ROWS | OUR_ROWS).items():
        if options.rows and name not in options.rows:
            continue
        detector = load_embedded()[0].detector
        assert isinstance(detector, SmallDetector)
        folder = options.out / name.replace(" ", "_")
        steps = StepOptions(folder, options.steps, options.batch, learning_rate=5e-4, seed=options.seed)
        training = TrainEmbeddedOptions(
            options.data, options.out / "packed", steps, network_options, val_images=options.val_images
        )
        trained: PoET = train_embedded(training, detector)
        figures[name] = pose_figures(*predict(trained, val, options.val_images, models), models)
    return figures


def ablation_table(figures: dict[str, dict[str, float]]) -> str:
    """Return the figures as Markdown."""
    lines = ["| network | t cm, median | r deg, median | AUC ADD-S |", "|---|--:|--:|--:|"]
    for name, row in figures.items():
        lines.append(f"| {name} | {row['t_cm']:.2f} | {row['r_deg']:.1f} | {row['auc_add_s']:.1f} |")
    return "\n".join(lines)
