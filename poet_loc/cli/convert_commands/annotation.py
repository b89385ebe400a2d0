"""poet-loc convert annotation."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.core.unread_options import Rule, refuse_unread
from poet_loc.io.convert_annotation import ConvertAnnotationOptions, convert_annotation

RULES: tuple[Rule[ConvertAnnotationOptions], ...] = (
    Rule("frame_rate", "images without --stamps", lambda options: options.stamps is None),
)
"""Who reads what."""


@dataclass(frozen=True)
class Arguments:
    """PoET's annotation.json becomes the object poses of a log."""

    annotations: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ANNOTATIONS")]
    """PoET's annotation file."""
    out: OutFolder
    options: Flat[ConvertAnnotationOptions] = field(default_factory=ConvertAnnotationOptions)


def execute(arguments: Arguments) -> None:
    """Convert and say what came out."""
    refuse_unread(arguments.options, ConvertAnnotationOptions(), [arguments.options], RULES)
    log = convert_annotation(arguments.annotations, arguments.out, arguments.options)
    print(f"{arguments.out}: {len(log.object_poses[arguments.options.name])} object poses")
