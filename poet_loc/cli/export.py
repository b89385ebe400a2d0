"""poet-loc export: the pose network for another runtime."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Arguments:
    """Write a pose network as ONNX or OpenVINO and compare its poses with the network's."""

    weights: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="WEIGHTS.safetensors")]
    """Network."""
    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT.onnx|OUT.xml")]
    """File to write; detect runs it with --exported."""
    image_size: tuple[int, int] | None = None
    """(width, height) px of the images; without it that of the training images.  The graph works for no other size."""
    overwrite: bool = False
    """Replace the file."""


def execute(arguments: Arguments) -> None:
    """Export and say where to."""
    from poet_loc.model.export import ExportOptions, export

    path = export(ExportOptions(arguments.weights, arguments.target, arguments.image_size, arguments.overwrite))
    print(f"{path}: poses agree with the network's")
