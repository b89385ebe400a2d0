"""One look for all figures: colours that colour-blind readers tell apart, 8 pt, the width of two paper columns."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.report.evaluate import Estimate, Row

P = ParamSpec("P")
R = TypeVar("R")

WIDTH = 7.16
"""Inches, two columns of an IEEE paper."""
BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
TRUTH, FAINT = "#000000", "#999999"
"""Okabe and Ito's palette (2008)."""

_STYLE = {
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.labelsize": 8.0,
    "legend.fontsize": 7.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "axes.grid": True,
    "grid.color": "#E5E5E5",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 0.9,
    "legend.frameon": False,
    "legend.markerscale": 4.0,  # dots are drawn small, for there are many
    "figure.dpi": 160,
    "savefig.dpi": 160,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Return the function with the project's style around it and the caller's own settings untouched."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
            return draw(*args, **kwargs)

    return wrapper


def new_figure(rows: int, columns: int, height: float, sharex: bool | str = True) -> tuple[Figure, NDArray[Any]]:
    """Return an empty figure, without pyplot's global state, and its axes (rows, columns)."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, sharex=sharex, squeeze=False)  # type: ignore[arg-type]


@styled
def save_figures(figures: Mapping[str, Figure], folder: Path, suffix: str = "png") -> list[Path]:
    """Write each figure to folder/<name>.<suffix> (png, pdf, svg); return the paths.  The folder is made."""
    if suffix not in ("png", "pdf", "svg"):
        raise InputError(f"figures cannot be written as {suffix!r}", fix="choose png, pdf or svg")
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.{suffix}")
        figure.savefig(paths[-1])
    return paths


def line_styles(items: Sequence[Estimate | Row]) -> dict[str, dict[str, Any]]:
    """Return colour and dashes by name: oracles grey and dashed, the others in the palette's order."""
    palette = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
    looks = (
        {"color": colour, "linestyle": dashes} for dashes in itertools.cycle(("-", ":", "-.")) for colour in palette
    )
    return {item.name: {"color": FAINT, "linestyle": "--"} if item.oracle else next(looks) for item in items}


def label(item: Estimate | Row) -> str:
    """Return a row's name, an oracle's with the word."""
    return f"{item.name} (oracle)" if item.oracle else item.name


def broken(seconds: NDArray[Any], *columns: NDArray[Any]) -> list[NDArray[np.float64]]:
    """Return a time axis and its columns with a NaN in each gap, so that no line bridges it."""
    if len(seconds) < 3:
        return [seconds, *columns]
    steps = np.diff(seconds)
    gaps = np.flatnonzero(steps > 3.0 * np.median(steps)) + 1
    return [np.insert(seconds, gaps, np.nan), *[np.insert(column, gaps, np.nan, axis=0) for column in columns]]


def logarithmic(axis: Axis) -> None:
    """Make an axis logarithmic, with as many plain numbers beside it as have room."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})  # type: ignore[attr-defined]
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    room = 5 if axis.axis_name == "y" else 8  # type: ignore[attr-defined]
    subs = next((each for each in ((1, 2, 3, 5, 7), (1, 2, 5), (1, 3)) if len(each) * decades < room), (1,))
    axis.set_major_locator(LogLocator(subs=subs, numticks=room))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_below(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """Put the legend of one of the axes under the whole figure."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(columns, len(handles)))
