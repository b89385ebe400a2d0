"""How the errors of the solver depend on its thresholds, averages and tie rules."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from landmarks.camera_pose import Mode, SolverOptions, solve
from poet_loc.core.errors import Statistics, position_error, rotation_angle, statistics
from poet_loc.core.input_error import InputError
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory

Array = NDArray[np.float64]

Case = tuple[ObjectPoses, LandmarkMap, Trajectory]
"""Detections, the map, and the ground truth T_world_cam of one log."""

_AGREEMENT: tuple[Mode, ...] = ("out", "prev")
_MEANS: tuple[Mode, ...] = ("all", "out", "prev")
_ROBUST: tuple[Mode, ...] = ("robust",)


@dataclass(frozen=True)
class Sweep:
    """One option, the values it is set to, and the modes that it concerns."""

    option: str
    """Name of a field of SolverOptions, "memory.hold_s" for a field of a field."""
    values: tuple[Any, ...]
    modes: tuple[Mode, ...]


SWEEPS = (
    Sweep("distance", (0.02, 0.05, 0.1, 0.2, 0.4), _AGREEMENT),
    Sweep("angle_deg", (2.0, 5.0, 10.0, 20.0, 40.0), _AGREEMENT),
    Sweep("tie_rule", ("score", "close", "compact", "order"), _AGREEMENT),
    Sweep("position_average", ("mean", "median"), _MEANS),
    Sweep("rotation_average", ("chordal", "geodesic"), _MEANS),
    Sweep("vote_weights", ("equal", "score"), _MEANS),
    Sweep("noise.across", (0.004, 0.008, 0.016), _ROBUST),
    Sweep("noise.along", (0.015, 0.035, 0.07), _ROBUST),
    Sweep("noise.rotation_deg", (1.5, 3.0, 6.0), _ROBUST),
    Sweep("gate_probability", (0.9, 0.99, 0.999), _ROBUST),
    Sweep("memory.evidence_s", (0.0, 1.0, 5.0, 10.0), _ROBUST),
    Sweep("memory.hold_s", (0.0, 0.5, 2.0, 5.0), _ROBUST),
)
"""Every option that can change a number, one at a time, around its default."""


@dataclass(frozen=True)
class SensitivityRow:
    """Errors of one mode with one option set to one value, pooled over the frames of all cases."""

    mode: Mode
    option: str
    value: Any
    default: bool
    """The value is the one of the options that the sweep starts from."""
    frames: int
    position_error_mm: Statistics
    """Of the distance."""
    attitude_error_deg: Statistics
    """Of the angle."""


def sensitivity(
    cases: Sequence[Case], options: SolverOptions | None = None, sweeps: Sequence[Sweep] = SWEEPS
) -> Iterator[SensitivityRow]:
    """Yield one row per mode, option and value, every other option as given; rows without a frame are left out.

    Raises InputError for an unknown option.
    """
    options = options or SolverOptions()
    pooled: dict[SolverOptions, tuple[Array, Array]] = {}
    settings = [(mode, sweep.option, value) for sweep in sweeps for mode in sweep.modes for value in sweep.values]
    for mode, option, value in settings:
        unchanged = replace(options, mode=mode)
        changed = with_option(unchanged, option, value)
        if changed not in pooled:
            errors = [_errors(case, changed) for case in cases]
            position, angle = zip(*errors, strict=True) if errors else ((), ())
            pooled[changed] = np.concatenate([[], *position]), np.concatenate([[], *angle])
        position_error_m, angle_rad = pooled[changed]
        if len(position_error_m):
            yield SensitivityRow(
                mode=mode,
                option=option,
                value=value,
                default=changed == unchanged,
                frames=len(position_error_m),
                position_error_mm=statistics(position_error_m).scaled(1e3),
                attitude_error_deg=statistics(angle_rad).scaled(180.0 / np.pi),
            )


def with_option(options: Any, name: str, value: Any) -> Any:
    """Return options with one field set; "memory.hold_s" names a field of a field.  Raises InputError if unknown."""
    field, _, inner = name.partition(".")
    known = [each.name for each in fields(options)]
    if field not in known:
        raise InputError(f"unknown option {field!r}", fix=f"choose among {', '.join(known)}")
    return replace(options, **{field: with_option(getattr(options, field), inner, value) if inner else value})


def _errors(case: Case, options: SolverOptions) -> tuple[Array, Array]:
    """Return distances (m) and angles (rad) of the frames inside the span of the ground truth."""
    object_poses, landmark_map, reference = case
    poses = solve(object_poses, landmark_map, options, reference).camera_poses
    truth, known = reference.interpolate(poses.stamps_ns)
    estimate, truth = poses.T_world_cam[known], truth[known]
    return np.linalg.norm(position_error(estimate, truth), axis=-1), rotation_angle(estimate, truth)
