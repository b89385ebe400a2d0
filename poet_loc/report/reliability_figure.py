"""How often errors lie inside the ellipsoids that a network draws around its poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from poet_loc.report.figure_style import BLUE, FAINT, VERMILLION, WIDTH, styled


@styled
def reliability_figure(
    levels: Sequence[float], before: Mapping[str, Sequence[float]], after: Mapping[str, Sequence[float]]
) -> Figure:
    """Draw, per quantity, the share of errors inside over the probability of the ellipsoid, before and after scaling.

    On the diagonal the covariances are honest, below it they are too small.
    """
    figure = Figure(figsize=(WIDTH / 3 * len(before), WIDTH / 3 + 0.5), layout="constrained")
    axes = figure.subplots(1, len(before), sharey=True, squeeze=False)[0]
    for axis, name in zip(axes, before, strict=True):
        axis.plot([0, 1], [0, 1], color=FAINT, label="honest")
        axis.plot(levels, before[name], color=VERMILLION, marker="o", markersize=2.5, label="before")
        axis.plot(levels, after[name], color=BLUE, marker="s", markersize=2.5, label="after")
        axis.set(xlabel="probability of the ellipsoid", title=name, xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes[0].set_ylabel("share of errors inside")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, markerscale=1.5)
    return figure
