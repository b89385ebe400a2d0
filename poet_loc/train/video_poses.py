"""Poses of all objects in rendered videos or images by a trained network, with ground-truth or detected boxes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation
from torch import Tensor

from poet_loc.core.records import ObjectPoses
from poet_loc.io.bop import BopScene, read_bop_scene
from poet_loc.io.frames_csv import Frames, read_frames
from poet_loc.model.backbone import ImageBatch, batch_images
from poet_loc.model.checkpoint import ModelConfig
from poet_loc.model.heads import covariance_matrices
from poet_loc.model.poet import PoET, PoseOutput
from poet_loc.model.queries import queries_from_detections, real_queries
from poet_loc.train.embedded import Boxes
from poet_loc.train.steps import low_precision


@dataclass(frozen=True)
class VideoPoses:
    """What the network says about one video, and its boxes for the detector's score."""

    poses: dict[Boxes, ObjectPoses]
    detections: list[NDArray[np.float64]]
    """(n, 6) of each frame: x1, y1, x2, y2 px, score, class."""


def poses_of_video(network: PoET, config: ModelConfig, folder: Path, batch: int = 8) -> VideoPoses:
    """Return the poses of a rendered video (a log folder that is a BOP scene as well), both kinds of boxes."""
    frames, scene = read_frames(folder / "frames.csv"), read_bop_scene(folder)
    parts: dict[Boxes, list[ObjectPoses]] = {"bb": [], "gt": []}
    detections: list[NDArray[np.float64]] = []
    for rows, images in _batches(folder, frames, scene, batch):
        with torch.no_grad():
            with torch.autocast("cpu", torch.bfloat16, enabled=low_precision("auto")):
                features = network.extract(images)
            found = network.detector.detect(features)
            detections += [each.double().numpy() for each in found]
            boxes: dict[Boxes, list[Tensor]] = {"bb": found, "gt": [true_boxes(scene, int(row)) for row in rows]}
            for kind, each in boxes.items():
                queries = queries_from_detections(each, images.size, network.options.queries)
                output = network.poses(features, images.mask, queries, images.intrinsics)
                with torch.autocast("cpu", torch.bfloat16, enabled=low_precision("auto")):
                    output = network.refined(images, output)
                parts[kind].append(object_poses(output, config, frames.stamps_ns[rows], frames.frames[rows]))
    return VideoPoses({kind: join(rows) for kind, rows in parts.items()}, detections)


def true_boxes(scene: BopScene, row: int, least_visible: float = 0.1) -> Tensor:
    """Return (n, 6) boxes of the whole objects of an image, clipped to it as in training; score 1."""
    found = scene.annotations
    assert found is not None
    assert found.boxes_object_px is not None
    assert found.visible_fractions is not None
    here = (found.image_ids == scene.image_ids[row]) & (found.visible_fractions >= least_visible)
    x, y, width, height = found.boxes_object_px[here].T
    K = scene.camera_matrices[row]
    limit = np.array([2 * K[0, 2] + 1, 2 * K[1, 2] + 1])
    corners = np.stack([x, y, x + width, y + height], -1).reshape(-1, 2, 2).clip(0, limit).reshape(-1, 4)
    rows = np.concatenate([corners, np.ones((len(corners), 1)), found.object_ids[here, None]], 1)
    return torch.from_numpy(rows[np.all(corners[:, 2:] - corners[:, :2] > 6, axis=1)]).float()


def object_poses(
    output: PoseOutput, config: ModelConfig, stamps_ns: NDArray[np.int64], frames: NDArray[np.int64]
) -> ObjectPoses:
    """Return the real queries of a batch as records, with calibrated covariances where the network has them."""
    real = real_queries(output.queries)
    image = torch.nonzero(real)[:, 0].numpy()
    labels = output.queries.classes[real].numpy()
    rotation = Rotation.from_matrix(output.rotation[real].double().numpy().reshape(-1, 3, 3))
    covariances = None
    if output.translation_uncertainty is not None and output.rotation_uncertainty is not None:
        covariances = np.zeros((len(image), 6, 6))
        scale_t, scale_r = config.variance_scale
        covariances[:, :3, :3] = scale_r * covariance_matrices(output.rotation_uncertainty[real]).double().numpy()
        covariances[:, 3:, 3:] = scale_t * covariance_matrices(output.translation_uncertainty[real]).double().numpy()
    return ObjectPoses(
        stamps_ns[image],
        frames[image],
        np.array([config.object_id(int(label)) for label in labels], np.int64),
        np.zeros(len(image), np.int64),
        output.queries.scores[real].double().numpy(),
        RigidTransform.from_components(output.translation[real].double().numpy().reshape(-1, 3), rotation),
        covariances,
    )


def join(parts: list[ObjectPoses]) -> ObjectPoses:
    """Return the rows of several tables one after the other."""
    parts = [part for part in parts if len(part)] or parts[:1]
    columns = ("stamps_ns", "frames", "object_ids", "instances", "scores")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in columns}
    poses = RigidTransform.concatenate([part.T_cam_obj for part in parts])
    covariances = [part.covariances for part in parts if part.covariances is not None]
    known = np.concatenate(covariances) if len(covariances) == len(parts) else None
    return replace(parts[0], **joined, T_cam_obj=poses, covariances=known)


def _batches(
    folder: Path, frames: Frames, scene: BopScene, batch: int
) -> Iterator[tuple[NDArray[np.int64], ImageBatch]]:
    K = scene.camera_matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    for start in range(0, len(frames), batch):
        rows = np.arange(start, min(start + batch, len(frames)))
        images = [np.asarray(cv2.imread(str(folder / frames.images[row])))[..., ::-1] for row in rows]
        tensors = [torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float() / 255.0 for image in images]
        yield rows, batch_images(tensors, torch.from_numpy(K[rows]).float(), 16)
