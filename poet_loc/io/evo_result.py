"""evo's result zips, so that `evo_res` tables and plots our errors beside its own."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.errors import position_error, statistics
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory, match_stamps
from poet_loc.io.pose_columns import pose_cells
from poet_loc.io.tum import seconds_text

Array = NDArray[np.float64]


def write_evo_result(
    path: str | Path,
    estimate: Trajectory,
    reference: Trajectory,
    name: str,
    max_difference_s: float = 0.01,
    overwrite: bool = False,
) -> Array:
    """Write the APE of the positions, unaligned, as `evo_ape tum REF EST --save_results` does; return it, (N,) m.

    name: what the estimate is called in the merged table. Raises InputError where no stamps match.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise InputError("is there already", path=path, fix="choose another name or pass --overwrite")
    of_reference, of_estimate = match_stamps(reference.stamps_ns, estimate.stamps_ns, round(max_difference_s * 1e9))
    if not of_reference.size:
        raise InputError("no stamps of estimate and reference match", path=path, fix="bring them to one clock")
    reference, estimate = reference[of_reference], estimate[of_estimate]
    error = np.linalg.norm(position_error(estimate.T_world_body, reference.T_world_body), axis=1)
    seconds = (estimate.stamps_ns - estimate.stamps_ns[0]) / 1e9
    steps = np.linalg.norm(np.diff(reference.T_world_body.translation, axis=0), axis=1)
    arrays = {
        "error_array": error,
        "seconds_from_start": seconds,
        "timestamps": estimate.stamps_ns / 1e9,
        "distances_from_start": np.concatenate([[0.0], np.cumsum(steps)]),
    }
    info = {
        "title": "APE w.r.t. translation part (m)\n(not aligned)",
        "label": "APE (m)",
        "ref_name": "reference",
        "est_name": name,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("info.json", json.dumps(info))
        archive.writestr("stats.json", json.dumps(_statistics(error)))
        for key, values in arrays.items():
            archive.writestr(f"{key}.npy", _npy(values))
        archive.writestr("reference.tum", _tum(reference))
        archive.writestr(f"{name}.tum", _tum(estimate))
    return np.asarray(error)


def _statistics(error: Array) -> dict[str, Any]:
    ours = statistics(error)
    return {
        "rmse": ours.rmse,
        "mean": ours.mean,
        "median": ours.median,
        "std": ours.std,
        "min": float(error.min()),
        "max": float(error.max()),
        "sse": float(np.sum(error**2)),
    }


def _npy(values: Array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def _tum(trajectory: Trajectory) -> str:
    columns = [map(repr, column.tolist()) for column in pose_cells(trajectory.T_world_body)]
    rows = zip(map(seconds_text, trajectory.stamps_ns.tolist()), *columns, strict=True)
    return "".join(" ".join(row) + "\n" for row in rows)
