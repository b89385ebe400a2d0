"""models_info.json of a BOP dataset: size and symmetries of each object's model; millimetres outside."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Symmetry
from poet_loc.io.input_text import line_of, read_json, read_text
from poet_loc.io.json_fields import FieldError, number, numbers, required, rigid_matrix
from poet_loc.io.whole_folder import write_whole_file

Array = NDArray[np.float64]

_MM_PER_M = 1000.0
_SAME_AXIS = np.cos(np.deg2rad(3.0))
_SAME_ANGLE_RAD = np.deg2rad(3.0)


@dataclass(frozen=True)
class BopModel:
    """One object's model."""

    diameter_m: float
    box_m: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Least corner and size of the axis-aligned box in object axes."""
    symmetries_discrete: RigidTransform | None = None
    """T_obj_obj that leave the looks unchanged, the identity left out."""
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    """(axis, a point on it in m) that every turn about leaves the looks unchanged."""

    @property
    def symmetry(self) -> Symmetry | None:
        """The largest group of turns about one axis through the origin that the model's symmetries hold.

        A landmark knows one axis: further ones (a box's three half-turns) and an axis beside the origin are left out.
        """
        if self.symmetries_continuous:
            return Symmetry(self.symmetries_continuous[0][0], "continuous")
        if self.symmetries_discrete is None:
            return None
        return _largest_cyclic_group(self.symmetries_discrete.rotation)


def read_models_info(path: str | Path) -> dict[int, BopModel]:
    """Read the models by object id.  Raises InputError for a malformed file."""
    content = read_json(path)
    if not isinstance(content, Mapping) or not all(isinstance(fields, Mapping) for fields in content.values()):
        raise InputError("has no models", path=path, fix="give a BOP models_info.json")
    models = {}
    for key, fields in content.items():
        try:
            models[int(key)] = _model(fields)
        except ValueError as error:
            what = f"model {key}: {error}" if isinstance(error, FieldError) else f"{key!r} is no object id"
            line = line_of(read_text(path), rf'"{key}"\s*:')
            raise InputError(what, path=path, line=line, fix="write it as the BOP format wants it") from None
    return models


def models_of(path: str | Path, object_ids: Sequence[int]) -> dict[int, BopModel]:
    """Read the models of these objects in this order, all by number where none is named.

    Raises InputError for a malformed file, and where an object is missing.
    """
    models = read_models_info(path)
    missing = [str(number) for number in object_ids if number not in models]
    if missing:
        raise InputError(f"has no model of object {', '.join(missing)}", path=path, fix="give the objects' own models")
    return {number: models[number] for number in object_ids or sorted(models)}


def write_models_info(path: str | Path, models: Mapping[int, BopModel]) -> None:
    """Write the models, one a line."""
    lines = (f' "{key}": {json.dumps(_fields(model))}' for key, model in models.items())
    write_whole_file(path, ["{\n", ",\n".join(lines), "\n}\n"])


def _model(fields: Mapping[str, Any]) -> BopModel:
    diameter = number(required(fields, "diameter"), "diameter") / _MM_PER_M
    if diameter <= 0:
        raise FieldError("diameter is not positive")
    corner = [number(required(fields, f"min_{axis}"), f"min_{axis}") / _MM_PER_M for axis in "xyz"]
    size = [number(required(fields, f"size_{axis}"), f"size_{axis}") / _MM_PER_M for axis in "xyz"]
    discrete = [_discrete(value) for value in fields.get("symmetries_discrete", [])]
    continuous = [_continuous(value) for value in fields.get("symmetries_continuous", [])]
    return BopModel(
        diameter_m=diameter,
        box_m=((corner[0], corner[1], corner[2]), (size[0], size[1], size[2])),
        symmetries_discrete=RigidTransform.concatenate(discrete) if discrete else None,
        symmetries_continuous=tuple(continuous),
    )


def _discrete(value: Any) -> RigidTransform:
    T_mm = rigid_matrix(numbers(value, "symmetries_discrete", (16,)).reshape(4, 4), "symmetries_discrete")
    return RigidTransform.from_components(T_mm.translation / _MM_PER_M, T_mm.rotation)


def _continuous(value: Any) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    if not isinstance(value, Mapping):
        raise FieldError("symmetries_continuous holds axis and offset")
    axis = numbers(required(value, "axis"), "axis", (3,))
    offset = numbers(value.get("offset", [0, 0, 0]), "offset", (3,)) / _MM_PER_M
    length = float(np.linalg.norm(axis))
    if length == 0:
        raise FieldError("axis of symmetries_continuous is zero")
    x, y, z = (axis / length).tolist()
    return (x, y, z), (float(offset[0]), float(offset[1]), float(offset[2]))


def _largest_cyclic_group(rotations: Rotation) -> Symmetry | None:
    rotvecs = np.atleast_2d(rotations.as_rotvec())
    angles = np.linalg.norm(rotvecs, axis=1)
    rotvecs, angles = rotvecs[angles > _SAME_ANGLE_RAD], angles[angles > _SAME_ANGLE_RAD]
    best: Symmetry | None = None
    for rotvec, angle in zip(rotvecs, angles, strict=True):
        axis = rotvec / angle
        about = np.abs(rotvecs @ axis) / angles > _SAME_AXIS
        order = int(np.count_nonzero(about)) + 1
        turns = angles[about] * order / (2 * np.pi)
        whole = np.all(np.abs(turns - np.round(turns)) < order * _SAME_ANGLE_RAD / (2 * np.pi))
        if whole and (best is None or order > int(best.order)):
            # A half-turn's axis has no sign: the largest component is made positive.
            x, y, z = (axis * np.sign(axis[np.argmax(np.abs(axis))])).tolist()
            best = Symmetry((x, y, z), order)
    if best is None and len(angles):
        warnings.warn("discrete symmetries that are no turns by 2 pi / n about one axis are left out", stacklevel=3)
    return best


def _fields(model: BopModel) -> dict[str, Any]:
    corner, size = model.box_m
    fields: dict[str, Any] = {"diameter": model.diameter_m * _MM_PER_M}
    fields |= {f"min_{axis}": value * _MM_PER_M for axis, value in zip("xyz", corner, strict=True)}
    fields |= {f"size_{axis}": value * _MM_PER_M for axis, value in zip("xyz", size, strict=True)}
    if model.symmetries_discrete is not None:
        matrices = np.atleast_3d(model.symmetries_discrete.as_matrix()).reshape(-1, 4, 4).copy()
        matrices[:, :3, 3] *= _MM_PER_M
        fields["symmetries_discrete"] = matrices.reshape(-1, 16).tolist()
    if model.symmetries_continuous:
        fields["symmetries_continuous"] = [
            {"axis": list(axis), "offset": [value * _MM_PER_M for value in point]}
            for axis, point in model.symmetries_continuous
        ]
    return fields
