"""An evaluation as files: summary.json in millimetres and degrees, errors.csv in metres and radians."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from poet_loc.core.consistency import mean_bounds
from poet_loc.core.errors import statistics
from poet_loc.core.input_error import InputError
from poet_loc.io.input_text import read_json
from poet_loc.io.number_table import write_csv
from poet_loc.io.whole_folder import write_whole_file
from poet_loc.report.evaluate import ERROR_AXES, Evaluation, Row

Array = NDArray[np.float64]

POSITION_KEYS = ("x", "y", "z", "norm")
ATTITUDE_KEYS = ("yaw", "roll", "pitch", "angle")
"""In the order of the published table."""

_MM, _DEG = 1e3, 180.0 / np.pi
_SIGMAS_BOUND = 3.0

AxisStatistics = dict[str, float | None]


class ErrorSummary(TypedDict):
    """Statistics of the absolute errors per axis: mean, std, median, p95, rmse; None without a frame."""

    frames: int
    position_error_mm: dict[str, AxisStatistics]
    attitude_error_deg: dict[str, AxisStatistics]


class RowSummary(ErrorSummary):
    """What summary.json holds for one row; nees, inside_3_sigma and runtime_s are None where unknown."""

    coverage: float
    frames_in_span: int
    compared_at: str
    on_common_frames: ErrorSummary
    nees: dict[str, Any] | None
    inside_3_sigma: dict[str, float] | None
    runtime_s: float | None
    body: str
    oracle: bool


Summary = dict[str, RowSummary]


def to_summary(evaluation: Evaluation) -> Summary:
    """Return what summary.json holds: one entry a row, by name."""
    return {row.name: _row_summary(row, evaluation.options.confidence) for row in evaluation.rows}


def write_summary(path: str | Path, summary: Mapping[str, RowSummary]) -> None:
    """Write summary.json: plain JSON, null where there is no number."""
    write_whole_file(path, [json.dumps(summary, indent=1, allow_nan=False), "\n"])


def read_summary(path: str | Path) -> Summary:
    """Read summary.json.  Raises InputError for a file that is missing or holds something else."""
    content = read_json(path)
    needed = RowSummary.__required_keys__ - {"inside_3_sigma", "body", "oracle", "frames_in_span", "compared_at"}
    if not isinstance(content, dict) or not all(
        isinstance(row, dict) and needed <= row.keys() for row in content.values()
    ):
        raise InputError("is no summary of a run", path=path, fix="give the summary.json of a run folder")
    return content


def write_errors_csv(path: str | Path, evaluation: Evaluation) -> None:
    """Write every row's errors, one line per stamp: m and rad, with the 1-sigma of each and the NEES where known."""
    columns: dict[str, list[ArrayLike]] = {}

    def put(name: str, values: ArrayLike) -> None:
        columns.setdefault(name, []).append(values)

    for row in evaluation.rows:
        n = len(row.stamps_ns)
        put("name", [row.name] * n)
        put("timestamp_ns", row.stamps_ns)
        put("on_common", row.on_common.astype(int))
        units = ["m", "m", "m", "rad", "rad", "rad"]
        for axis, unit, values in zip(ERROR_AXES, units, row.errors.T, strict=True):
            put(f"{axis}_{unit}", values.round(9))
        put("norm_m", np.linalg.norm(row.errors[:, :3], axis=1).round(9))
        put("angle_rad", row.angles.round(9))
        sigmas = np.full((n, 6), np.nan) if row.sigmas is None else row.sigmas
        for axis, unit, values in zip(ERROR_AXES, units, sigmas.T, strict=True):
            put(f"sigma_{axis}_{unit}", values.round(9))
        put("nees", np.full(n, np.nan) if row.nees is None else row.nees.round(6))
    write_csv(path, list(columns), [np.concatenate(parts) for parts in columns.values()])


def inside_3_sigma(row: Row) -> dict[str, float] | None:
    """Return the share of stamps whose error lies within three of its sigmas, by axis; None without sigmas."""
    if row.sigmas is None:
        return None
    known = np.isfinite(row.sigmas).all(axis=1)
    if not known.any():
        return None
    inside = np.abs(row.errors[known]) <= _SIGMAS_BOUND * row.sigmas[known]
    return dict(zip(ERROR_AXES, inside.mean(axis=0).tolist(), strict=True))


def _row_summary(row: Row, confidence: float) -> RowSummary:
    return {
        **_error_summary(row),
        "coverage": row.coverage,
        "frames_in_span": row.frames_in_span,
        "compared_at": row.frames_of,
        "on_common_frames": _error_summary(row.common()),
        "nees": _nees_summary(row, confidence),
        "inside_3_sigma": inside_3_sigma(row),
        "runtime_s": row.runtime_s,
        "body": row.body,
        "oracle": row.oracle,
    }


def _error_summary(row: Row) -> ErrorSummary:
    errors = dict(zip(ERROR_AXES, row.errors.T, strict=True))
    errors |= {"norm": np.linalg.norm(row.errors[:, :3], axis=1), "angle": row.angles}
    return {
        "frames": len(row.stamps_ns),
        "position_error_mm": _statistics_by_axis(errors, POSITION_KEYS, _MM),
        "attitude_error_deg": _statistics_by_axis(errors, ATTITUDE_KEYS, _DEG),
    }


def _statistics_by_axis(errors: Mapping[str, Array], axes: Sequence[str], unit: float) -> dict[str, AxisStatistics]:
    return {axis: {k: _number(v) for k, v in asdict(statistics(errors[axis]).scaled(unit)).items()} for axis in axes}


def _nees_summary(row: Row, confidence: float) -> dict[str, Any] | None:
    if row.nees is None or not np.isfinite(row.nees).any():
        return None
    nees = row.nees[np.isfinite(row.nees)]
    return {"pose": float(nees.mean()), "bounds": list(mean_bounds(6, len(nees), confidence))}


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None
