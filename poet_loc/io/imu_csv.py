"""imu.csv: IMU samples as EuRoC (ASL) writes them."""

from __future__ import annotations

import re
from pathlib import Path

from poet_loc.core.input_error import InputError
from poet_loc.core.records import ImuSamples
from poet_loc.io.number_table import read_number_csv, write_csv

_GYROSCOPE = ("w_RS_S_x", "w_RS_S_y", "w_RS_S_z")
_ACCELEROMETER = ("a_RS_S_x", "a_RS_S_y", "a_RS_S_z")
_UNITS = {"timestamp": "ns"} | dict.fromkeys(_GYROSCOPE, "rad s^-1") | dict.fromkeys(_ACCELEROMETER, "m s^-2")


def read_imu(path: str | Path) -> ImuSamples:
    """Read IMU samples: rad/s and m/s^2 in imu axes, stamps in ns.

    Raises InputError, with the line, for a malformed row and for stamps that do not increase.
    """

    def column_name(cell: str) -> str:
        match = re.fullmatch(r"#?\s*(\w+)\s*(?:\[(.*)\])?", cell)
        name, unit = match.groups() if match else (cell, None)
        if unit is not None and name in _UNITS and unit.strip() != _UNITS[name]:
            what = f"column {name} is in {unit.strip()}"
            raise InputError(what, path=path, line=1, fix=f"convert it to {_UNITS[name]}")
        return str(name)

    types = {name: int if name == "timestamp" else float for name in _UNITS}
    table = read_number_csv(path, types, column_name=column_name)
    table.refuse_not_finite([*_GYROSCOPE, *_ACCELEROMETER])
    stamps = table["timestamp"]
    table.refuse_disorder(stamps, "sort the rows by time, one per stamp")
    return ImuSamples(stamps, table.stack(_GYROSCOPE), table.stack(_ACCELEROMETER))


def write_imu(path: str | Path, imu: ImuSamples) -> None:
    """Write IMU samples with EuRoC's header."""
    header = [f"{name} [{unit}]" for name, unit in _UNITS.items()]
    columns = [imu.stamps_ns, *imu.angular_velocity.T, *imu.specific_force.T]
    write_csv(path, ["#" + header[0], *header[1:]], columns)
