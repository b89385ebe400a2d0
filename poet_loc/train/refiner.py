"""Trains the refiner on a trained network's estimates, and on truths that were moved at random."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from poet_loc.core.input_error import at_least
from poet_loc.data.coloured_points import coloured_points
from poet_loc.data.packed import AugmentOptions, ObjectModels, PackedImages, Sample, load_models, pack
from poet_loc.data.render import progress_bar
from poet_loc.model.checkpoint import checksum
from poet_loc.model.flow_pose import rotation_of, true_flow
from poet_loc.model.heads import rotation_matrices
from poet_loc.model.poet import PoET
from poet_loc.model.queries import real_queries
from poet_loc.model.refiner import Comparison, Estimates, PoseRefiner, RefinerOptions
from poet_loc.train.detector import batch_numbers, image_batch
from poet_loc.train.embedded import (
    Truth,
    depth_losses,
    half_sines,
    jittered,
    pose_errors,
    pose_figures,
    predict,
    queries_and_truth,
    robust_likelihood,
)
from poet_loc.train.steps import Losses, StepOptions, low_precision, train_steps

Array = NDArray[np.float64]

_FAR = 5.0  # cells: flow beyond the views' reach teaches nothing


@dataclass(frozen=True)
class RefinerLossOptions:
    """What the losses weigh."""

    flow: float = 0.2
    """Absolute error of the flow, cells."""
    centre: float = 2.0
    """Distance of the projected origin in diameters."""
    depth: float = 2.0
    """Absolute log ratio of the depth."""
    rotation: float = 1.0
    """Sine of half the rotation error, about symmetric objects that of their axis."""
    likelihood: float = 0.05
    """Weight of the uncertainty's negative log likelihood; it does not reach the poses."""


@dataclass(frozen=True)
class StartOptions:
    """Where comparisons start while the refiner learns."""

    estimated: float = 0.6
    """Share of the objects that start from the network's estimate; the others start beside the truth."""
    turn_deg: float = 8.0
    """Typical rotation of those per axis, degrees; drawn between a quarter of it and 2.5 times as much."""
    stretch: float = 0.02
    """The same for the distance, share of it."""
    shift_m: float = 0.006
    """The same across, m."""
    jitter: float = 0.04
    """Standard deviation of the boxes' corners that the network is asked about, share of the box."""

    def __post_init__(self) -> None:
        at_least(0, self, "estimated", "turn_deg", "stretch", "shift_m", "jitter")


@dataclass(frozen=True)
class TrainRefinerOptions:
    """Train a refiner for a trained network."""

    train: Path
    """BOP split folder to learn from."""
    validation: Path
    """BOP split folder of other images, for the figures in log.jsonl."""
    models: Path
    """BOP models folder, with textures or colours."""
    cache: Path
    """Folder of the packed scenes."""
    steps: StepOptions
    """Length and speed."""
    refiner: RefinerOptions = field(default_factory=RefinerOptions)
    loss: RefinerLossOptions = field(default_factory=RefinerLossOptions)
    augment: AugmentOptions = field(default_factory=AugmentOptions)
    starts: StartOptions = field(default_factory=StartOptions)
    val_images: int = 300
    """Images of the validation split that are looked at, evenly spread."""
    object_ids: tuple[int, ...] = ()
    """BOP's numbers of classes 1, 2, ...; empty: all models by number."""


def train_refiner(options: TrainRefinerOptions, network: PoET) -> PoseRefiner:
    """Train (or go on training) a refiner, and return its averaged weights; the network stays as it is.

    Raises InputError for data that cannot be read or lack an object's model.
    """
    models = load_models(options.models, options.object_ids)
    refiner = _blank_refiner(options)
    train = _packed(options.train, options.cache / "train", models)
    val = packed_validation(options, models)
    kept = options.steps.out / f"estimates_{checksum(network.state_dict())[:12]}"
    estimates = network_estimates(network, train, models, kept, options.starts.jitter)
    batch, seed = options.steps.batch, options.steps.seed

    def losses(module: PoseRefiner, step: int) -> Losses:
        module.train()
        numbers = batch_numbers(step, batch, len(train), seed + 3)
        rngs = [np.random.default_rng([seed, 41, step, i]) for i in range(batch)]
        samples = [train.sample(n, rng, options.augment) for n, rng in zip(numbers, rngs)]
        known = [estimates[train.index[n][0]] for n in numbers]
        starts = [_start(sample, poses, rng, options.starts) for sample, poses, rng in zip(samples, known, rngs)]
        images, truth = image_batch(samples), truth_of(samples, models)
        start = _estimates(samples, starts)
        assert images.intrinsics is not None
        found = module.compare(images.images, images.intrinsics, start)
        with torch.autocast("cpu", enabled=False):
            return refiner_losses(found, truth, module.diameters[start.classes - 1], options.loss)

    def report(module: PoseRefiner, step: int) -> dict[str, float]:
        network.refiner = module
        figures = pose_figures(*predict(network, val, options.val_images, models), models)
        network.refiner = None
        return figures

    return train_steps(refiner, losses, options.steps, report)


def packed_validation(options: TrainRefinerOptions, models: ObjectModels | None = None) -> PackedImages:
    """Return the images that the figures are of."""
    models = models or load_models(options.models, options.object_ids)
    return _packed(options.validation, options.cache / "val", models, options.val_images)


def _packed(split: Path, cache: Path, models: ObjectModels, most: int | None = None) -> PackedImages:
    """Return a split's images, or so many of them, packed where they are not yet; depth and masks are not needed."""
    return PackedImages(pack(split, cache, with_depth=False), models, stride=None, most=most)


def _blank_refiner(options: TrainRefinerOptions) -> PoseRefiner:
    torch.manual_seed(options.steps.seed)
    refiner = PoseRefiner(options.refiner)
    points, colours, diameters = coloured_points(options.models, options.refiner.points, options.object_ids)
    refiner.show(torch.from_numpy(points).float(), torch.from_numpy(colours), torch.from_numpy(diameters).float())
    return refiner.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def truth_of(samples: list[Sample], models: ObjectModels) -> Truth:
    """Return the objects of samples in order."""
    classes = np.concatenate([sample.classes for sample in samples])
    t = np.concatenate([sample.t_cam_obj for sample in samples])
    R = np.concatenate([sample.R_cam_obj for sample in samples])
    arrays = t, R, models.symmetry_axes[classes - 1], np.ones((len(classes), 2))
    t_, R_, axes, scale = (torch.from_numpy(array).float() for array in arrays)
    return Truth(t_, R_, axes, scale, torch.from_numpy(classes))


@torch.no_grad()
def network_estimates(
    network: PoET, images: PackedImages, models: ObjectModels, folder: Path, jitter: float, batch: int = 25
) -> list[Array]:
    """Return per scene the poses (M, 3, 4) that a network estimates with jittered true boxes; nan where not asked.

    What is done is kept in the folder, scene by scene.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network.eval()
    result: list[Array] = []
    firsts = np.cumsum([0] + [len(scene) for scene in images.scenes])
    with progress_bar("estimating", "scenes", len(images.scenes)) as advance:
        for number, scene in enumerate(images.scenes):
            path = folder / f"{number:06d}.npy"
            if not path.exists():
                poses = np.full((len(scene.object_ids), 3, 4), np.nan)
                for first in range(firsts[number], firsts[number + 1], batch):
                    rows = range(first, min(first + batch, firsts[number + 1]))
                    _estimate(network, images, models, rows, jitter, poses)
                np.save(path.with_suffix(".partial.npy"), poses.astype(np.float32))
                path.with_suffix(".partial.npy").rename(path)
            result.append(np.load(path).astype(float))
            advance(1)
    return result


def _estimate(
    network: PoET, images: PackedImages, models: ObjectModels, numbers: range, jitter: float, poses: Array
) -> None:
    rngs = [np.random.default_rng([43, n]) for n in numbers]
    samples = [images.sample(n, rng) for n, rng in zip(numbers, rngs)]
    boxes = [jittered(sample.boxes, rng, jitter) for sample, rng in zip(samples, rngs)]
    batch = image_batch(samples, network.detector.shape().multiple)
    queries, _ = queries_and_truth(samples, boxes, batch.size, network.options.queries, models)
    with torch.autocast("cpu", torch.bfloat16, enabled=low_precision("auto")):
        output = network.poses(network.extract(batch), batch.mask, queries, batch.intrinsics)
    real, rows = real_queries(queries), np.concatenate([sample.rows for sample in samples])
    poses[rows, :, :3] = rotation_matrices(output.rotation[real]).float().numpy()
    poses[rows, :, 3] = output.translation[real].float().numpy()


def _start(sample: Sample, estimates: Array, rng: np.random.Generator, options: StartOptions) -> tuple[Array, Array]:
    """Return rotations and translations of a sample's objects, estimated or drawn beside the truth."""
    size = np.exp(rng.uniform(np.log(0.25), np.log(2.5), (len(sample.rows), 1)))
    turn = rng.normal(0.0, np.deg2rad(options.turn_deg), (len(size), 3)) * size
    R = Rotation.from_rotvec(turn).as_matrix() @ sample.R_cam_obj
    t = sample.t_cam_obj * np.exp(rng.normal(0.0, options.stretch, size.shape) * size)
    t[:, :2] += rng.normal(0.0, options.shift_m, (len(size), 2)) * size
    known = estimates[sample.rows]
    chosen = ~np.isnan(known[:, 0, 0]) & (rng.random(len(size)) < options.estimated)
    R[chosen], t[chosen] = sample.turn @ known[chosen, :, :3], known[chosen, :, 3] @ sample.turn.T
    return R, t


def _estimates(samples: list[Sample], starts: list[tuple[Array, Array]]) -> Estimates:
    image = np.repeat(np.arange(len(samples)), [len(sample.classes) for sample in samples])
    R, t = (np.concatenate([start[k] for start in starts]) for k in range(2))
    classes = np.concatenate([sample.classes for sample in samples])
    return Estimates(
        torch.from_numpy(image), torch.from_numpy(classes), torch.from_numpy(t).float(), torch.from_numpy(R).float()
    )


def refiner_losses(found: Comparison, truth: Truth, diameters: Tensor, weights: RefinerLossOptions) -> Losses:
    """Return the losses of one round; the flow counts where the model covers the view."""
    t, R = found.corrected.translation, found.corrected.rotation
    nearest = nearest_rotation(truth, found.views.ray @ found.views.rotation)
    flow = true_flow(found.coordinates, found.views, truth.t, nearest, diameters)
    counts = found.drawn & (flow.abs().amax(-1) < _FAR)
    wrong = (found.flow - flow).abs().sum(-1)
    shift = (t[:, :2] / t[:, 2:] - truth.t[:, :2] / truth.t[:, 2:]) * (truth.t[:, 2] / diameters)[:, None]
    assert found.corrected.log_variance is not None
    error = pose_errors(t.detach(), R.detach(), truth)
    return {
        "flow": weights.flow * (wrong * counts).sum() / counts.sum().clamp(min=1),
        "centre": weights.centre * shift.abs().sum(1).mean(),
        "depth": weights.depth * depth_losses(t[:, 2] / truth.t[:, 2]).mean(),
        "rotation": weights.rotation * half_sines(R, truth).mean(),
        "likelihood": weights.likelihood * robust_likelihood(error, found.corrected.log_variance),
    }


def nearest_rotation(truth: Truth, estimate: Tensor) -> Tensor:
    """Return the true rotations (K, 3, 3), of symmetric objects turned about their axis to be nearest the estimate.

    Nearest: the turn by theta about a unit axis a with the largest trace(turn^T D), D = R_true^T R_estimate, which is
    cos(theta) (trace(D) - a^T D a) + sin(theta) a . vee(D - D^T) + a^T D a.
    """
    D, a = truth.R.mT @ estimate, truth.axes
    vee = torch.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], -1)
    along = (a[:, None] @ D @ a[..., None])[:, 0, 0]
    angle = torch.atan2((a * vee).sum(1), D.diagonal(dim1=1, dim2=2).sum(1) - along)
    return truth.R @ rotation_of(angle[:, None] * a)
