"""PoET's annotation.json (its COCO-like ground truth) becomes the object poses of a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError, within
from poet_loc.core.records import ObjectPoses
from poet_loc.io.frames_csv import Frames, read_frames
from poet_loc.io.input_text import read_json
from poet_loc.io.json_fields import FieldError, are_rotations, numbers, required, whole_number
from poet_loc.io.log_folder import Log, check_log, read_log_files, write_log
from poet_loc.io.object_poses_csv import count_instances
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class ConvertAnnotationOptions:
    """How the ground truth of a PoET data set becomes a log."""

    stamps: Path | None = None
    """frames.csv (timestamp_ns,frame,image) whose images are the file names of the annotation; without it an image's
    stamp is its place in the file over --frame-rate."""
    frame_rate: float = 30.0
    """Hz, where there are no --stamps."""
    like: Path | None = None
    """Folder whose map, IMU, calibration and ground truth the new log takes over."""
    name: str = "gt"
    """The object poses become object_poses_NAME.csv."""
    overwrite: bool = False
    """Replace an output folder that holds something."""

    def __post_init__(self) -> None:
        within("(0, inf)", self, "frame_rate")


def convert_annotation(
    annotations: str | Path, out: str | Path, options: ConvertAnnotationOptions | None = None
) -> Log:
    """Write a log folder whose object poses are the relative poses of an annotation file; return it.

    Positions are metres, rotations 3x3 (rows in order), object ids are the category ids; scores are 1. Raises
    InputError for a malformed annotation and an image without a stamp.
    """
    options = options or ConvertAnnotationOptions()
    frames, poses = _poses(Path(annotations), options)
    like = Log(Path(out)) if options.like is None else read_log_files(options.like)
    detections = {**like.object_poses, options.name: poses}
    log = replace(like, path=Path(out), object_poses=detections, frames=like.frames or frames)
    check_log(log)
    inputs = [path for path in (annotations, options.stamps, options.like) if path is not None]
    with whole_folder(out, options.overwrite, inputs) as folder:
        write_log(folder, log)
    return log


def _poses(path: Path, options: ConvertAnnotationOptions) -> tuple[Frames, ObjectPoses]:
    content = read_json(path)
    fix = 'PoET writes {"images": [..], "annotations": [{"image_id", "category_id", "relative_pose"}], ..}'
    if not isinstance(content, Mapping) or not {"images", "annotations"} <= set(content):
        raise InputError("is no annotation file", path=path, fix=fix)
    try:
        images = {
            whole_number(required(image, "id"), "id"): str(required(image, "file_name")) for image in content["images"]
        }
        rows = [_annotation(row) for row in content["annotations"]]
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(str(error), path=path, fix=fix) from None
    if not rows:
        raise InputError("has no annotations", path=path, fix=fix)
    frames = _frames(images, options)
    row_of = {image: row for row, image in enumerate(frames.images)}
    missing = [images.get(row[0], f"id {row[0]}") for row in rows if images.get(row[0]) not in row_of]
    if missing:
        raise InputError(f"no stamp for image {missing[0]}", path=path, fix="list it in --stamps")
    index = np.array([row_of[images[row[0]]] for row in rows])
    order = np.argsort(index, kind="stable")
    ids = np.array([row[1] for row in rows], np.int64)
    rotations = Rotation.from_matrix(np.array([row[2] for row in rows]))
    poses = ObjectPoses(
        stamps_ns=frames.stamps_ns[index],
        frames=frames.frames[index],
        object_ids=ids,
        instances=count_instances(index, ids),
        scores=np.ones(len(rows)),
        T_cam_obj=make_pose(rotations, np.array([row[3] for row in rows])),
    )
    return frames, poses[order]


def _frames(images: Mapping[int, str], options: ConvertAnnotationOptions) -> Frames:
    if options.stamps is not None:
        return read_frames(options.stamps)
    stamps = np.round(np.arange(len(images)) * (1e9 / options.frame_rate)).astype(np.int64)
    return Frames(stamps, np.arange(len(images), dtype=np.int64), tuple(images.values()))


def _annotation(row: Any) -> tuple[int, int, Any, Any]:
    pose = required(row, "relative_pose")
    rotation = np.asarray(required(pose, "rotation"), dtype=float)
    if rotation.size != 9 or not are_rotations(rotation.reshape(3, 3)):
        raise FieldError(f"annotation {row.get('id')}: rotation is none")
    return (
        whole_number(required(row, "image_id"), "image_id"),
        whole_number(required(row, "category_id"), "category_id"),
        rotation.reshape(3, 3),
        numbers(required(pose, "position"), "position", (3,)),
    )
