"""What the user sees while a command works: a progress bar on a terminal, plain lines in a pipe."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol

from poet_loc.report.tables import Table


class Report(Protocol):
    """How a stage tells what it does: `step` begins the next of the announced steps, `note` says one line."""

    def step(self, what: str) -> None:
        """Begin the next step."""

    def note(self, line: str) -> None:
        """Say a line that stays."""


class Quiet:
    """Steps are not shown, notes go to stderr as plain lines."""

    def step(self, what: str) -> None:
        """Say nothing."""

    def note(self, line: str) -> None:
        """Print the line."""
        print(line, file=sys.stderr)


class Silent(Quiet):
    """Nothing is said."""

    def note(self, line: str) -> None:
        """Say nothing."""


class _Bar:
    def __init__(self, bar, task) -> None:  # type: ignore[no-untyped-def]
        self._bar, self._task, self._begun = bar, task, False

    def step(self, what: str) -> None:
        self._bar.update(self._task, description=what, advance=1 if self._begun else 0)
        self._begun = True

    def note(self, line: str) -> None:
        self._bar.console.print(line, highlight=False, markup=False)


@contextmanager
def progress(steps: int) -> Iterator[Report]:
    """Yield a report with a bar of so many steps on stderr where that is a terminal, else a quiet one."""
    if not sys.stderr.isatty():
        yield Quiet()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<32}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=steps)
        yield _Bar(bar, task)


def print_tables(tables: Iterable[Table], rich: bool = False) -> None:
    """Print tables that fit the terminal; into a pipe as markdown, unless rich is asked for."""
    if not rich and not sys.stdout.isatty():
        print("\n".join(table.markdown() for table in tables), end="")
        return
    from rich.console import Console

    console = Console()
    for table in tables:
        console.print(table.rich(console.width))
