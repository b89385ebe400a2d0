"""poet-loc convert bop."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from poet_loc.cli.arguments import Flat, OutFolder
from poet_loc.core.unread_options import Rule, refuse_unread
from poet_loc.io.convert_bop import BopConversion, ConvertBopOptions, convert_bop

RULES: tuple[Rule[ConvertBopOptions], ...] = (
    Rule("frame_rate", "images without --stamps", lambda options: options.stamps is None),
    Rule("min_visible", "the ground truth, not --results", lambda options: options.results is None),
)
"""Who reads what."""


@dataclass(frozen=True)
class Arguments:
    """BOP scenes become one log each, with ground truth and the map derived from it."""

    root: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ROOT")]
    """A BOP split (a folder of scenes) or one scene."""
    out: OutFolder
    """Folder that gets one log per scene."""
    options: Flat[ConvertBopOptions] = field(default_factory=ConvertBopOptions)


def execute(arguments: Arguments) -> None:
    """Convert and say what each scene became."""
    refuse_unread(arguments.options, ConvertBopOptions(), [arguments.options], RULES)
    print(_told(convert_bop(arguments.root, arguments.out, arguments.options)))


def _told(conversion: BopConversion) -> str:
    lines = []
    if conversion.T_trajectory_annotation is not None:
        offset = conversion.T_trajectory_annotation
        t = ", ".join(f"{value * 1e3:.2f}" for value in offset.translation)
        turn = np.rad2deg(offset.rotation.magnitude())
        lines.append(f"camera offset: ({t}) mm, {turn:.2f} deg; the trajectories were moved by it")
    for scene in conversion.scenes:
        spread = max((place.distance_p90_m for place in scene.placements), default=0.0)
        dropped = f", {scene.dropped} of objects without a place dropped" if scene.dropped else ""
        lines.append(
            f"{scene.log}: {scene.frames} frames, {scene.detections} object poses{dropped}, "
            f"{len(scene.placements)} landmarks (spread up to {spread * 1e3:.2f} mm)"
        )
    return "\n".join(lines)
