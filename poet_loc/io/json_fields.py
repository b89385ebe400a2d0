"""Fields of JSON and YAML mappings, checked one by one; what is wrong comes back as one line."""

from __future__ import annotations

from collections.abc import Mapping
from reprlib import repr as shortened
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose

Array = NDArray[np.float64]

_ROTATION_TOLERANCE = 1e-2


class FieldError(ValueError):
    """What is wrong with a field; the reader adds file, line and what to do."""


def required(fields: Mapping[str, Any], name: str) -> Any:
    """Return a field.  Raises FieldError where it is missing."""
    if name not in fields:
        raise FieldError(f"{name} is missing")
    return fields[name]


def whole_number(value: Any, name: str) -> int:
    """Return an integer of 64 bits.  Raises FieldError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        raise FieldError(f"{name} is {shortened(value)}, no whole number of 64 bits")
    return value


def number(value: Any, name: str) -> float:
    """Return a finite float; YAML reads 1e-5 as text, so text is tried too.  Raises FieldError otherwise."""
    return float(numbers(value, name, ()))


def numbers(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    """Return finite floats of one shape.  Raises FieldError otherwise."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise FieldError(f"{name} holds something that is no number") from None
    if array.shape != shape:
        form = " x ".join(map(str, shape)) or "one"
        raise FieldError(f"{name} has the shape {array.shape}: {form} number{'s' if shape else ''} belong there")
    if not np.isfinite(array).all():
        raise FieldError(f"{name} is NaN or infinite")
    return array


def unit_quaternion(value: Any, name: str) -> Rotation:
    """Return a rotation from four numbers q_xyzw.  Raises FieldError where the norm is off by more than 1 %."""
    q_xyzw = numbers(value, name, (4,))
    norm = float(np.linalg.norm(q_xyzw))
    if abs(norm - 1) > _ROTATION_TOLERANCE:
        raise FieldError(f"{name} is zero" if norm == 0 else f"{name} has norm {norm:.4g} instead of 1")
    return Rotation.from_quat(q_xyzw)


def are_rotations(matrices: Array) -> NDArray[np.bool_]:
    """Return which 3x3 matrices are proper rotations up to rounding and a network's slips.  (..., 3, 3) -> (...)."""
    off = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    return (off < _ROTATION_TOLERANCE) & (np.linalg.det(matrices) > 0)


def rigid_matrix(value: Any, name: str) -> RigidTransform:
    """Return a transform from a 4x4 matrix.  Raises FieldError where it is none."""
    matrix = numbers(value, name, (4, 4))
    if not are_rotations(matrix[:3, :3]):
        raise FieldError(f"{name} holds no rotation: its 3x3 block is not orthonormal with determinant +1")
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise FieldError(f"{name} does not end in the row 0 0 0 1")
    return make_pose(Rotation.from_matrix(matrix[:3, :3]), matrix[:3, 3])
