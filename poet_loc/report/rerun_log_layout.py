"""Where the views of a rerun recording stand, and the units of its curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from poet_loc.report.evaluate import ERROR_AXES, Row
from poet_loc.report.rerun_log_images import image_view
from poet_loc.report.rerun_log_time import TIMELINE
from poet_loc.report.run_record import RunRecord

Array = NDArray[np.float64]

UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
"""Of each of `ERROR_AXES`."""


def layout_of(record: RunRecord) -> rrb.Blueprint:
    """Return where a recording's views stand: the world, errors, states, consistency, and what was used."""
    names = sorted((estimate.name for estimate in record.estimates), key=rank)
    hidden = [name for name in names[1:] if name.startswith("localize/") and name != "localize/robust"]
    world = rrb.Spatial3DView(
        origin="world",
        name="world",
        overrides={f"world/estimates/{name}": rrb.EntityBehavior(visible=False) for name in hidden},
        line_grid=rrb.LineGrid3D(spacing=0.1),
        eye_controls=_eye(record),
    )
    rows = sorted(record.evaluation.rows if record.evaluation else (), key=lambda row: rank(row.name))
    tabs: list[Any] = []
    if rows:
        tabs.append(_error_views(rows, ERROR_AXES[:3], "position error"))
        tabs.append(_error_views(rows, ERROR_AXES[3:], "attitude error"))
    for fused in sorted(record.fused, key=lambda fused: rank(fused.name)):
        states = ("gyroscope_bias", "accelerometer_bias", "velocity")
        views = [rrb.TimeSeriesView(origin=f"states/{fused.name}/{state}", name=state) for state in states]
        tabs.append(rrb.Vertical(*views, name=f"states of {fused.name}"))
    consistent = {row.name for row in rows if row.nees is not None and row.name not in hidden}
    consistent |= {fused.name for fused in record.fused if fused.gate is not None}
    views = [
        rrb.TimeSeriesView(origin=f"consistency/{name}", name=name, axis_y=rrb.ScalarAxis(range=(0.0, 8.0)))
        for name in names
        if name in consistent
    ]
    tabs += [rrb.Vertical(*views, name="consistency")] if views else []
    lanes = [
        rrb.StateTimelineView(origin=f"decisions/{name}", name=f"used by {name}")
        for name in sorted(record.decisions, key=rank)
    ]
    column = [rrb.Tabs(*part) for part in (tabs, lanes) if part]
    shares = [2, 1][: len(column)]
    space: Any = world
    if record.images is not None:
        space = rrb.Vertical(world, image_view(), row_shares=[3, 2])
    layout = rrb.Horizontal(space, rrb.Vertical(*column, row_shares=shares), column_shares=[3, 2]) if column else space
    return rrb.Blueprint(layout, rrb.TimePanel(timeline=TIMELINE, expanded=False), collapse_panels=True)


def rank(name: str) -> tuple[bool, bool, bool]:
    """Estimates in the order of interest: fused before localised, tightly coupled and robust ones first."""
    return name.startswith("localize/"), not name.endswith(("/objects", "/robust")), name == "localize/best"


def _eye(record: RunRecord) -> rrb.EyeControls3D | None:
    """Look down on landmarks and paths from aside."""
    paths = [*record.references.values()] or [estimate.trajectory for estimate in record.estimates]
    points = [np.asarray(path.T_world_body.translation) for path in paths if len(path)]
    points += [landmark.T_world_obj.translation[None] for landmark in record.landmark_map or ()]
    if not points:
        return None
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    centre, extent = (low + high) / 2, float(np.linalg.norm(high - low)) + 0.2
    position = centre + extent * np.array([-0.45, -0.6, 0.5])
    return rrb.EyeControls3D(position=position, look_target=centre, eye_up=(0.0, 0.0, 1.0))


def _error_views(rows: Sequence[Row], axes: Sequence[str], name: str) -> rrb.Vertical:
    """The first row with its band and the robust localisation as a line; the others are a click away."""
    first, others = rows[0], [row.name for row in rows[1:]]
    views = []
    for axis in axes:
        hidden = [f"{other}/3_sigma" if other == "localize/robust" else other for other in others]
        k = ERROR_AXES.index(axis)
        usual = [np.percentile(np.abs(first.errors[:, k]), 99)] if len(first.errors) else [1e-3]
        if first.sigmas is not None and np.isfinite(first.sigmas[:, k]).any():
            usual.append(3.0 * np.nanmedian(first.sigmas[:, k]))
        limit = 1.5 * float(in_unit(np.max(usual), UNITS[k]))
        view = rrb.TimeSeriesView(
            origin=f"errors/{axis}",
            name=f"{axis} and ±3σ of {first.name}",
            axis_y=rrb.ScalarAxis(range=(-limit, limit)),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=axis == axes[0]),
            overrides={f"errors/{axis}/{entity}": rrb.EntityBehavior(visible=False) for entity in hidden},
        )
        views.append(view)
    return rrb.Vertical(*views, name=name)


def in_unit(values: Any, unit: str) -> Array:
    """Return metres or radians in mm or deg."""
    return np.asarray(values * 1e3 if unit == "mm" else np.degrees(values))
