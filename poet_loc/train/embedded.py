"""Trains the embedded pose network on the frozen maps of the small detector, and calibrates its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import RigidTransform, Rotation
from torch import Tensor, nn

from poet_loc.core.object_errors import add_s, area_under_curve
from poet_loc.data.packed import AugmentOptions, ObjectModels, PackedImages, Sample, load_models, pack
from poet_loc.model.heads import rotation_matrices
from poet_loc.model.losses import rotation_vector
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoET, PoseOutput
from poet_loc.model.queries import QueryBoxes, normalise_boxes, queries_from_detections, real_queries, stack_queries
from poet_loc.model.small_detector import SmallDetector
from poet_loc.train.detector import batch_numbers, detector_losses, image_batch, targets_of, validate_detector
from poet_loc.train.steps import Losses, StepOptions, train_steps

Boxes = Literal["bb", "gt"]
"""Whose boxes are asked about: the detector's, or the true ones."""

EMBEDDED = NetworkOptions(
    hidden_dim=128,
    heads=8,
    encoder_layers=1,
    decoder_layers=3,
    feedforward_dim=512,
    levels=3,
    dropout=0.0,
    map_channels=(100, 256, 256),
    class_count=10,
    uncertainty="aleatoric",
    encoder_maps=(1, 2),
    query_features="roi",
    box_octaves=5,
    reference_spread="box",
    translation="ray",
    rotation_frame="allocentric",
)
"""The network of the shipped checkpoint; each of its last six fields is a variant the published one does not have."""


NEAREST = 0.2
"""Share of the true depth below which a depth that is predicted directly has no sensible logarithm or projection."""


@dataclass(frozen=True)
class EmbeddedLossOptions:
    """What the pose losses weigh."""

    centre: float = 2.0
    """Distance of the projected origin in boxes."""
    depth: float = 2.0
    """Absolute log ratio of the depth."""
    rotation: float = 1.0
    """Sine of half the rotation error, about symmetric objects that of their axis."""
    earlier_layers: float = 0.5
    """Weight of the decoder's earlier layers."""
    likelihood: float = 0.05
    """Weight of the uncertainty's negative log likelihood; it does not reach the poses."""


@dataclass(frozen=True)
class Truth:
    """The objects of a batch in the order of its real queries."""

    t: Tensor
    """(K, 3)"""
    R: Tensor
    """(K, 3, 3)"""
    axes: Tensor
    """(K, 3) axis of a continuous symmetry, zero where there is none."""
    scale: Tensor
    """(K, 2) from normalised image coordinates to boxes."""
    classes: Tensor
    """(K,)"""

    @property
    def columns(self) -> tuple[Tensor, ...]:
        """All fields in order."""
        return self.t, self.R, self.axes, self.scale, self.classes

    def rows(self, numbers: Tensor) -> Truth:
        """Return some of the objects."""
        return Truth(*(column[numbers] for column in self.columns))


def jittered(boxes: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Return corners (n, 4) moved by a Gaussian of this share of the box's size; a third of the boxes stays exact."""
    size = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    noise = np.clip(rng.normal(0.0, share, boxes.shape), -0.25, 0.25) * size
    return boxes + noise * (rng.random((len(boxes), 1)) < 0.67)


def queries_and_truth(
    samples: list[Sample], boxes: list[np.ndarray], size: tuple[int, int], count: int, models: ObjectModels
) -> tuple[QueryBoxes, Truth]:
    """Return queries from boxes (px), one per object, and the truth in the same order."""
    normalised = [normalise_boxes(torch.from_numpy(rows).float().reshape(-1, 4), size) for rows in boxes]
    labels = [torch.from_numpy(sample.classes) for sample in samples]
    queries = stack_queries(normalised, labels, count)
    classes = np.concatenate([sample.classes for sample in samples])
    focal = np.concatenate([np.tile(sample.intrinsics[:2], (len(sample.classes), 1)) for sample in samples])
    extent = np.concatenate([sample.boxes[:, 2:] - sample.boxes[:, :2] for sample in samples])
    arrays = (
        np.concatenate([sample.t_cam_obj for sample in samples]),
        np.concatenate([sample.R_cam_obj for sample in samples]),
        models.symmetry_axes[classes - 1],
        focal / extent,
    )
    t, R, axes, scale = (torch.from_numpy(array).float() for array in arrays)
    return queries, Truth(t, R, axes, scale, torch.from_numpy(classes))


def half_sines(R: Tensor, truth: Truth) -> Tensor:
    """Return sin(angle / 2) of rotations (K, 3, 3), for symmetric objects that between the axes."""
    difference = R - truth.R
    whole = difference.flatten(1).norm(dim=1) / 8.0**0.5
    axis = (difference @ truth.axes[..., None]).flatten(1).norm(dim=1) / 2.0
    return torch.where(truth.axes.abs().sum(1) > 0, axis, whole)


def depth_losses(ratio: Tensor) -> Tensor:
    """Return |log| of the ratios (K,) of estimated to true depth; below NEAREST, and behind the camera, its tangent."""
    inside = ratio.clamp(min=NEAREST)
    return inside.log().abs() + (inside - ratio) / NEAREST


def pose_losses(output: PoseOutput, truth: Truth, weights: EmbeddedLossOptions) -> Losses:
    """Return the losses of all decoder layers."""
    real = real_queries(output.queries)
    parts: Losses = {}
    layers = [(1.0, output), *[(weights.earlier_layers, layer) for layer in output.auxiliary]]
    for share, layer in layers:
        t, R = layer.translation[real], layer.rotation[real]
        ratio = t[:, 2] / truth.t[:, 2]
        seen_from = torch.maximum(t[:, 2], NEAREST * truth.t[:, 2])[:, None]
        shift = (t[:, :2] / seen_from - truth.t[:, :2] / truth.t[:, 2:]) * truth.scale
        found = {
            "centre": weights.centre * share * shift.abs().sum(1).mean(),
            "depth": weights.depth * share * depth_losses(ratio).mean(),
            "rotation": weights.rotation * share * half_sines(R, truth).mean(),
        }
        if layer.translation_uncertainty is not None and layer.rotation_uncertainty is not None:
            error = pose_errors(t.detach(), R.detach(), truth)
            log_variance = torch.cat([layer.translation_uncertainty[real], layer.rotation_uncertainty[real]], 1)
            found["likelihood"] = weights.likelihood * share * robust_likelihood(error, log_variance)
        parts = {name: parts.get(name, torch.zeros(())) + value for name, value in found.items()}
    return parts


def pose_errors(t: Tensor, R: Tensor, truth: Truth) -> Tensor:
    """Return (K, 6): translation errors (m) and the rotation vector of R = Exp(e) R_true (rad), in camera axes.

    About a symmetry axis the true pose is the one that looks the same and is nearest.
    """
    symmetric = truth.axes.abs().sum(1) > 0
    axis, axis_true = (R @ truth.axes[..., None])[..., 0], (truth.R @ truth.axes[..., None])[..., 0]
    cross = torch.linalg.cross(axis_true, axis)
    angle = torch.atan2(cross.norm(dim=1, keepdim=True), (axis_true * axis).sum(1, keepdim=True))
    tilt = cross / cross.norm(dim=1, keepdim=True).clamp(min=1e-9) * angle
    whole = rotation_vector(R @ truth.R.mT)
    return torch.cat([t - truth.t, torch.where(symmetric[:, None], tilt, whole)], 1)


def robust_likelihood(error: Tensor, log_variance: Tensor) -> Tensor:
    """Return the negative log likelihood of a Laplace density with these variances, the mean over (K, 6).

    The errors have heavy tails: under a Gaussian a few flips would set everybody's variance.
    """
    s = log_variance.clamp(-16.0, 4.0)
    return (2.0**0.5 * error.abs() * torch.exp(-0.5 * s) + 0.5 * s).mean()


@dataclass(frozen=True)
class TrainEmbeddedOptions:
    """Train the embedded pose network on top of a trained small detector."""

    data: Path
    """BOP data set with models/ and the splits."""
    cache: Path
    """Folder of the packed scenes."""
    steps: StepOptions
    """Length and speed."""
    network: NetworkOptions = EMBEDDED
    loss: EmbeddedLossOptions = field(default_factory=EmbeddedLossOptions)
    augment: AugmentOptions = field(default_factory=AugmentOptions)
    jitter: float = 0.04
    """Standard deviation of the boxes' corners, share of the box."""
    fine_tune: bool = False
    """Train the detector with its own losses beside the pose losses, instead of freezing it as the paper does."""
    train_split: str = "train"
    val_split: str = "val"
    val_images: int = 400
    """Images of the validation split that are looked at."""
    scenes: tuple[str, ...] = field(default_factory=tuple)
    """Names of the training scenes; empty: all that are there at the start."""


def train_embedded(options: TrainEmbeddedOptions, detector: SmallDetector) -> PoET:
    """Train (or go on training) the pose network on the detector's maps and return its averaged weights."""
    models = load_models(options.data / "models")
    scenes = pack(options.data / options.train_split, options.cache / options.train_split)
    train = PackedImages([s for s in scenes if not options.scenes or s.name in options.scenes], models)
    val = PackedImages(pack(options.data / options.val_split, options.cache / options.val_split), models)
    torch.manual_seed(options.steps.seed)
    network = PoET(options.network, detector)
    for heads in (network.translation_head, network.rotation_head):
        for head in heads:
            nn.init.normal_(head.get_parameter("layers.2.weight"), std=0.01)  # start at the box's ray and depth
    if options.fine_tune:
        network.backbone[0].requires_grad_(True)
    seed, classes = options.steps.seed, options.network.class_count

    def losses(module: PoET, step: int) -> Losses:
        module.train()
        module.backbone[0].train(options.fine_tune)
        numbers = batch_numbers(step, options.steps.batch, len(train), seed)
        rngs = [np.random.default_rng([seed, 31, step, i]) for i in range(len(numbers))]
        samples = [train.sample(n, rng, options.augment) for n, rng in zip(numbers, rngs)]
        boxes = [jittered(sample.boxes, rng, options.jitter) for sample, rng in zip(samples, rngs)]
        batch = image_batch(samples)
        queries, truth = queries_and_truth(samples, boxes, batch.size, options.network.queries, models)
        features = module.extract(batch)
        output = module.poses(features, batch.mask, queries, batch.intrinsics)
        with torch.autocast("cpu", enabled=False):
            parts = pose_losses(output, truth, options.loss)
            if options.fine_tune:
                heads = features.state
                parts |= detector_losses(heads, targets_of(samples, heads.heat.shape[-2:], classes))
            return parts

    def report(module: PoET, step: int) -> dict[str, float]:
        detector = module.backbone[0]
        assert isinstance(detector, SmallDetector)
        found = validate_detector(detector, val, options.val_images, classes)
        return found | pose_figures(*predict(module, val, options.val_images, models), models)

    return train_steps(network, losses, options.steps, report)


@torch.no_grad()
def predict(
    module: PoET, images: PackedImages, count: int, models: ObjectModels, boxes: Boxes = "gt"
) -> tuple[Tensor, Tensor, Tensor, Truth]:
    """Return translations (K, 3), rotations (K, 3, 3), log variances (K, 6) and the truth of the first images' objects.

    With the true boxes, or with the detector's: of each object the best-scored detection of its class, missed ones left
    out.
    """
    module.eval()
    rows: list[tuple[Tensor, ...]] = []
    for start in range(0, min(count, len(images)), 10):
        samples = [
            images.sample(n, np.random.default_rng(0)) for n in range(start, min(start + 10, count, len(images)))
        ]
        batch = image_batch(samples, module.detector.shape().multiple)
        features, limit = module.extract(batch), module.options.queries
        queries, truth = queries_and_truth(samples, [s.boxes for s in samples], batch.size, limit, models)
        image, query = torch.nonzero(real_queries(queries), as_tuple=True)
        if boxes == "bb":
            queries = queries_from_detections(module.detector.detect(features), batch.size, limit)
            image, query, found = _answers(queries, samples)
            truth = truth.rows(found)
        output = module.refined(batch, module.poses(features, batch.mask, queries, batch.intrinsics))
        parts = (output.translation_uncertainty, output.rotation_uncertainty)
        known = [part[image, query] for part in parts if part is not None]
        s = torch.cat(known, 1) if len(known) == 2 else torch.zeros(len(truth.t), 6)
        R = rotation_matrices(output.rotation[image, query])
        rows.append((output.translation[image, query], R, s, *truth.columns))
    joined = [torch.cat(column) for column in zip(*rows)]
    return joined[0], joined[1], joined[2], Truth(*joined[3:])


def _answers(queries: QueryBoxes, samples: list[Sample]) -> tuple[Tensor, Tensor, Tensor]:
    """Return image, query and number among all objects (K,) of each object's best-scored detection of its class."""
    pairs, number = [], 0
    for image, sample in enumerate(samples):
        for label in sample.classes.tolist():
            same = torch.nonzero(queries.classes[image] == label)[:, 0]
            if len(same):
                pairs.append((image, int(same[queries.scores[image, same].argmax()]), number))
            number += 1
    columns = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 3)
    return columns[:, 0], columns[:, 1], columns[:, 2]


def pose_figures(t: Tensor, R: Tensor, log_variance: Tensor, truth: Truth, models: ObjectModels) -> dict[str, float]:
    """Return medians (cm, degrees), the AUC of ADD-S (0..100) and the share within one sigma per axis."""
    error = pose_errors(t, R, truth).double().numpy()
    distance, angle = np.linalg.norm(error[:, :3], axis=1), np.rad2deg(np.linalg.norm(error[:, 3:], axis=1))
    labels = truth.classes.numpy()
    est, ref = _poses(t, R), _poses(truth.t, truth.R)
    add_s_m = np.zeros(len(labels))
    for label in np.unique(labels):
        add_s_m[labels == label] = add_s(est[labels == label], ref[labels == label], models.surface[label - 1])
    inside = np.abs(error) < np.exp(0.5 * log_variance.double().numpy())
    figures = {
        "t_cm": float(np.median(distance) * 100), "t_mean_cm": float(distance.mean() * 100),
        "depth_cm": float(np.median(np.abs(error[:, 2])) * 100), "r_deg": float(np.median(angle)),
        "r_mean_deg": float(angle.mean()), "auc_add_s": area_under_curve(add_s_m),
        "coverage_t": float(inside[:, :3].mean()), "coverage_r": float(inside[:, 3:].mean()),
    }  # fmt: skip
    for label in np.unique(labels):
        figures[f"r_deg_{label}"] = float(np.median(angle[labels == label]))
    return figures


def _poses(t: Tensor, R: Tensor) -> RigidTransform:
    return RigidTransform.from_components(t.double().numpy(), Rotation.from_matrix(R.double().numpy()))
