"""PoET's results.json: per image the objects it sees, without stamps, scores or uncertainties.

{"<image id>": {"0": {"t": [x,y,z] m, "rot": 3x3 or q_wxyz, "box": [cx,cy,w,h] of the image, "class": n}, ..}, ..}
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import ObjectPoses
from poet_loc.io.frames_csv import Frames
from poet_loc.io.input_text import line_of, read_json, read_text
from poet_loc.io.json_fields import FieldError, are_rotations, numbers, required, unit_quaternion, whole_number
from poet_loc.io.object_poses_csv import count_instances
from poet_loc.io.whole_folder import write_whole_file

Array = NDArray[np.float64]

_FIX = "give the results.json of PoET's inference"


@dataclass(frozen=True)
class PoetResults:
    """What PoET saw: N detections in the order of the file."""

    image_ids: tuple[str, ...]
    """Every image of the file, also those without a detection."""
    image_indices: NDArray[np.intp]
    """(N,) which of image_ids a detection belongs to."""
    classes: NDArray[np.int64]
    """(N,) class label, from 1."""
    T_cam_obj: RigidTransform
    boxes: Array
    """(N, 4) centre x, centre y, width, height, as shares of the image's width and height."""

    def __len__(self) -> int:
        return len(self.classes)


def read_poet_results(path: str | Path) -> PoetResults:
    """Read PoET's results: metres; rotation as a matrix or as a quaternion, scalar first.

    Raises InputError, with the image, for a malformed detection.
    """
    content = read_json(path)
    if not isinstance(content, Mapping) or not content:
        raise InputError("has no images", path=path, fix=_FIX)
    image_indices, classes, rotations, translations, boxes = [], [], [], [], []
    for index, (image, detections) in enumerate(content.items()):
        try:
            for fields in _in_order(detections):
                classes.append(whole_number(required(fields, "class"), "class"))
                rotations.append(_rotation(required(fields, "rot")))
                translations.append(numbers(required(fields, "t"), "t", (3,)))
                boxes.append(numbers(required(fields, "box"), "box", (4,)))
                image_indices.append(index)
        except FieldError as error:
            line = line_of(read_text(path), json.dumps(image) + r"\s*:")
            raise InputError(f"image {image}: {error}", path=path, line=line, fix=_FIX) from None
    if not classes:
        raise InputError("has no detections", path=path, fix=_FIX)
    return PoetResults(
        image_ids=tuple(content),
        image_indices=np.array(image_indices, np.intp),
        classes=np.array(classes, np.int64),
        T_cam_obj=make_pose(Rotation.concatenate(rotations), np.array(translations)),
        boxes=np.array(boxes),
    )


def write_poet_results(path: str | Path, results: PoetResults) -> None:
    """Write results as PoET does, rotations as matrices."""
    content: dict[str, dict[str, Any]] = {image: {} for image in results.image_ids}
    matrices = results.T_cam_obj.rotation.as_matrix()
    for row, image in enumerate(results.image_indices.tolist()):
        detections = content[results.image_ids[image]]
        detections[str(len(detections))] = {
            "t": results.T_cam_obj.translation[row].tolist(),
            "rot": matrices[row].tolist(),
            "box": results.boxes[row].tolist(),
            "class": int(results.classes[row]),
        }
    write_whole_file(path, [json.dumps(content), "\n"])


def poet_image_id(image: str) -> str:
    """Return the id that PoET gives an image file: what stands between the first "_" and the last "."."""
    name = PurePath(image).name
    stem = name[: name.rindex(".")] if "." in name else name
    return stem.split("_", 1)[1] if "_" in stem else stem


def stamp_poet_results(
    results: PoetResults, frames: Frames, object_ids: Mapping[int, int] | None = None
) -> ObjectPoses:
    """Return the detections with the stamps and frame numbers of a frame table, sorted by stamp.

    object_ids: class label -> object id; without it the label is the id. Instances count the detections of one class
    in an image, scores are 1. Raises InputError for an image without a stamp, an ambiguous one, or a class without id.
    """
    rows: dict[str, int] = {}
    for row, image in enumerate(frames.images):
        if rows.setdefault(poet_image_id(image), row) != row:
            what = f"images {frames.images[rows[poet_image_id(image)]]} and {image} have one PoET id"
            raise InputError(what, fix="give one stamp per id of results.json")
    used = np.unique(results.image_indices)
    missing = [results.image_ids[index] for index in used if results.image_ids[index] not in rows]
    if missing:
        what = f"no stamp for image {missing[0]} ({len(missing)} such images)"
        raise InputError(what, fix="list it in the stamp table: timestamp_ns,frame,image")
    unknown = [label for label in np.unique(results.classes).tolist() if object_ids and label not in object_ids]
    if unknown:
        raise InputError(f"class {unknown[0]} has no object id", fix="list it in the classes file")
    frame_rows = np.array([rows.get(image, -1) for image in results.image_ids], np.intp)[results.image_indices]
    ids = [object_ids[label] if object_ids else label for label in results.classes.tolist()]
    order = np.argsort(frame_rows, kind="stable")
    poses = ObjectPoses(
        stamps_ns=frames.stamps_ns[frame_rows],
        frames=frames.frames[frame_rows],
        object_ids=np.array(ids, np.int64),
        instances=count_instances(results.image_indices, np.array(ids)),
        scores=np.ones(len(results)),
        T_cam_obj=results.T_cam_obj,
    )
    return poses[order]


def _in_order(detections: Any) -> list[Mapping[str, Any]]:
    if not isinstance(detections, Mapping) or not all(isinstance(fields, Mapping) for fields in detections.values()):
        raise FieldError("holds no detections by number")
    return list(detections.values())


def _rotation(value: Any) -> Rotation:
    if isinstance(value, list) and len(value) == 4:
        w, x, y, z = numbers(value, "rot", (4,))
        return unit_quaternion([x, y, z, w], "rot")
    matrix = numbers(value, "rot", (3, 3))
    if not are_rotations(matrix):
        raise FieldError("rot is no rotation")
    return Rotation.from_matrix(matrix)
