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
body {font: 16px/1.45 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem}
h1 {font-size: 1.5rem} h2 {font-size: 1.15rem; margin-top: 2.2rem}
figure {margin: 1.2rem 0} figcaption {font-size: 0.85em; opacity: 0.75}
figure img {background: white; border-radius: 4px}
.wide {overflow-x: auto}
pre {font-size: 0.8em; overflow-x: auto}
"""


def write_report(path: str | Path, title: str, tables: Sequence[Table], figures: Sequence[Path], options: str) -> None:
    """Write the page: tables, figures (PNG files, put into the page), and what was asked with which versions."""
    write_whole_file(path, [report_page(title, tables, figures, options)])


def report_page(title: str, tables: Sequence[Table], figures: Sequence[Path], options: str) -> str:
    """Return the page as text."""
    results = [f'<div class="wide">{table_html(table)}</div>' for table in tables]
    parts = [
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>\n<style>{_STYLE}{TABLE_STYLE}</style>\n</head>",
        f'<body class="poet-loc">\n<h1>{escape(title)}</h1>',
        "<h2>Errors</h2>",
        *(results or ["<p>No ground truth: no errors.</p>"]),
        "<h2>Figures</h2>",
        *map(_figure, figures),
        f"<h2>Options and versions</h2>\n<pre>{escape(options)}</pre>",
        "</body>\n</html>\n",
    ]
    return "\n".join(parts)


def _figure(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    name = escape(path.stem)
    picture = f'<img alt="{name}" src="data:image/png;base64,{data}">'
    return f"<figure>{picture}<figcaption>{name}</figcaption></figure>"
