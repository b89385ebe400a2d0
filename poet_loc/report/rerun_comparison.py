"""Several recordings side by side in one: each estimate under its run's name, what is true once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk, RrdReader

from poet_loc.core.input_error import InputError
from poet_loc.report.evaluate import ERROR_AXES
from poet_loc.report.rerun_log import PALETTE
from poet_loc.report.rerun_log_images import image_view
from poet_loc.report.rerun_log_layout import rank
from poet_loc.report.rerun_log_time import TIMELINE

_OF_ESTIMATES = ("world/estimates/", "world/landmarks_found/", "states/", "consistency/", "decisions/")
_ERRORS = "errors/"


@dataclass
class _Merged:
    """What the layout needs to know of the recordings."""

    estimates: dict[str, list[str]] = field(default_factory=dict)
    """By run."""
    errors: dict[str, np.ndarray] = field(default_factory=dict)
    """By entity, as it is drawn."""
    paths: dict[str, np.ndarray] = field(default_factory=dict)
    """Points (N, 3) in world by entity."""
    entities: set[str] = field(default_factory=set)

    def leading(self, run: str) -> str | None:
        """The estimate of a run that is of most interest."""
        return min(self.estimates[run], key=rank, default=None)


def write_comparison(recordings: Mapping[str, Path], path: str | Path) -> None:
    """Write one recording from several that `write_recording` wrote, by the name of their run.

    Entities: those of the recordings with the run's name before the estimate's; landmarks, ground truth and detections
    are those of the first that has them. Raises InputError for a file that is no recording.
    """
    merged = _Merged()
    out = rr.RecordingStream("poet-loc")
    with out:
        chunks = [chunk for run, file in recordings.items() for chunk in _renamed(run, file, merged)]
        out.save(path, default_blueprint=_blueprint(merged))
        out.send_recording_name("comparison of " + ", ".join(recordings))
        out.send_chunks(chunks)
        _colour(out, merged)


def _renamed(run: str, file: Path, merged: _Merged) -> list[Chunk]:
    """A recording's chunks with the run's name in their entities."""
    shared = set(merged.entities)
    merged.estimates[run] = []
    chunks = []
    for chunk in _read(file):
        entity = chunk.entity_path.strip("/")
        place = _place(entity, run, merged)
        if entity.startswith("__") or (place == entity and entity in shared):
            continue
        merged.entities.add(place)
        if entity.startswith(_ERRORS) and not chunk.is_static and not entity.endswith("/3_sigma"):
            scalars = chunk.to_record_batch().column("Scalars:scalars").flatten()
            merged.errors[place] = np.asarray(scalars, dtype=float)
        if entity.startswith(_OF_ESTIMATES[0]) and entity.endswith("/path"):
            merged.paths[place] = _points(chunk)
        chunks.append(chunk.with_entity_path(f"/{place}"))
    return chunks


def _points(chunk: Chunk) -> np.ndarray:
    """What a path, of dots or of strips, goes through."""
    batch = chunk.to_record_batch()
    name = next(name for name in batch.schema.names if name.endswith((":positions", ":strips")))
    points = batch.column(name)
    for _ in range(3 if name.endswith(":strips") else 2):
        points = points.flatten()
    return np.asarray(points, dtype=float).reshape(-1, 3)


def _read(file: Path) -> Sequence[Chunk]:
    try:
        return RrdReader(str(file)).stream().to_chunks()
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError("is no recording", path=file, fix="poet-loc run LOG --out RUN writes one") from error


def _place(entity: str, run: str, merged: _Merged) -> str:
    if entity.startswith(_ERRORS):
        axis, _, estimate = entity.removeprefix(_ERRORS).partition("/")
        return f"{_ERRORS}{axis}/{run}/{estimate}"
    for part in _OF_ESTIMATES:
        if entity.startswith(part):
            rest = entity.removeprefix(part)
            if part == _OF_ESTIMATES[0] and rest.endswith("/path"):
                merged.estimates[run].append(rest.removesuffix("/path"))
            return f"{part}{run}/{rest}"
    return entity


def _colour(out: rr.RecordingStream, merged: _Merged) -> None:
    """Tell the runs apart: a colour for each run's leading estimate, and its name in the legends."""
    for k, (run, colour) in enumerate(zip(merged.estimates, _cycle(len(merged.estimates)), strict=True)):
        for estimate in merged.estimates[run]:
            name = f"{run}: {estimate}"
            leads: dict[str, Any] = {"colors": [colour]} if estimate == merged.leading(run) else {}
            for axis in ERROR_AXES:
                entity = f"{_ERRORS}{axis}/{run}/{estimate}"
                if entity in merged.entities:
                    out.log(entity, rr.SeriesLines.from_fields(names=[name], **leads), static=True)
                if leads and f"{entity}/3_sigma" in merged.entities:
                    sigma = rr.Measurements.from_fields(names=[f"±3σ of {run}"], **leads)
                    out.log(f"{entity}/3_sigma", sigma, static=True)
            if leads:
                path = f"{_OF_ESTIMATES[0]}{run}/{estimate}/path"
                kind: Any = rr.Points3D if estimate.startswith("localize/") else rr.LineStrips3D
                out.log(path, kind.from_fields(**leads), static=True)
                points = merged.paths[path]
                position = points[int((k + 0.5) / len(merged.estimates) * len(points))]
                label = rr.Points3D(position, labels=name, show_labels=True, **leads)
                out.log(f"{path.removesuffix('path')}name", label, static=True)
                ellipsoids = f"{path.removesuffix('path')}position_3_sigma"
                if ellipsoids in merged.entities:
                    out.log(ellipsoids, rr.Ellipsoids3D.from_fields(**leads), static=True)
                for view in ("pose/view", "pose/cam/view"):
                    entity = f"{_OF_ESTIMATES[0]}{run}/{estimate}/{view}"
                    if entity in merged.entities:
                        out.log(entity, rr.Pinhole.from_fields(color=colour), static=True)


def _cycle(count: int) -> list[tuple[int, int, int]]:
    return [PALETTE[k % len(PALETTE)] for k in range(count)]


def _blueprint(merged: _Merged) -> rrb.Blueprint:
    leading = {run: merged.leading(run) for run in merged.estimates}
    others = [(run, each) for run, found in merged.estimates.items() for each in found if each != leading[run]]
    world = rrb.Spatial3DView(
        origin="world",
        name="world",
        overrides={f"{_OF_ESTIMATES[0]}{run}/{each}": rrb.EntityBehavior(visible=False) for run, each in others},
        line_grid=rrb.LineGrid3D(spacing=0.1),
    )
    tabs: list[Any] = [
        rrb.Vertical(*[_error_view(axis, merged, leading, others) for axis in axes], name=name)
        for axes, name in ((ERROR_AXES[:3], "position error"), (ERROR_AXES[3:], "attitude error"))
    ]
    led = [f"{run}/{each}" for run, each in leading.items() if each is not None]
    nees = [f"consistency/{name}" for name in led if f"consistency/{name}/nees_per_dof" in merged.entities]
    views = [rrb.TimeSeriesView(origin=each, name=each, axis_y=rrb.ScalarAxis(range=(0.0, 8.0))) for each in nees]
    tabs += [rrb.Vertical(*views, name="consistency")] if views else []
    lanes = [rrb.StateTimelineView(origin=f"decisions/{name}", name=f"used by {name}") for name in led]
    column = rrb.Vertical(rrb.Tabs(*tabs), rrb.Tabs(*lanes), row_shares=[2, 1])
    space: Any = world
    if any(entity.startswith("camera/") for entity in merged.entities):
        space = rrb.Vertical(world, image_view(), row_shares=[3, 2])
    layout = rrb.Horizontal(space, column, column_shares=[3, 2])
    return rrb.Blueprint(layout, rrb.TimePanel(timeline=TIMELINE, expanded=False), collapse_panels=True)


def _error_view(
    axis: str, merged: _Merged, leading: Mapping[str, str | None], others: Sequence[tuple[str, str]]
) -> rrb.TimeSeriesView:
    """The leading estimate of each run; the band of the first, for several on each other tell nothing."""
    origin = f"{_ERRORS}{axis}"
    shown = [f"{origin}/{run}/{estimate}" for run, estimate in leading.items()]
    hidden = [f"{origin}/{run}/{estimate}" for run, estimate in others]
    hidden += [f"{entity}/3_sigma" for entity in shown[1:]]
    usual = [np.percentile(np.abs(merged.errors[each]), 99) for each in shown if len(merged.errors.get(each, ()))]
    limit = 1.5 * float(max(usual, default=1.0)) or 1.0
    return rrb.TimeSeriesView(
        origin=origin,
        name=f"{axis} [{'mm' if axis in ERROR_AXES[:3] else 'deg'}], ±3σ of {next(iter(leading), '')}",
        axis_y=rrb.ScalarAxis(range=(-limit, limit)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=axis in (ERROR_AXES[0], ERROR_AXES[3])),
        overrides={entity: rrb.EntityBehavior(visible=False) for entity in hidden},
    )
