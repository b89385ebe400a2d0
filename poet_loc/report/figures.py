"""Figures of a run: errors with their sigmas, trajectories, the view from above, consistency, who saw what when."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from poet_loc.core.consistency import chi_square_quantile
from poet_loc.core.errors import statistics
from poet_loc.core.geometry import yaw_pitch_roll
from poet_loc.core.trajectory import Trajectory
from poet_loc.report.evaluate import ERROR_AXES, Body, Estimate, Evaluation, Row
from poet_loc.report.figure_style import (
    BLUE,
    FAINT,
    ORANGE,
    PURPLE,
    SKY,
    TRUTH,
    VERMILLION,
    broken,
    label,
    legend_below,
    line_styles,
    logarithmic,
    new_figure,
    save_figures,
    styled,
)
from poet_loc.report.fused import Gates
from poet_loc.report.run_record import DECISIONS, Decisions, RunRecord

Array = NDArray[np.float64]

_MM, _DEG = 1e3, 180.0 / np.pi
_PANELS = ((0, 0, "x"), (1, 0, "y"), (2, 0, "z"), (0, 1, "yaw"), (1, 1, "roll"), (2, 1, "pitch"))
_DECISION_COLOURS = (VERMILLION, ORANGE, PURPLE, BLUE)
_TRUTH_STYLE: dict[str, Any] = {"color": TRUTH, "linewidth": 1.8, "label": "ground truth", "zorder": 5}
_FUSED_STYLE: dict[str, Any] = {"linewidth": 0.8, "zorder": 8}
_TIME = "time [s]"
_LONGEST_PATH = 20_000  # points of a drawn trajectory
_MOST_DOTS = 5_000  # more are drawn as pixels even where a figure is written as vectors


def draw_run(record: RunRecord) -> dict[str, Figure]:
    """Return every figure that the record has the data for, by file name."""
    figures: dict[str, Figure] = {}
    if record.evaluation is not None:
        for row in record.evaluation.rows:
            if len(row.stamps_ns):
                figures[f"errors_{_file_name(row.name)}"] = error_figure(row, record.start_ns)
        figures["error_distribution"] = distribution_figure(record.evaluation)
        gates = {fused.name: fused.gate for fused in record.fused}
        for row in record.evaluation.rows:
            if row.nees is not None and np.isfinite(row.nees).any():
                name = f"consistency_{_file_name(row.name)}"
                figures[name] = consistency_figure(row, gates.get(row.name), record.start_ns)
    for body in _bodies(record):
        figures[f"trajectory_{body}"] = trajectory_figure(record, body)
    if record.estimates:
        figures["top_view"] = top_view_figure(record)
    for name, decisions in record.decisions.items():
        if len(decisions.stamps_ns):
            figures[f"landmarks_{_file_name(name)}"] = landmark_figure(record, decisions, name)
    return figures


def write_figures(record: RunRecord, folder: Path, paper: bool = False) -> list[Path]:
    """Draw the run and write its figures as PNG, for a paper as vector PDF beside them; return the PNGs."""
    figures = draw_run(record)
    if paper:
        save_figures(figures, folder, "pdf")
    return save_figures(figures, folder)


@styled
def error_figure(row: Row, start_ns: int = 0) -> Figure:
    """Return the error of each axis over time with its ±3 sigma, mm and deg."""
    figure, axes = new_figure(3, 2, 4.2)
    seconds = (row.stamps_ns - start_ns) * 1e-9
    for i, j, axis in _PANELS:
        panel, k, (scale, unit) = axes[i, j], ERROR_AXES.index(axis), (_DEG, "deg") if j else (_MM, "mm")
        error = row.errors[:, k] * scale
        sigma = np.full(len(error), np.nan) if row.sigmas is None else row.sigmas[:, k] * scale
        at, error_line, bound = broken(seconds, error, 3.0 * sigma)
        if np.isfinite(sigma).any():
            panel.fill_between(at, -bound, bound, color=SKY, alpha=0.35, linewidth=0, label="±3σ")
        style = _dots(len(error)) if row.name.startswith("localize/") else {"linewidth": 0.8}
        panel.plot(at, error_line, color=BLUE, label="error", **style)
        panel.axhline(0.0, color=TRUTH, linewidth=0.5)
        panel.set_ylabel(f"{axis} [{unit}]")
        beyond = _robust_limits(panel, error, 3.0 * sigma, unit)
        panel.set_title(_error_note(error, sigma, unit) + beyond, loc="right", fontsize=6.5)
    for panel in axes[-1]:
        panel.set_xlabel(_TIME)
    title = f"{label(row)}: errors of the {_BODY_NAMES[row.body]}, coverage {100 * row.coverage:.1f} %"
    axes_text = "position in world axes, attitude as z-y-x angles of $R_{ref}^T R_{est}$"
    figure.suptitle(f"{title}\n{axes_text}", fontsize=8.5)
    legend_below(figure, axes[0, 0])
    return figure


@styled
def distribution_figure(evaluation: Evaluation) -> Figure:
    """Return the share of common frames below an error, for every row, in position and attitude."""
    figure, axes = new_figure(1, 2, 2.8, sharex=False)
    styles = line_styles(evaluation.rows)
    for row in evaluation.rows:
        common = row.common()
        for panel, values in zip(axes[0], _totals(common), strict=True):
            if len(values):
                share = np.arange(1, len(values) + 1) / len(values)
                panel.plot(np.sort(values), share, label=label(row), **styles[row.name])
    for k, (panel, text) in enumerate(zip(axes[0], ("position error [mm]", "attitude error [deg]"), strict=True)):
        values = np.concatenate([_totals(row.common())[k] for row in evaluation.rows])
        if np.any(values > 0):
            panel.set_xlim(np.percentile(values[values > 0], 0.5) / 1.2, values.max() * 1.2)
        logarithmic(panel.xaxis)
        panel.set_xlabel(text)
        panel.set_ylim(0.0, 1.005)
    axes[0, 0].set_ylabel("share of the common frames")
    frames = max((int(row.on_common.sum()) for row in evaluation.rows), default=0)
    figure.suptitle(f"How often the error stays below: {frames} common frames", fontsize=9)
    legend_below(figure, axes[0, 0])
    return figure


@styled
def trajectory_figure(record: RunRecord, body: Body) -> Figure:
    """Return estimates of a body against its ground truth, axis by axis."""
    figure, axes = new_figure(3, 2, 4.6)
    truth = record.references.get(body)
    if truth is not None:
        _draw_axes(axes, truth, record.start_ns, _TRUTH_STYLE)
    styles = line_styles(record.estimates)
    for estimate in record.estimates:
        if estimate.body == body and len(estimate.trajectory):
            _draw_axes(axes, estimate.trajectory, record.start_ns, styles[estimate.name] | _marks(estimate))
    for i, j, axis in _PANELS:
        axes[i, j].set_ylabel(f"{axis} [{'deg' if j else 'm'}]")
        if truth is not None:
            axes[i, j].set_ylim(*_range(*(line.get_ydata() for line in axes[i, j].lines), enough=5.0 if j else 0.1))
    for panel in axes[-1]:
        panel.set_xlabel(_TIME)
    figure.suptitle(f"Pose of the {_BODY_NAMES[body]} in the world", fontsize=9)
    legend_below(figure, axes[0, 0])
    return figure


@styled
def top_view_figure(record: RunRecord) -> Figure:
    """Return the paths seen from above, with landmarks, starts and ends; a panel for each body."""
    bodies = _bodies(record)
    figure, axes = new_figure(1, len(bodies), 3.9, sharex=False)
    styles = line_styles(record.estimates)
    for panel, body in zip(axes[0], bodies, strict=True):
        paths = [(e.trajectory, styles[e.name] | _marks(e)) for e in record.estimates if e.body == body]
        if body in record.references:
            paths.insert(0, (record.references[body], _TRUTH_STYLE))
        paths = [(trajectory, style) for trajectory, style in paths if len(trajectory)]
        for trajectory, style in paths:
            shown = _thinned(trajectory)
            _, x, y = broken(shown.stamps_ns * 1e-9, *shown.T_world_body.translation.T[:2])
            panel.plot(x, y, **style)
            panel.plot(x[0], y[0], "o", color=style["color"], markersize=5, markerfacecolor="white", zorder=20)
            panel.plot(x[-1], y[-1], "s", color=style["color"], markersize=4, zorder=20)
        if paths:
            _square_limits(panel, paths[0][0], record)
        _draw_landmarks(panel, record)
        panel.set_xlabel("x [m]")
        panel.set_title(f"{_BODY_NAMES[body]} (circle: start, square: end)", loc="left")
    axes[0, 0].set_ylabel("y [m]")
    figure.suptitle("From above, with the landmarks as diamonds" if record.landmark_map else "From above", fontsize=9)
    handles: dict[str, Any] = {}
    for panel in axes[0]:
        handles |= {text: handle for handle, text in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    return figure


@styled
def consistency_figure(row: Row, gate: Gates | None = None, start_ns: int = 0) -> Figure:
    """Return NEES of the pose, and NIS of position and rotation where there is a gate, with their 95 % bounds."""
    figure, axes = new_figure(1 if gate is None else 3, 1, 2.2 if gate is None else 4.6)
    nees = np.full(len(row.stamps_ns), np.nan) if row.nees is None else row.nees
    seconds, nees_line = broken((row.stamps_ns - start_ns) * 1e-9, nees)
    mean = float(np.nanmean(nees)) if np.isfinite(nees).any() else float("nan")
    axes[0, 0].plot(seconds, nees_line, color=BLUE, linewidth=0.7, label="NEES / dof")
    axes[0, 0].set_title(f"pose NEES per degree of freedom: mean {mean:.2f} (ideal 1)", loc="left")
    _draw_bounds(axes[0, 0], 6)
    if gate is not None:
        at = (gate.stamps_ns - start_ns) * 1e-9
        parts = (
            ("position", gate.nis_position, gate.position_accepted),
            ("rotation", gate.nis_rotation, gate.rotation_accepted),
        )
        for panel, (part, nis, accepted) in zip(axes[1:, 0], parts, strict=True):
            for keep, colour, text in ((accepted, BLUE, "accepted"), (~accepted, VERMILLION, "refused")):
                panel.plot(at[keep], nis[keep] / 3.0, color=colour, label=text, **_dots(len(nis)))
            asked = np.isfinite(nis)  # before the start no pose is asked
            share = 100.0 * accepted[asked].mean() if asked.any() else float("nan")
            panel.set_title(f"NIS of {part} per degree of freedom: {share:.1f} % accepted", loc="left")
            _draw_bounds(panel, 3)
    for panel in axes[:, 0]:
        panel.set_yscale("log")
        panel.set_ylabel("NEES / dof [-]" if panel is axes[0, 0] else "NIS / dof [-]")
        low, high = panel.get_ylim()
        panel.set_ylim(max(low, 1e-3), high)
        logarithmic(panel.yaxis)
    axes[-1, 0].set_xlabel(_TIME)
    figure.suptitle(f"{label(row)}: consistency, with the 95 % bounds of a single stamp", fontsize=9)
    legend_below(figure, axes[-1, 0])
    return figure


@styled
def landmark_figure(record: RunRecord, decisions: Decisions, name: str) -> Figure:
    """Return a lane for each landmark, or one for camera poses: when it was seen, and what the estimator made of it."""
    lanes = decisions.lanes()
    figure, axes = new_figure(1, 1, 0.9 + 0.26 * len(lanes))
    panel = axes[0, 0]
    used = np.unique(decisions.decisions)
    for height, (stamps_ns, decided) in enumerate(lanes.values()):
        seconds = (stamps_ns - record.start_ns) * 1e-9
        width = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.03
        for decision in used:
            starts, lengths = _runs(seconds[decided == decision], width)
            colour = _DECISION_COLOURS[decision]
            panel.broken_barh(list(zip(starts, lengths, strict=True)), (height - 0.36, 0.72), color=colour, linewidth=0)
    for decision in used[::-1]:
        share = 100.0 * np.mean(decisions.decisions == decision)
        panel.plot(
            [], [], color=_DECISION_COLOURS[decision], linewidth=5, label=f"{DECISIONS[decision]} ({share:.1f} %)"
        )
    panel.set_yticks(range(len(lanes)), [_landmark_text(record, *key) for key in lanes])
    panel.set_ylim(len(lanes) - 0.5, -0.5)
    panel.grid(axis="y", visible=False)
    panel.set_xlabel(_TIME)
    of_landmarks = any(object_id >= 0 for object_id, _ in lanes)
    title = "which landmark was seen when, and used or refused" if of_landmarks else "camera poses, used or refused"
    figure.suptitle(f"{name}: {title}", fontsize=9)
    legend_below(figure, panel)
    return figure


_LONGEST_NAME = 28
_BODY_NAMES = {"cam": "camera", "imu": "IMU"}


def _bodies(record: RunRecord) -> list[Body]:
    return [body for body in ("cam", "imu") if any(estimate.body == body for estimate in record.estimates)]


def _file_name(name: str) -> str:
    return name.replace("/", "_")


def _totals(row: Row) -> tuple[Array, Array]:
    return np.linalg.norm(row.errors[:, :3], axis=1) * _MM, row.angles * _DEG


def _error_note(error: Array, sigma: Array, unit: str) -> str:
    known = np.isfinite(sigma)
    note = f"RMSE {statistics(error).rmse:.2f} {unit}"
    return note + (f", {100 * np.mean(np.abs(error[known]) <= 3 * sigma[known]):.1f} % in 3σ" if known.any() else "")


def _robust_limits(panel: Axes, error: Array, bound: Array, unit: str) -> str:
    """Show 98 % of the errors and the usual sigma; return what to say of the rest."""
    usual_bound = np.nanpercentile(bound, 75) if np.isfinite(bound).any() else 0.0
    limit = max(1.25 * max(np.percentile(np.abs(error), 98), usual_bound), 1e-6)
    panel.set_ylim(-limit, limit)
    beyond = np.count_nonzero(np.abs(error) > limit)
    largest = np.abs(error).max()
    return f"; {beyond} off scale, up to {largest:.{0 if largest >= 10 else 1}f} {unit}" if beyond else ""


def _draw_axes(axes: NDArray[Any], trajectory: Trajectory, start_ns: int, style: dict[str, Any]) -> None:
    trajectory = _thinned(trajectory)
    T = trajectory.T_world_body
    angles = np.degrees(np.unwrap(yaw_pitch_roll(T.rotation), axis=0))
    angles -= 360.0 * np.round(np.median(angles, axis=0) / 360.0)
    columns = np.concatenate([T.translation, angles[:, [0, 2, 1]]], axis=1)
    seconds, columns = broken((trajectory.stamps_ns - start_ns) * 1e-9, columns)
    for (i, j, _), column in zip(_PANELS, columns.T, strict=True):
        axes[i, j].plot(seconds, column, **style)


def _thinned(trajectory: Trajectory) -> Trajectory:
    step = 1 + len(trajectory) // _LONGEST_PATH
    return trajectory[::step] if step > 1 else trajectory


def _dots(count: int) -> dict[str, Any]:
    return {"linestyle": "none", "marker": ".", "markersize": 1.5, "rasterized": count > _MOST_DOTS}


def _marks(estimate: Estimate) -> dict[str, Any]:
    return {"label": label(estimate)} | (
        _dots(len(estimate.trajectory)) if estimate.name.startswith("localize/") else _FUSED_STYLE
    )


def _range(truth: Any, *estimates: Any, enough: float) -> tuple[float, float]:
    """Return the range of the truth and most of each estimate, at most thrice the truth's, and a quarter more.

    So an estimate's gross errors do not shrink everything else. What hardly moves is given the range of the best, if
    that is no more than enough.
    """
    least, most = np.nanmin(truth), np.nanmax(truth)
    found = [np.nanpercentile(each, [1.0, 99.0]) for each in estimates if np.isfinite(each).any()]
    ends = np.array(found or [[least, most]])
    lows, highs = np.minimum(least, ends[:, 0]), np.maximum(most, ends[:, 1])
    low, high, span = min(least, *lows), max(most, *highs), max(most - least, min(np.min(highs - lows), enough))
    low, high = max(low, least - span), min(high, most + span)
    margin = 0.25 * span + 1e-3
    return float(low - margin), float(high + margin)


def _square_limits(panel: Axes, trajectory: Trajectory, record: RunRecord) -> None:
    points = [trajectory.T_world_body.translation[:, :2]]
    points += [landmark.T_world_obj.translation[None, :2] for landmark in record.landmark_map or ()]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    half = 0.58 * float(np.max(high - low)) + 0.05
    (x, y) = (low + high) / 2
    panel.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")


def _draw_landmarks(panel: Axes, record: RunRecord) -> None:
    for landmark in record.landmark_map or ():
        x, y = landmark.T_world_obj.translation[:2]
        panel.plot(x, y, "D", color=TRUTH, markerfacecolor="white", markersize=4, zorder=25)
        text = _landmark_text(record, *landmark.key)
        mark = panel.annotate(
            text, (x, y), xytext=(4, 3), textcoords="offset points", fontsize=6, color=TRUTH, zorder=26
        )
        mark.set_in_layout(False)  # else a name that reaches over the edge shrinks the panels


def _landmark_text(record: RunRecord, object_id: int, instance: int) -> str:
    """Return a landmark's name, shortened, and no part of it taken for a formula."""
    text = record.landmark_label(object_id, instance)
    shown = text if len(text) <= _LONGEST_NAME else f"{text[: _LONGEST_NAME - 9]}…{text[-8:]}"
    return shown.replace("$", r"\$")


def _draw_bounds(panel: Axes, degrees_of_freedom: int) -> None:
    low, high = chi_square_quantile([0.025, 0.975], degrees_of_freedom) / degrees_of_freedom
    panel.axhspan(low, high, color=FAINT, alpha=0.25, linewidth=0, label="95 % bounds")
    panel.axhline(1.0, color=TRUTH, linewidth=0.5)


def _runs(seconds: Array, width: float) -> tuple[Array, Array]:
    """Starts and lengths of bars that join stamps in a row."""
    if len(seconds) == 0:
        return seconds, seconds
    cuts = np.flatnonzero(np.diff(seconds) > 1.6 * width) + 1
    starts = seconds[np.concatenate([[0], cuts])]
    ends = seconds[np.concatenate([cuts - 1, [len(seconds) - 1]])]
    return starts, ends - starts + width
