"""poet-loc convert checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Arguments:
    """An official PoET checkpoint becomes a safetensors file; nothing in it is executed."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN.pth")]
    """Official checkpoint."""
    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT.safetensors")]
    """File to write."""
    heads: int | None = None
    """Attention heads, if the file does not say."""
    queries: int | None = None
    """Object queries, if the file does not say."""
    overwrite: bool = False
    """Replace the file."""


def execute(arguments: Arguments) -> None:
    """Convert and say what came out."""
    from poet_loc.model.official_checkpoint import ConvertCheckpoint, convert_checkpoint

    config = convert_checkpoint(ConvertCheckpoint(**vars(arguments)))
    network = config.network
    print(
        f"{arguments.target}: {network.encoder_layers} + {network.decoder_layers} layers, {network.heads} heads,"
        f" {network.queries} queries, {network.class_count} classes; sha256 {config.source['sha256']}"
    )
