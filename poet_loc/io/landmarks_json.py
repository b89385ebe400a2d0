"""landmarks.json: the map, T_world_obj of each known object."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Landmark, LandmarkMap, Symmetry
from poet_loc.io.input_text import line_of, read_json, read_text
from poet_loc.io.json_fields import FieldError, numbers, required, unit_quaternion, whole_number
from poet_loc.io.whole_folder import write_whole_file

_FIELDS = ("object_id", "instance", "name", "t", "q_xyzw", "covariance", "symmetry")
_FARTHEST_M = 1000.0
_FIX = 'a landmark is {"object_id": 3, "instance": 0, "name": "box", "t": [x,y,z], "q_xyzw": [x,y,z,w], ..}, in metres'


def read_landmarks(path: str | Path) -> LandmarkMap:
    """Read a landmark map: metres, q_xyzw; instance, name, covariance and symmetry may be left out.

    Raises InputError for a field that is missing, unknown or wrong, and for two landmarks with one id.
    """
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("landmarks"), list):
        raise InputError('has no list "landmarks"', path=path, line=1, fix=_FIX)
    if not content["landmarks"]:
        raise InputError("has no landmarks", path=path, fix=_FIX)
    landmarks: dict[tuple[int, int], Landmark] = {}
    for index, fields in enumerate(content["landmarks"]):
        try:
            landmark = _landmark(fields)
            if landmark.key in landmarks:
                raise FieldError(f"object {landmark.key[0]}, instance {landmark.key[1]} is there twice")
        except FieldError as error:
            line = line_of(read_text(path), r'"object_id"\s*:', index)
            raise InputError(f"landmark {index + 1}: {error}", path=path, line=line, fix=_FIX) from None
        landmarks[landmark.key] = landmark
    return LandmarkMap(tuple(landmarks.values()))


def write_landmarks(path: str | Path, landmark_map: LandmarkMap) -> None:
    """Write a landmark map."""
    content = {"landmarks": [_fields(landmark) for landmark in landmark_map]}
    write_whole_file(path, [json.dumps(content, indent=1), "\n"])


def _landmark(fields: Any) -> Landmark:
    if not isinstance(fields, Mapping):
        raise FieldError("is no mapping of fields")
    unknown = [name for name in fields if name not in _FIELDS]
    if unknown:
        raise FieldError(f"unknown field {unknown[0]!r}")
    translation = numbers(required(fields, "t"), "t", (3,))
    if np.linalg.norm(translation) > _FARTHEST_M:
        raise FieldError(f"t is {np.linalg.norm(translation):.0f} long, it looks like millimetres")
    name = fields.get("name", "")
    if not isinstance(name, str):
        raise FieldError(f"name is {name!r}, no text")
    return Landmark(
        object_id=whole_number(required(fields, "object_id"), "object_id"),
        T_world_obj=make_pose(unit_quaternion(required(fields, "q_xyzw"), "q_xyzw"), translation),
        instance=whole_number(fields.get("instance", 0), "instance"),
        name=name,
        covariance=_covariance(fields.get("covariance")),
        symmetry=_symmetry(fields.get("symmetry")),
    )


def _covariance(value: Any) -> np.ndarray | None:
    if value is None:
        return None
    covariance = numbers(value, "covariance", (6, 6))
    scale = np.abs(covariance).max()
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-9 * scale):
        raise FieldError("covariance is not symmetric")
    if np.linalg.eigvalsh(covariance)[0] < -1e-6 * scale:
        raise FieldError("covariance is not positive semidefinite")
    return covariance


def _symmetry(value: Any) -> Symmetry | None:
    if value is None:
        return None
    if not isinstance(value, Mapping) or set(value) != {"axis", "order"}:
        raise FieldError('symmetry is null or {"axis": [x,y,z], "order": n or "continuous"}')
    axis = numbers(value["axis"], "symmetry axis", (3,))
    length = float(np.linalg.norm(axis))
    if length == 0:
        raise FieldError("symmetry axis is zero")
    order = value["order"]
    if order != "continuous" and whole_number(order, "symmetry order") < 2:
        raise FieldError(f'symmetry order is {order}: 2 or more, or "continuous", belongs there')
    x, y, z = (axis / length if abs(length - 1) > 1e-9 else axis).tolist()
    return Symmetry((x, y, z), order)


def _fields(landmark: Landmark) -> dict[str, Any]:
    symmetry = landmark.symmetry
    return {
        "object_id": int(landmark.object_id),
        "instance": int(landmark.instance),
        "name": landmark.name,
        "t": landmark.T_world_obj.translation.tolist(),
        "q_xyzw": landmark.T_world_obj.rotation.as_quat(canonical=True).tolist(),
        "covariance": None if landmark.covariance is None else np.asarray(landmark.covariance).tolist(),
        "symmetry": None if symmetry is None else {"axis": list(symmetry.axis), "order": symmetry.order},
    }
