"""The published tables of object poses, for any number of results files side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from poet_loc.report.pose_evaluation import ClassErrors, PoseEvaluation
from poet_loc.report.tables import Column, Table

Cell = tuple[str, Callable[[ClassErrors], float], str]
"""Header, value of a class, name of the value over all classes."""


def pose_tables(evaluations: Sequence[PoseEvaluation]) -> list[Table]:
    """Return area under the curve, mean errors, share within a part of the diameter, and what was found at all."""
    return [auc_table(evaluations), error_table(evaluations), diameter_table(evaluations), detection_table(evaluations)]


def auc_table(evaluations: Sequence[PoseEvaluation]) -> Table:
    """Return the areas under the accuracy curves up to 10 cm, per class, and BOP's average recalls."""
    cells: list[Cell] = [
        ("ADD-S", lambda c: c.auc_add_s, "auc_add_s"),
        ("ADD(-S)", lambda c: c.auc_add_or_s, "auc_add_or_s"),
        ("exact", lambda c: c.auc_add_or_s_exact, "auc_add_or_s_exact"),
        ("AR MSSD", lambda c: c.recall_mssd, "recall_mssd"),
        ("AR MSPD", lambda c: c.recall_mspd, "recall_mspd"),
    ]
    if any("recall_vsd" in e.overall for e in evaluations):
        cells += [
            ("AR VSD", lambda c: c.recall_vsd, "recall_vsd"),
            ("AR", lambda c: (c.recall_mssd + c.recall_mspd + c.recall_vsd) / 3, "recall"),
        ]
    notes = (
        "AUC up to 10 cm by the published rule (a perfect estimate has 99.86); exact: ADD(-S) integrated exactly.",
        "AUC counts matched objects only; the average recalls count missed ones too.",
    )
    return _per_class("Area under the accuracy curve and average recall", "%", cells, evaluations, notes=notes)


def error_table(evaluations: Sequence[PoseEvaluation]) -> Table:
    """Return mean translation and rotation errors per class, with the parts that a symmetry tells apart."""
    cells: list[Cell] = [
        ("t [cm]", lambda c: 100 * c.translation_m, "translation_m"),
        ("R [deg]", lambda c: math.degrees(c.rotation_rad), "rotation_rad"),
        ("R reduced [deg]", lambda c: math.degrees(c.rotation_reduced_rad), "rotation_reduced_rad"),
        ("axis [deg]", lambda c: math.degrees(c.axis_tilt_rad), ""),
        ("turn [deg]", lambda c: math.degrees(c.turn_rad), ""),
    ]
    scale = {"translation_m": 100.0, "rotation_rad": 180 / math.pi, "rotation_reduced_rad": 180 / math.pi}
    notes = (
        "Means over matched objects; the last row is over all poses. R reduced: to the nearest rotation that looks the"
        " same; axis and turn: its tilt and the turn about it, of objects with a symmetry.",
    )
    return _per_class("Average translation and rotation error", "", cells, evaluations, scale, notes)


def diameter_table(evaluations: Sequence[PoseEvaluation]) -> Table:
    """Return the share of objects with ADD(-S) below 2, 5 and 10 percent of the diameter, per class."""
    cells: list[Cell] = [
        (f"{share} %", lambda c, k=k: c.within_diameter[k], f"within_{share}_percent")  # type: ignore[misc]
        for k, share in enumerate((2, 5, 10))
    ]
    return _per_class("ADD(-S) below a share of the diameter", "%", cells, evaluations)


def detection_table(evaluations: Sequence[PoseEvaluation]) -> Table:
    """Return how many objects there are, and how many were matched, missed and made up, per class."""
    cells: list[Cell] = [
        ("true", lambda c: c.true, "true"),
        ("matched", lambda c: c.matched, "matched"),
        ("missed", lambda c: c.missed, "missed"),
        ("false", lambda c: c.false, "false"),
    ]
    return _per_class("Objects found", "", cells, evaluations, digits=0)


def _per_class(
    title: str,
    unit: str,
    cells: Sequence[Cell],
    evaluations: Sequence[PoseEvaluation],
    scale: dict[str, float] | None = None,
    notes: tuple[str, ...] = (),
    digits: int = 2,
) -> Table:
    columns = [Column("object")]
    for evaluation in evaluations:
        columns += [Column(header, evaluation.name, unit) for header, _, _ in cells]
    rows = []
    for index, first in enumerate(evaluations[0].classes):
        values = [value(e.classes[index]) for e in evaluations for _, value, _ in cells]
        rows.append((first.name, *(_text(v, digits) for v in values)))
    means = [(scale or {}).get(name, 1.0) * e.overall.get(name, math.nan) for e in evaluations for _, _, name in cells]
    rows.append(("all", *(_text(v, digits) for v in means)))
    return Table(title, tuple(columns), tuple(rows), rules=frozenset({len(rows) - 1}), notes=notes)


def _text(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
