"""How the solver's errors depend on its options, one changed at a time, as a table."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from landmarks.sensitivity import SensitivityRow, sensitivity
from poet_loc.core.input_error import InputError
from poet_loc.io.log_folder import Log
from poet_loc.report.tables import Column, Table

_STATISTICS = ("mean", "median", "p95", "rmse")


def sensitivity_rows(logs: Sequence[Log], detections: Iterable[str | None]) -> dict[str, tuple[SensitivityRow, ...]]:
    """Return the rows of each set of detections, pooled over the logs that have it, a map and the ground truth.

    Raises InputError where there is none.
    """
    found = {}
    for name in (each for each in detections if each is not None):
        cases = [
            (log.object_poses[name], log.landmark_map, log.T_world_cam)
            for log in logs
            if name in log.object_poses and log.landmark_map is not None and log.T_world_cam is not None
        ]
        if cases:
            found[name] = tuple(sensitivity(cases))
    if not found:
        raise InputError("no log has ground truth of the camera", fix="sensitivity needs T_world_cam.tum")
    return found


def sensitivity_tables(rows_by_detections: Mapping[str, Sequence[SensitivityRow]]) -> list[Table]:
    """Return one table per set of detections; the defaults are bold."""
    columns = [Column("mode"), Column("option"), Column("value"), Column("frames", "Frames")]
    columns += [Column(text, "Position error", "mm") for text in _STATISTICS]
    columns += [Column(text, "Attitude error", "deg") for text in _STATISTICS]
    tables = []
    for name, rows in rows_by_detections.items():
        kinds = [(row.mode, row.option) for row in rows]
        tables.append(
            Table(
                f"Sensitivity of the solver{f', {name}' if name else ''}",
                tuple(columns),
                tuple(tuple(_cells(row)) for row in rows),
                frozenset((i, 2) for i, row in enumerate(rows) if row.default),
                frozenset(i for i in range(1, len(rows)) if kinds[i] != kinds[i - 1]),
                ("One option at a time; bold: the default. Own frames of each row.",),
            )
        )
    return tables


def sensitivity_text(rows_by_detections: Mapping[str, Sequence[SensitivityRow]], form: str) -> str:
    """Return the tables as markdown or LaTeX, or every number as csv or json."""
    if form in ("md", "latex"):
        tables = sensitivity_tables(rows_by_detections)
        return "\n".join(table.markdown() if form == "md" else table.latex() for table in tables)
    records = [{"detections": name, **_record(row)} for name, rows in rows_by_detections.items() for row in rows]
    if form == "json":
        return json.dumps(records, indent=1, allow_nan=False) + "\n"
    text = io.StringIO()
    writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def _cells(row: SensitivityRow) -> Iterator[str]:
    yield from (row.mode, row.option, f"{row.value}", f"{row.frames}")
    for errors, digits in ((row.position_error_mm, 1), (row.attitude_error_deg, 2)):
        yield from (f"{getattr(errors, statistic):.{digits}f}" for statistic in _STATISTICS)


def _record(row: SensitivityRow) -> dict[str, Any]:
    record = {"mode": row.mode, "option": row.option, "value": row.value, "default": row.default, "frames": row.frames}
    record |= {f"position_{statistic}_mm": value for statistic, value in asdict(row.position_error_mm).items()}
    return record | {f"attitude_{statistic}_deg": value for statistic, value in asdict(row.attitude_error_deg).items()}
