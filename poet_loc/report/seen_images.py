"""The images of a log with what was seen in them: boxes, and poses as lines to draw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.records import Camera, ObjectPoses
from poet_loc.io.boxes_csv import read_boxes
from poet_loc.io.log_folder import Log, object_poses_file

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SeenImages:
    """Image files in order of time, and the boxes that were found in them."""

    stamps_ns: NDArray[np.int64]
    files: tuple[Path, ...]
    boxes: Mapping[str, Array] = field(default_factory=dict)
    """By file name, (n, 6): x1, y1, x2, y2 (px), score, class."""

    def __len__(self) -> int:
        return len(self.files)


def images_of(log: Log, detections: str | None) -> SeenImages | None:
    """Return the images that frames.csv names and that are there, with boxes_NAME.csv of these detections if any."""
    if log.frames is None:
        return None
    files = [log.path / name for name in log.frames.images]
    there = np.array([file.is_file() for file in files], bool)
    if not there.any():
        return None
    boxes = log.path / object_poses_file(detections or "").replace("object_poses", "boxes")
    found = read_boxes(boxes) if detections is not None and boxes.exists() else {}
    return SeenImages(log.frames.stamps_ns[there], tuple(file for file, kept in zip(files, there) if kept), found)


def axis_lines(poses: ObjectPoses, camera: Camera, length_m: float = 0.05) -> Array:
    """Return (n, 3, 2, 2) the image lines from each object's origin along its x, y, z axes, px; nan behind the camera.

    Lenses' distortion is left out.
    """
    ends = length_m * poses.T_cam_obj.rotation.as_matrix().mT + poses.T_cam_obj.translation[:, None]
    origin, ends = project(poses.T_cam_obj.translation, camera), project(ends, camera)
    return np.stack([np.repeat(origin[:, None], 3, axis=1), ends], axis=2)


def position_ellipses(poses: ObjectPoses, camera: Camera, sigmas: float = 3.0, corners: int = 24) -> Array:
    """Return (n, corners + 1, 2) closed outlines in the image, px, within which the origin lies by its covariance.

    First-order propagation of the position's covariance through the projection.  Raises ValueError without covariances.
    """
    if poses.covariances is None:
        raise ValueError("these poses have no covariances")
    x, y, z = poses.T_cam_obj.translation.T
    z = np.where(z > _NEAR_M, z, np.nan)
    fx, fy = camera.intrinsics[:2]
    J = np.zeros((len(poses), 2, 3))
    J[:, 0, 0], J[:, 0, 2], J[:, 1, 1], J[:, 1, 2] = fx / z, -fx * x / z**2, fy / z, -fy * y / z**2
    covariance = J @ poses.covariances[:, 3:, 3:] @ J.mT
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    values, axes = np.linalg.eigh(np.where(known[:, None, None], covariance, np.eye(2)))
    turn = np.linspace(0.0, 2 * np.pi, corners + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    outline = sigmas * (axes * np.sqrt(np.maximum(values, 0.0))[:, None]) @ circle
    return np.where(known[:, None, None], outline.mT + project(poses.T_cam_obj.translation, camera)[:, None], np.nan)


def project(points_cam: Array, camera: Camera) -> Array:
    """Return pixels (..., 2) of points (..., 3) in camera axes; nan behind the camera."""
    fx, fy, cx, cy = camera.intrinsics
    z = np.where(points_cam[..., 2] > _NEAR_M, points_cam[..., 2], np.nan)
    return np.stack([fx * points_cam[..., 0] / z + cx, fy * points_cam[..., 1] / z + cy], axis=-1)


_NEAR_M = 1e-3
