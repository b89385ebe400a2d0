"""A loaded network that turns a batch of pictures into object poses."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.data.samples import to_tensor
from poet_loc.detect.bop_images import TrueBoxes
from poet_loc.detect.image_source import Picture
from poet_loc.detect.options import DetectOptions
from poet_loc.io.boxes_csv import read_boxes
from poet_loc.model.backbone import Features, ImageBatch, batch_images
from poet_loc.model.checkpoint import ModelConfig, load_model
from poet_loc.model.device import device_of
from poet_loc.model.fast_poses import FastPoses
from poet_loc.model.heads import covariance_matrices, rotation_matrices
from poet_loc.model.poet import PoET, PoseOutput
from poet_loc.model.queries import QueryBoxes, normalise_boxes, queries_from_detections, stack_queries

Array = NDArray[np.float64]
Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True)
class Sighting:
    """The objects of one picture, n rows."""

    picture: Picture
    labels: NDArray[np.int64]
    """(n,) classes from 1."""
    object_ids: NDArray[np.int64]
    scores: Array
    boxes: Array
    """(n, 4) cx, cy, w, h in shares of the picture."""
    translations: Array
    """(n, 3) m."""
    rotations: Array
    """(n, 3, 3)."""
    covariances: Array | None
    """(n, 6, 6) of [e_r, e_t] in camera axes."""
    seconds: float
    """Run time per picture."""

    def of_objects(self, known: NDArray[np.int64]) -> Sighting:
        """Return the rows of these objects."""
        keep = np.isin(self.object_ids, known)
        if keep.all():
            return self
        columns = ("labels", "object_ids", "scores", "boxes", "translations", "rotations")
        covariances = None if self.covariances is None else self.covariances[keep]
        return replace(self, **{name: getattr(self, name)[keep] for name in columns}, covariances=covariances)

    @property
    def corners_px(self) -> Array:
        """(n, 6) x1, y1, x2, y2 (px), score, class."""
        height, width = self.picture.pixels.shape[:2]
        middle, half = self.boxes[:, :2], self.boxes[:, 2:] / 2
        corners = np.concatenate([middle - half, middle + half], axis=1) * [width, height, width, height]
        return np.concatenate([corners, self.scores[:, None], self.labels[:, None]], axis=1)


class PoseEngine(Protocol):
    """What computes poses from features: the network itself, its fast path, or an exported graph."""

    def poses(
        self, features: Features, image_mask: Tensor, queries: QueryBoxes, intrinsics: Tensor | None = None
    ) -> PoseOutput:
        """Return the poses of boxes."""
        ...


class Estimator:
    """Detector and pose network, ready for pictures."""

    def __init__(
        self, options: DetectOptions, intrinsics: Intrinsics | None = None, source: str | Path | None = None
    ) -> None:
        """intrinsics: of the pictures, where the options have none; source: what holds the true boxes, if asked for."""
        self.options = options
        if options.threads is not None:
            torch.set_num_threads(options.threads)
        self.network, self.config = _load(options)
        self.device = device_of(options.device)
        self.network.to(self.device).requires_grad_(False)
        self.engine = self._engine()
        self.intrinsics = options.intrinsics or intrinsics or self.config.intrinsics
        if self.config.network.needs_intrinsics and self.intrinsics is None:
            raise InputError("this network needs the camera's intrinsics", fix="give --intrinsics fx fy cx cy")
        given = {} if options.boxes is None else read_boxes(options.boxes)
        self.boxes = {name: torch.from_numpy(rows).float() for name, rows in given.items()}
        self.true_boxes = self._true_boxes(source) if options.true_boxes else None
        self.multiple = self.network.detector.shape().multiple
        self._warned = False

    def _true_boxes(self, source: str | Path | None) -> TrueBoxes:
        if self.options.boxes is not None:
            raise InputError("--boxes and --true-boxes ask for different boxes", fix="leave out one of them")
        return TrueBoxes(Path(source or "."), self.config.object_ids, self.config.network.class_count)

    def camera_of(self, picture: Picture) -> Intrinsics | None:
        """Return fx, fy, cx, cy (px) of a picture."""
        known = None if picture.place is None else picture.place.intrinsics
        return self.options.intrinsics or known or self.intrinsics

    def _engine(self) -> PoseEngine:
        options = self.options
        if options.exported is not None:
            from poet_loc.model.exported import ExportedPoses

            return ExportedPoses(options.exported, self.network)
        if options.engine == "eager" or self.device.type != "cpu":
            return self.network
        return FastPoses(self.network, "bfloat16" if options.engine == "bfloat16" else "float32")

    @torch.no_grad()
    def __call__(self, pictures: Sequence[Picture]) -> list[Sighting]:
        """Return what is in each picture."""
        start = time.perf_counter()
        self._compare_cameras(pictures[0])
        batch, features = self.features(pictures)
        queries = self.queries(pictures, batch, features)
        output = self.engine.poses(features, batch.mask, queries, batch.intrinsics)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.options.engine == "bfloat16"):
            output = self.network.refined(batch, output)
        seconds = (time.perf_counter() - start) / len(pictures)
        return [self._sighting(picture, output, i, batch, seconds) for i, picture in enumerate(pictures)]

    def features(self, pictures: Sequence[Picture]) -> tuple[ImageBatch, Features]:
        """Return pictures as a batch, and the detector's maps of it."""
        cameras = [self.camera_of(picture) for picture in pictures]
        given = None if None in cameras else torch.tensor(cameras)
        batch = batch_images([to_tensor(p.pixels) for p in pictures], given, self.multiple).to(self.device)
        return batch, self.network.extract(batch)

    def queries(self, pictures: Sequence[Picture], batch: ImageBatch, features: Features) -> QueryBoxes:
        """Return the boxes to ask about: the true ones or those of a file, if the options say so, else the detector's.

        Raises InputError for a class beyond the network's.
        """
        nothing = torch.zeros(0, 6)
        if self.true_boxes is not None:
            known = [self.true_boxes.of(p.place) for p in pictures if p.place is not None]
            boxes = [normalise_boxes(rows, self._unit(p, batch)) for p, (rows, _) in zip(pictures, known)]
            labels = [label for _, label in known]
            return stack_queries(boxes, labels, self.config.network.queries).to(self.device)
        if self.options.boxes is not None:
            found = [self.boxes.get(p.name, self.boxes.get(Path(p.name).name, nothing)) for p in pictures]
        else:
            found = self.network.detector.detect(features)
        found = [rows[rows[:, 4] >= self.options.score] for rows in found]
        beyond = [
            int(rows[:, 5].max()) for rows in found if len(rows) and rows[:, 5].max() > self.config.network.class_count
        ]
        if beyond:
            raise InputError(f"class {beyond[0]} is beyond the network's {self.config.network.class_count} classes")
        return queries_from_detections(found, batch.size, self.config.network.queries, self.device)

    def _unit(self, picture: Picture, batch: ImageBatch) -> tuple[int, int]:
        """Return the (H, W) px that boxes are shares of: the padded batch, but of true boxes the picture.

        As in the published training; networks that look at pixels themselves know the padded batch alone.
        """
        network = self.config.network
        padded = self.true_boxes is None or network.needs_intrinsics or network.query_features != "none"
        return batch.size if padded else (picture.pixels.shape[0], picture.pixels.shape[1])

    def _sighting(
        self, picture: Picture, output: PoseOutput, image: int, batch: ImageBatch, seconds: float
    ) -> Sighting:
        count = output.queries.counts[image]
        labels = output.queries.classes[image, :count].cpu().numpy()
        height, width = picture.pixels.shape[:2]
        unit = self._unit(picture, batch)
        shares = torch.tensor([unit[1] / width, unit[0] / height] * 2)
        return Sighting(
            picture,
            labels,
            np.array([self.config.object_id(int(label)) for label in labels], np.int64),
            output.queries.scores[image, :count].double().cpu().numpy(),
            (output.queries.boxes[image, :count].cpu() * shares).double().numpy(),
            output.translation[image, :count].double().cpu().numpy(),
            rotation_matrices(output.rotation[image, :count]).double().cpu().numpy(),
            covariances_of(output, image, count, self.config.variance_scale),
            seconds,
        )

    def _compare_cameras(self, picture: Picture) -> None:
        size = picture.pixels.shape[1], picture.pixels.shape[0]
        trained = self.config.image_size
        if self._warned or trained is None or self.config.network.needs_intrinsics or size == trained:
            return
        self._warned = True
        warnings.warn(
            f"images of {size[0]}x{size[1]} for a network trained on {trained[0]}x{trained[1]}: without intrinsics it"
            " knows the camera it was trained with alone",
            stacklevel=3,
        )


def covariances_of(output: PoseOutput, image: int, count: int, scale: tuple[float, float]) -> Array | None:
    """Return (n, 6, 6) covariances of [e_r, e_t] of an image's real queries, None where the network tells none."""
    if output.translation_uncertainty is None or output.rotation_uncertainty is None:
        return None
    result = np.zeros((count, 6, 6))
    for rows, numbers, factor in (
        (slice(3, 6), output.translation_uncertainty, scale[0]),
        (slice(0, 3), output.rotation_uncertainty, scale[1]),
    ):
        result[:, rows, rows] = covariance_matrices(numbers[image, :count].double()).cpu().numpy() * factor
    return result


def _load(options: DetectOptions) -> tuple[PoET, ModelConfig]:
    if options.weights is not None:
        network, config = load_model(options.weights)
        if config.detector is None:
            raise InputError("has no detector", path=options.weights, fix="convert a checkpoint that holds one")
    else:
        from poet_loc.model.embedded import load_embedded

        network, config = load_embedded()
    network.refine_in(options.rounds)
    return network, config
