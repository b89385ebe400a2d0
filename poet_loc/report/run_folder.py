"""A run folder read back: what a run wrote, for those who compare runs or go on with one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.input_text import first_line, read_text
from poet_loc.io.number_table import read_number_csv, write_csv
from poet_loc.io.tum import read_tum
from poet_loc.report.fused import STATE_AXES, HasStates
from poet_loc.report.summary import Summary, read_summary

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

_POSITION, _VELOCITY, _QUATERNION = ("px", "py", "pz"), ("vx", "vy", "vz"), ("qx", "qy", "qz", "qw")
_GYROSCOPE, _ACCELEROMETER = ("bgx", "bgy", "bgz"), ("bax", "bay", "baz")
_SIGMAS = tuple(f"sigma_{axis}" for axis in STATE_AXES)
STATE_COLUMNS = (*_POSITION, *_VELOCITY, *_QUATERNION, *_GYROSCOPE, *_ACCELEROMETER, *_SIGMAS)
"""Of states.csv, after timestamp_ns: m, m/s, q_xyzw, rad/s, m/s^2 and the 1-sigma of each, attitude in rad."""


@dataclass(frozen=True)
class States:
    """The states of states.csv, read back."""

    stamps_ns: Stamps
    T_world_imu: RigidTransform
    velocity: Array
    gyroscope_bias: Array
    accelerometer_bias: Array
    sigmas: Array


@dataclass(frozen=True)
class Run:
    """A run folder; what it does not hold is empty."""

    path: Path
    summary: Summary
    errors: dict[str, dict[str, NDArray[Any]]]
    """The columns of errors.csv by row, then by column: m and rad."""
    trajectories: dict[str, Trajectory] = field(default_factory=dict)
    """By the path of the .tum within the folder, without its ending."""
    states: dict[str, States] = field(default_factory=dict)
    """By the path of the states.csv within the folder, "" at its top."""
    options: dict[str, Any] = field(default_factory=dict)


def write_states(path: str | Path, states: HasStates) -> None:
    """Write states.csv; numbers to nine decimals."""
    T = states.T_world_imu
    biases = [states.gyroscope_bias, states.accelerometer_bias]
    columns = np.hstack([T.translation, states.velocity, T.rotation.as_quat(canonical=True), *biases, states.sigmas])
    write_csv(path, ("timestamp_ns", *STATE_COLUMNS), [states.stamps_ns, *columns.round(9).T])


def read_states(path: str | Path) -> States:
    """Read states.csv.  Raises InputError as the readers of logs do."""
    table = read_number_csv(path, {"timestamp_ns": int, **dict.fromkeys(STATE_COLUMNS, float)})
    table.refuse_not_finite(_QUATERNION)
    q_xyzw = table.stack(_QUATERNION)
    table.refuse(~q_xyzw.any(axis=1), "the quaternion is zero", "run again")
    return States(
        stamps_ns=table["timestamp_ns"],
        T_world_imu=pose_from_quaternion(table.stack(_POSITION), q_xyzw),
        velocity=table.stack(_VELOCITY),
        gyroscope_bias=table.stack(_GYROSCOPE),
        accelerometer_bias=table.stack(_ACCELEROMETER),
        sigmas=table.stack(_SIGMAS),
    )


def read_errors_csv(path: str | Path) -> dict[str, dict[str, NDArray[Any]]]:
    """Return the columns of errors.csv by row name, then by column name; stamps are int64."""
    names = first_line(path).split(",")
    if names[:2] != ["name", "timestamp_ns"]:
        raise InputError("is no errors.csv", path=path, line=1, fix="give the errors.csv of a run folder")
    kinds = {"name": "U128", "timestamp_ns": "i8", "on_common": "i8"}
    dtype = np.dtype([(name, kinds.get(name, "f8")) for name in names])
    try:
        table = np.loadtxt(path, dtype, delimiter=",", skiprows=1, ndmin=1, comments=None, encoding="utf-8")
    except ValueError as error:
        raise InputError(f"cannot be read: {error}", path=path, fix="run again") from error
    rows = {name: table["name"] == name for name in dict.fromkeys(table["name"].tolist())}
    return {row: {name: table[name][mask] for name in names[1:]} for row, mask in rows.items()}


def read_run(path: str | Path) -> Run:
    """Read a run folder.  Raises InputError for a folder that is none."""
    path = Path(path)
    if not (path / "options.yaml").is_file():
        raise InputError("is no run folder", path=path, fix="make one with poet-loc run LOG --out RUN")
    tums, states = sorted(path.rglob("*.tum")), sorted(path.rglob("states.csv"))
    return Run(
        path=path,
        summary=read_summary(path / "summary.json") if (path / "summary.json").is_file() else {},
        errors=read_errors_csv(path / "errors.csv") if (path / "errors.csv").is_file() else {},
        trajectories={tum.relative_to(path).with_suffix("").as_posix(): read_tum(tum) for tum in tums},
        states={file.parent.relative_to(path).as_posix().strip("."): read_states(file) for file in states},
        options=yaml.safe_load(read_text(path / "options.yaml")),
    )
