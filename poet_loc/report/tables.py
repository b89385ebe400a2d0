"""Tables of text: once made, printed as rich, markdown or LaTeX."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table as RichTable

_LATEX = (
    {"\\": r"\textbackslash{}", "±": r"$\pm$", "σ": r"$\sigma$", "–": "--", "≤": r"$\leq$"}
    | {c: "\\" + c for c in "&%$#_{}"}
    | {"^": r"\^{}"}
)


@dataclass(frozen=True)
class Column:
    """A column's header; columns of one group stand together under the group's name."""

    header: str
    group: str = ""
    """Empty: the column names the row."""
    unit: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of text under columns."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    bold: frozenset[tuple[int, int]] = frozenset()
    """(row, column) of the cells that stand out."""
    rules: frozenset[int] = frozenset()
    """Rows before which a line is drawn."""
    notes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Return the table in GitHub's markdown."""
        header = [" ".join(self._told_apart(c)) + (f" [{c.unit}]" if c.unit else "") for c in self.columns]
        cells = [header, *self._marked("**{}**", lambda text: text.replace("|", r"\|"))]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = ["| " + " | ".join(self._aligned(j, t, widths[j]) for j, t in enumerate(row)) + " |" for row in cells]
        rule = [("-" * w if self._names_row(j) else "-" * (w - 1) + ":") for j, w in enumerate(widths)]
        lines.insert(1, "| " + " | ".join(rule) + " |")
        parts = [f"**{self.title}**", "\n".join(lines), *self.notes]
        return "\n\n".join(part for part in parts if part) + "\n"

    def latex(self) -> str:
        """Return a `table*` for LaTeX with booktabs, notes in the caption."""
        spec = "".join("l" if self._names_row(j) else "r" for j in range(len(self.columns)))
        lines = [r"\begin{table*}", r"\centering", r"\footnotesize", rf"\begin{{tabular}}{{{spec}}}", r"\toprule"]
        lines += self._latex_group_header()
        units = ["" if self.shared_unit(c.group) else c.unit for c in self.columns]
        headers = [f"{c.header} [{u}]" if u else c.header for c, u in zip(self.columns, units, strict=True)]
        lines.append(" & ".join(map(_escaped, headers)) + r" \\")
        lines.append(r"\midrule")
        for i, cells in enumerate(self._marked(r"\textbf{{{}}}", _escaped)):
            lines += [r"\midrule"] if i in self.rules else []
            lines.append(" & ".join(cells) + r" \\")
        caption = " ".join(_escaped(text) for text in (f"{self.title}.", *self.notes))
        lines += [r"\bottomrule", r"\end{tabular}", rf"\caption{{{caption}}}", r"\end{table*}"]
        return "\n".join(lines) + "\n"

    def rich(self, width: int) -> Group:
        """Return what rich prints; a table wider than the terminal is split into one for each group of columns."""
        from rich.console import Group
        from rich.text import Text

        whole = self._width() <= width
        repeated = any(len(self._told_apart(column)) > 1 for column in self.columns)
        parts = [self._rich_table()] if whole else [p._rich_table(repeated) for p in self._split()]
        notes = [Text(note, style="dim") for note in self.notes]
        return Group(Text(self.title, style="bold"), *parts, *notes)

    def _rich_table(self, titled: bool = False) -> RichTable:
        from rich import box
        from rich.table import Table as RichTable
        from rich.text import Text

        title = self.columns[-1].group if titled else None
        table = RichTable(
            title=title,
            title_justify="left",
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            padding=(0, 1),
            collapse_padding=True,
        )
        last_name = self._names() - 1
        for j, column in enumerate(self.columns[last_name:], start=last_name):
            header = "\n".join(text for text in (*self._told_apart(column), column.unit) if text)
            table.add_column(header, justify="left" if j == last_name else "right", no_wrap=j == last_name)
        for i, row in enumerate(self.rows):
            if i in self.rules:
                table.add_section()
            if last_name and (i == 0 or i in self.rules):  # the other names stand once above their rows
                table.add_row(Text(" ".join(row[:last_name]), style="italic"))
            cells = [Text(text, style="bold" if (i, j) in self.bold else "") for j, text in enumerate(row)]
            table.add_row(*cells[last_name:])
        return table

    def _split(self) -> list[Table]:
        """One table for each group, each with the columns that name the rows."""
        groups = dict.fromkeys(column.group for column in self.columns if column.group)
        return [self._only({"", group}) for group in groups]

    def _only(self, groups: set[str]) -> Table:
        kept = [j for j, column in enumerate(self.columns) if column.group in groups]
        return replace(
            self,
            columns=tuple(self.columns[j] for j in kept),
            rows=tuple(tuple(row[j] for j in kept) for row in self.rows),
            bold=frozenset((i, kept.index(j)) for i, j in self.bold if j in kept),
        )

    def _told_apart(self, column: Column) -> list[str]:
        """Return a column's header, after its group's name where another group has the same header."""
        groups = {other.group for other in self.columns if other.header == column.header}
        return [column.group, column.header] if len(groups) > 1 else [column.header]

    def _width(self) -> int:
        headers = [max(self._told_apart(column), key=len) for column in self.columns]
        texts = [headers, [column.unit for column in self.columns], *self.rows]
        return sum(2 + max(map(len, column)) for column in list(zip(*texts, strict=True))[self._names() - 1 :])

    def _names(self) -> int:
        return sum(not column.group for column in self.columns)

    def _marked(self, bold: str, escaped: Callable[[str], str]) -> list[list[str]]:
        return [
            [bold.format(escaped(text)) if (i, j) in self.bold else escaped(text) for j, text in enumerate(row)]
            for i, row in enumerate(self.rows)
        ]

    def _names_row(self, column: int) -> bool:
        return not self.columns[column].group

    def _aligned(self, column: int, text: str, width: int) -> str:
        return text.ljust(width) if self._names_row(column) else text.rjust(width)

    def _latex_group_header(self) -> list[str]:
        if not any(column.group for column in self.columns):
            return []
        cells, rules, start = [], [], 1
        for group, members in groupby(self.columns, lambda column: column.group):
            columns = list(members)
            unit = self.shared_unit(group)
            title = _escaped(f"{group} [{unit}]" if group and unit else group)
            cells.append(rf"\multicolumn{{{len(columns)}}}{{c}}{{{title}}}")
            if group:
                rules.append(rf"\cmidrule(lr){{{start}-{start + len(columns) - 1}}}")
            start += len(columns)
        return [" & ".join(cells) + r" \\", " ".join(rules)]

    def shared_unit(self, group: str) -> str:
        """Return the unit that all columns of a group have, "" where they differ."""
        units = {column.unit for column in self.columns if column.group == group}
        return units.pop() if len(units) == 1 else ""


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
