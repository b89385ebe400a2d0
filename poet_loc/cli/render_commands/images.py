"""poet-loc render images."""

from __future__ import annotations

from dataclasses import dataclass

from poet_loc.cli.arguments import Flat
from poet_loc.data.render import RenderOptions, render


@dataclass(frozen=True)
class Arguments:
    """Random images of the household world as a BOP data set; a second run goes on where the first stopped."""

    options: Flat[RenderOptions]


def execute(arguments: Arguments) -> None:
    """Render and say where."""
    print(render(arguments.options))
