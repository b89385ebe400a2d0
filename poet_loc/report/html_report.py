"""report.html: a run on one page that needs nothing from outside, to be sent around or kept with a paper."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from poet_loc.io.whole_folder import write_whole_file
from poet_loc.report.html import TABLE_STYLE, table_html
from poet_loc.report.tables import Table

_STYLE = """
:root {color-scheme: light dark}
body {font: 16px/1.45 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem}
h1 {font-size: 1.5rem} h2 {font-size: 1.15rem; margin-top: 2.2rem}
summary {font-weight: bold; margin-top: 1.2rem; cursor: pointer}
figure {margin: 1.2rem 0} figcaption {font-size: 0.85em; opacity: 0.75}
figure img {background: white; border-radius: 4px}
.wide {overflow-x: auto}
pre {font-size: 0.8em; overflow-x: auto}
"""

_OF_ONE_ESTIMATE = {
    "errors": "error per axis over time, with what the estimate claims as its 3σ",
    "consistency": "NEES, and NIS of what was gated: inside the grey band the sigmas are true",
    "landmarks": "which landmark was seen when, and what was made of it",
}
"""Figures <kind>_<estimate>.png, in the order of the page, and what they show."""

_OF_ALL = {
    "top_view": "paths from above, with the landmarks",
    "error_distribution": "share of the common frames whose error stays below",
    "trajectory_cam": "pose of the camera, axis by axis",
    "trajectory_imu": "pose of the IMU, axis by axis",
}


def write_report(
    path: str | Path,
    title: str,
    tables: Sequence[Table],
    figures: Sequence[Path],
    options: str,
    found: Sequence[str] = (),
) -> None:
    """Write the page: tables, figures (PNG files, put into the page), and what was asked with which versions.

    found: lines about what was found beside the trajectories.
    """
    write_whole_file(path, [report_page(title, tables, figures, options, found)])


def report_page(
    title: str, tables: Sequence[Table], figures: Sequence[Path], options: str, found: Sequence[str] = ()
) -> str:
    """Return the page as text; figures of single estimates fold away, those of the fusion come first and open."""
    results = [f'<div class="wide">{table_html(table)}</div>' for table in tables]
    beside = [f"<li>{escape(line)}</li>" for line in found]
    parts = [
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>\n<style>{_STYLE}{TABLE_STYLE}</style>\n</head>",
        f'<body class="poet-loc">\n<h1>{escape(title)}</h1>',
        "<h2>Errors</h2>",
        *(results or ["<p>No ground truth: no errors.</p>"]),
        *(["<h2>Found beside the trajectories</h2>\n<ul>", *beside, "</ul>"] if beside else []),
        "<h2>Figures</h2>",
        *_figures(figures),
        f"<h2>Options and versions</h2>\n<pre>{escape(options)}</pre>",
        "</body>\n</html>\n",
    ]
    return "\n".join(parts)


def _figures(paths: Sequence[Path]) -> list[str]:
    common: list[tuple[Path, str]] = []
    single: dict[str, dict[str, Path]] = {}
    for path in paths:
        kind, _, estimate = path.stem.partition("_")
        if kind in _OF_ONE_ESTIMATE:
            single.setdefault(estimate, {})[kind] = path
        else:
            common.append((path, _OF_ALL.get(path.stem, path.stem)))
    common.sort(key=lambda each: [*_OF_ALL, each[0].stem].index(each[0].stem))
    parts = [_figure(path, text) for path, text in common]
    fused_first = sorted(single, key=lambda estimate: not estimate.startswith("fuse_"))
    for estimate in fused_first:
        opened = " open" if estimate.startswith("fuse_") or estimate == fused_first[0] else ""
        parts.append(f"<details{opened}><summary>{escape(estimate.replace('_', '/'))}</summary>")
        parts += [
            _figure(single[estimate][kind], text) for kind, text in _OF_ONE_ESTIMATE.items() if kind in single[estimate]
        ]
        parts.append("</details>")
    return parts


def _figure(path: Path, text: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    picture = f'<img alt="{escape(path.stem)}" src="data:image/png;base64,{data}">'
    return f"<figure>{picture}<figcaption>{escape(path.stem)}: {escape(text)}</figcaption></figure>"
