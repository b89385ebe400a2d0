"""What to train, on what, and how: the options of the stage, and the published recipes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from poet_loc.core.input_error import at_least
from poet_loc.data.augmentation import AugmentationOptions
from poet_loc.model.losses import LossOptions
from poet_loc.model.matcher import BoxMode
from poet_loc.model.options import NetworkOptions


@dataclass(frozen=True)
class DataOptions:
    """Images and poses to learn from."""

    train: Path
    """BOP split folder, or annotation file (.json)."""
    validation: Path | None = None
    """The same for validation; without it the last weights are the best."""
    train_images: Path | None = None
    """Folder of an annotation file's images, if it does not lie as published."""
    validation_images: Path | None = None
    object_ids: tuple[int, ...] = ()
    """BOP object id of class 1, 2, ...; empty: those that occur, sorted."""
    least_visible: float = 0.05
    """Share of the silhouette below which an object does not count (BOP)."""
    keyframes: Path | None = None
    """File of lines like 0048/000001 that restricts the validation images (BOP)."""
    workers: int = 0
    """Processes that read images."""


@dataclass(frozen=True)
class RecipeOptions:
    """The optimiser and its schedule; `RECIPES` has the published ones."""

    epochs: int = 50
    batch: int = 16
    """Images per step and process."""
    learning_rate: float = 2e-4
    attention_rate: float = 0.1
    """Factor on the learning rate of sampling offsets and reference points."""
    weight_decay: float = 1e-4
    """Of everything, norms and biases too."""
    drop_epochs: int = 100
    """The learning rate falls to a tenth every so many epochs."""
    clip: float = 0.1
    """Largest norm of the gradient; 0: no limit."""
    mixed_precision: bool = True
    """bfloat16 where there is a GPU."""

    def __post_init__(self) -> None:
        at_least(0, self, "epochs", "learning_rate", "attention_rate", "weight_decay", "clip")
        at_least(1, self, "batch", "drop_epochs")


@dataclass(frozen=True)
class TrainOptions:
    """Everything that a training run depends on."""

    out: Path
    """Folder of the run: last.pt, best.safetensors, network.safetensors, log.jsonl, options.json, tensorboard/."""
    data: DataOptions
    recipe: RecipeOptions = field(default_factory=RecipeOptions)
    network: NetworkOptions = field(default_factory=NetworkOptions)
    """Not with `start`, whose file holds its own."""
    loss: LossOptions = field(default_factory=LossOptions)
    augmentation: AugmentationOptions = field(default_factory=AugmentationOptions)
    start: Path | None = None
    """Weights to start from (.safetensors), detector included."""
    backbone: Literal["small", "yolov4", "torchvision"] = "yolov4"
    """Detector under the network; not with `start`."""
    backbone_weights: Path | None = None
    """Its weights: a file of ours, a .pt, or a Darknet binary (.weights)."""
    boxes: BoxMode = "gt"
    """Boxes that are asked about: the true ones, jittered ones, or the detector's."""
    uncertainty: Literal["as the network", "aleatoric", "full"] = "as the network"
    """With `start`: add uncertainty heads of this kind to a network that has none."""
    train_only: Literal["all", "uncertainty"] = "all"
    """uncertainty: everything but the uncertainty heads is frozen."""
    models_info: Path | None = None
    """BOP models_info.json, for the symmetry-aware loss."""
    resume: bool = False
    """Go on from last.pt in the run's folder, exactly as if it had not been interrupted."""
    max_steps: int | None = None
    """Stop, resumable, after so many steps of this call."""
    save_every: int = 1000
    """Steps between two writings of last.pt; it is also written after every epoch."""
    validate_every: int = 1
    """Epochs between two validations."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda where there is one."""
    seed: int = 42

    def __post_init__(self) -> None:
        at_least(1, self, "save_every", "validate_every", *([] if self.max_steps is None else ["max_steps"]))
        at_least(0, self.data, "workers")


RECIPES: dict[str, tuple[RecipeOptions, LossOptions]] = {
    "paper": (replace(RecipeOptions(), learning_rate=2e-5), LossOptions(translation_weight=2.0)),
    "code": (RecipeOptions(), LossOptions(translation_weight=1.0)),
    "ycbv": (RecipeOptions(), LossOptions(translation_weight=2.0)),
}
"""Published recipes: the paper's (CoRL 2022, section 4), the defaults of the official code, and the values that its
authors gave for YCB-V (learning rate of the code, weights of the paper)."""
