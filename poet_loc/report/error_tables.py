"""The tables of errors: the published localisation table's shape, consistency, and APE/RPE."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from poet_loc.core.errors import Relation, Statistics
from poet_loc.report.compare import Comparison
from poet_loc.report.summary import ATTITUDE_KEYS, POSITION_KEYS, ErrorSummary, RowSummary, Summary, to_summary
from poet_loc.report.tables import Column, Table

TableFormat = Literal["md", "latex", "csv", "json"]

_STATISTICS = ("mean", "std", "median", "p95", "rmse")
_UNITS: dict[Relation, str] = {
    "translation_part": "m",
    "rotation_part": "",
    "full_transformation": "",
    "rotation_angle_rad": "rad",
    "rotation_angle_deg": "deg",
    "point_distance": "m",
    "point_distance_error_ratio": "%",
}


@dataclass(frozen=True)
class Block:
    """Rows that were compared with each other."""

    summary: Summary
    detections: str = ""
    """The name of the set of detections; empty where there is only one."""
    log: str = ""
    """The log, or what was pooled; empty where there is only one."""


def error_table(blocks: Sequence[Block], title: str = "Errors on the common frames") -> Table:
    """Return the published table: mean ± std of the absolute error per axis, and the tails that they hide.

    Position in mm, attitude in deg; median, p95 and RMSE are of the norm and of the angle. The lowest RMSE of each
    block is bold, oracles aside.
    """
    names = _name_columns(blocks)
    columns = [Column(header) for header in names]
    columns += [Column(text, "Position error", "mm") for text in (*POSITION_KEYS[:3], "median", "p95", "RMSE")]
    columns += [Column(text, "Attitude error", "deg") for text in (*ATTITUDE_KEYS[:3], "median", "p95", "RMSE")]
    columns += [Column("own RMSE", "Own frames", "mm"), Column("own RMSE", "Own frames", "deg")]
    columns += [Column("coverage", "Own frames", "%")]
    rows: list[tuple[str, ...]] = []
    bold, rules = set(), set()
    for block in blocks:
        rules.add(len(rows))
        for row, column in _lowest_rmse(block.summary):
            bold.add((len(rows) + row, len(names) + column))
        for name, row_summary in block.summary.items():
            rows.append((*_names(block, name, row_summary, names), *_error_cells(row_summary)))
    return Table(title, tuple(columns), tuple(rows), frozenset(bold), frozenset(rules - {0}), tuple(_notes(blocks)))


def consistency_table(blocks: Sequence[Block]) -> Table:
    """Return what the rows know of their own errors: NEES per degree of freedom and the share inside 3 sigma.

    Rows without sigmas are left out; there may be none at all.
    """
    names = _name_columns(blocks)
    columns = [Column(header) for header in names]
    columns += [Column(text, "Pose") for text in ("NEES/dof", "bounds")]
    columns += [Column(axis, "Inside 3σ", "%") for axis in (*POSITION_KEYS[:3], *ATTITUDE_KEYS[:3])]
    rows: list[tuple[str, ...]] = []
    rules = set()
    for block in blocks:
        rules.add(len(rows))
        for name, row in block.summary.items():
            if row["nees"] or row.get("inside_3_sigma"):
                rows.append((*_names(block, name, row, names), *_consistency_cells(row)))
    title = "Consistency: NEES per degree of freedom and share inside 3σ"
    note = "The bounds are for errors that are independent from frame to frame; those of a filter are not."
    return Table(title, tuple(columns), tuple(rows), rules=frozenset(rules - {0, len(rows)}), notes=(note,))


def comparison_tables(comparison: Comparison) -> list[Table]:
    """Return the tables of `poet-loc evaluate`: errors per axis, then APE and RPE."""
    options, row = comparison.options, comparison.evaluation.rows[0]
    aligned = f"Alignment: {options.align}"
    if options.align == "sim3":
        aligned += f", scale {comparison.alignment.scale:.6g}"
    matched = f"{len(row.stamps_ns)} of {row.frames_in_span} reference poses in the common span have an estimate."
    statistics = [Column(statistic, "Statistics") for statistic in _STATISTICS]
    per_axis = Table(
        "Absolute errors per axis",
        (Column("error"), Column("unit"), *statistics),
        tuple(_rows_per_axis(to_summary(comparison.evaluation)[row.name])),
        notes=(f"{matched} {aligned}.",),
    )
    pairs = "from every pose" if options.rpe_all_pairs else "one after the other"
    rpe = f"RPE over {options.rpe_delta:g} {options.rpe_unit}: {comparison.rpe_pairs} pairs, {pairs}."
    poses = Table(
        "Pose errors",
        (Column("metric"), Column("relation"), Column("unit"), *statistics),
        (*_rows_per_relation("APE", comparison.ape), *_rows_per_relation("RPE", comparison.rpe)),
        rules=frozenset([len(comparison.ape)]),
        notes=(f"{aligned}. {rpe}",),
    )
    return [per_axis, poses]


def table_text(blocks: Sequence[Block], form: TableFormat) -> str:
    """Return the error and consistency tables as markdown or LaTeX, or every number as csv or json."""
    if form == "csv":
        return _csv(records(blocks))
    if form == "json":
        return json.dumps(records(blocks), indent=1, allow_nan=False) + "\n"
    tables = [table for table in (error_table(blocks), consistency_table(blocks)) if table.rows]
    return "\n".join(table.markdown() if form == "md" else table.latex() for table in tables)


def records(blocks: Iterable[Block]) -> list[dict[str, Any]]:
    """Return one flat record a row: names, frames, coverage and every statistic; `common_` for the common frames."""
    return [
        {"log": block.log, "detections": block.detections, "name": name, "oracle": row.get("oracle", False)}
        | {"frames": row["frames"], "coverage": row["coverage"], "common_frames": row["on_common_frames"]["frames"]}
        | _flat(row["on_common_frames"], "common_")
        | _flat(row, "")
        | {"nees_pose": row["nees"]["pose"] if row["nees"] else None, "runtime_s": row["runtime_s"]}
        | {f"inside_3_sigma_{axis}": share for axis, share in (row.get("inside_3_sigma") or {}).items()}
        for block in blocks
        for name, row in block.summary.items()
    ]


def _flat(summary: ErrorSummary | RowSummary, prefix: str) -> dict[str, float | None]:
    return {
        f"{prefix}{axis}_{statistic}_{unit}": value
        for values, unit in ((summary["position_error_mm"], "mm"), (summary["attitude_error_deg"], "deg"))
        for axis, statistics in values.items()
        for statistic, value in statistics.items()
    }


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, dict.fromkeys(key for row in rows for key in row), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _name_columns(blocks: Sequence[Block]) -> list[str]:
    shown = [header for header in ("log", "detections") if any(getattr(block, header) for block in blocks)]
    return [*shown, "estimate"]


def _names(block: Block, name: str, row: RowSummary, columns: Sequence[str]) -> list[str]:
    label = f"{name} (oracle)" if row.get("oracle") else name
    return [label if column == "estimate" else getattr(block, column) for column in columns]


def _error_cells(row: RowSummary) -> Iterator[str]:
    common = row["on_common_frames"]
    yield from _group_cells(common["position_error_mm"], POSITION_KEYS, "mm")
    yield from _group_cells(common["attitude_error_deg"], ATTITUDE_KEYS, "deg")
    yield _text(row["position_error_mm"]["norm"]["rmse"], "mm")
    yield _text(row["attitude_error_deg"]["angle"]["rmse"], "deg")
    yield f"{100 * row['coverage']:.1f}"


def _group_cells(values: Mapping[str, Mapping[str, float | None]], keys: Sequence[str], unit: str) -> Iterator[str]:
    *axes, total = keys
    for axis in axes:
        mean, std = (_text(values[axis][statistic], unit) for statistic in ("mean", "std"))
        yield mean if values[axis]["mean"] is None else f"{mean} ± {std}"
    for statistic in ("median", "p95", "rmse"):
        yield _text(values[total][statistic], unit)


def _consistency_cells(row: RowSummary) -> Iterator[str]:
    if row["nees"]:
        low, high = row["nees"]["bounds"]
        yield from (_text(row["nees"]["pose"], ""), f"{low:.2f}–{high:.2f}")
    else:
        yield from ("–", "–")
    inside = row.get("inside_3_sigma") or {}
    for axis in (*POSITION_KEYS[:3], *ATTITUDE_KEYS[:3]):
        yield f"{100 * inside[axis]:.1f}" if axis in inside else "–"


def _lowest_rmse(summary: Summary) -> Iterator[tuple[int, int]]:
    """(row, column after the names) of the lowest RMSE on the common frames in position and attitude."""
    rivals = {i: row["on_common_frames"] for i, row in enumerate(summary.values()) if not row.get("oracle")}
    position = {i: errors["position_error_mm"]["norm"]["rmse"] for i, errors in rivals.items()}
    attitude = {i: errors["attitude_error_deg"]["angle"]["rmse"] for i, errors in rivals.items()}
    for values, column in ((position, 5), (attitude, 11)):
        known = {i: value for i, value in values.items() if value is not None}
        if len(known) > 1:
            yield min(known, key=lambda i: known[i]), column


def _notes(blocks: Sequence[Block]) -> Iterator[str]:
    yield (
        "Mean ± std of the absolute error per axis; median, p95 and RMSE of the norm and of the angle. "
        "Position in world axes, attitude as z-y-x angles of R_ref^T R_est, no alignment."
    )
    rows = [row for block in blocks for row in block.summary.values()]
    frames = _span(max(row["on_common_frames"]["frames"] for row in block.summary.values()) for block in blocks)
    yield f"Common frames, which every row of a block covers: {frames}. Own frames: all that a row covers."
    if files := dict.fromkeys(row["compared_at"] for row in rows if "compared_at" in row):
        span = _span(row["frames_in_span"] for row in rows if "compared_at" in row)
        stamps = f"{span} stamps, those of {' or '.join(files)}"
        yield f"Compared with ground truth at {stamps}; errors elsewhere do not count."
    if any(row.get("oracle") for row in rows):
        yield "An oracle chooses by the ground truth: it is no competitor."


def _span(counts: Iterable[int]) -> str:
    counts = list(counts)
    return " to ".join(str(count) for count in dict.fromkeys([min(counts), max(counts)]))


def _rows_per_axis(summary: ErrorSummary) -> Iterator[tuple[str, ...]]:
    for values, unit in ((summary["position_error_mm"], "mm"), (summary["attitude_error_deg"], "deg")):
        for axis, statistics in values.items():
            yield axis, unit, *[_text(statistics[statistic], unit) for statistic in _STATISTICS]


def _rows_per_relation(metric: str, errors: Mapping[Relation, Statistics]) -> Iterator[tuple[str, ...]]:
    for relation, statistics in errors.items():
        cells = [f"{value:.6f}" if np.isfinite(value) else "–" for value in asdict(statistics).values()]
        yield metric, relation.replace("_", " "), _UNITS[relation], *cells


def _text(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    digits = 1 if unit == "mm" else 2
    return f"{value:.{digits}f}" if abs(value) < 999.5 else f"{value:.0f}"
