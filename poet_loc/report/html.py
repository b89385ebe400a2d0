"""Tables and figures as HTML that needs nothing from outside."""

from __future__ import annotations

import base64
from html import escape
from io import BytesIO
from itertools import groupby
from typing import TYPE_CHECKING

from poet_loc.report.tables import Column, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TABLE_STYLE = """
.poet-loc table {border-collapse: collapse; font-size: 0.8em; font-variant-numeric: tabular-nums; margin: 0.4em 0}
.poet-loc th, .poet-loc td {padding: 0.2em 0.45em; text-align: right; border: 0}
.poet-loc td, .poet-loc th.name {white-space: nowrap}
.poet-loc th.name, .poet-loc td.name {text-align: left}
.poet-loc thead tr:last-child th {border-bottom: 1px solid}
.poet-loc tr.rule td {border-top: 1px solid}
.poet-loc .group {text-align: center; border-bottom: 1px solid}
.poet-loc caption {text-align: left; font-weight: bold}
.poet-loc p.note {font-size: 0.8em; opacity: 0.75; margin: 0.2em 0}
.poet-loc img {max-width: 100%}
"""


def table_html(table: Table) -> str:
    """Return a table element, its notes as paragraphs under it."""
    units = ["" if table.shared_unit(c.group) else c.unit for c in table.columns]
    headers = [
        _cell("th", f"{c.header} [{u}]" if u else c.header, c) for c, u in zip(table.columns, units, strict=True)
    ]
    rows = []
    for i, row in enumerate(table.rows):
        cells = [
            _cell("td", text, column, bold=(i, j) in table.bold)
            for j, (text, column) in enumerate(zip(row, table.columns, strict=True))
        ]
        rows.append(f'<tr class="rule">{"".join(cells)}</tr>' if i in table.rules else f"<tr>{''.join(cells)}</tr>")
    parts = [
        f"<table><caption>{escape(table.title)}</caption><thead>",
        _group_row(table),
        f"<tr>{''.join(headers)}</tr></thead><tbody>",
        *rows,
        "</tbody></table>",
        *(f'<p class="note">{escape(note)}</p>' for note in table.notes),
    ]
    return "\n".join(part for part in parts if part)


def figure_html(figure: Figure, description: str, dpi: int = 120) -> str:
    """Return an img element with the figure in it as a PNG."""
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=dpi)
    data = base64.b64encode(picture.getvalue()).decode("ascii")
    return f'<img alt="{escape(description)}" src="data:image/png;base64,{data}">'


def fragment(*parts: str) -> str:
    """Return a piece of a page with the style that it needs."""
    return "\n".join(
        ['<div class="poet-loc" style="overflow-x: auto">', f"<style>{TABLE_STYLE}</style>", *parts, "</div>"]
    )


def _cell(tag: str, text: str, column: Column, bold: bool = False) -> str:
    kind = "" if column.group else ' class="name"'
    text = f"<b>{escape(text)}</b>" if bold else escape(text)
    return f"<{tag}{kind}>{text}</{tag}>"


def _group_row(table: Table) -> str:
    if not any(column.group for column in table.columns):
        return ""
    cells = []
    for group, members in groupby(table.columns, lambda column: column.group):
        kind, unit = ' class="group"' if group else "", table.shared_unit(group)
        text = f"{group} [{unit}]" if group and unit else group
        cells.append(f'<th colspan="{len(list(members))}"{kind}>{escape(text)}</th>')
    return f"<tr>{''.join(cells)}</tr>"
