"""poet-loc detect: images become object poses."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat
from poet_loc.detect.options import DetectOptions


@dataclass(frozen=True)
class Arguments:
    """Estimate the poses of all objects in images, a video or a log."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES|VIDEO|LOG")]
    """Folder of images, one image, a video, or a log with frames.csv."""
    out: Path
    """Folder to write: object_poses.csv, bop_results.csv, results.json, summary.json, overlays/."""
    overwrite: bool = False
    """Replace a folder that holds something."""
    options: Flat[DetectOptions] = field(default_factory=DetectOptions)


def execute(arguments: Arguments) -> None:
    """Detect and say what came out."""
    from poet_loc.detect.stage import detect

    out = detect(arguments.source, arguments.out, arguments.options, arguments.overwrite)
    summary = json.loads((out / "summary.json").read_text())
    skipped = f", {len(summary['skipped'])} images skipped" if summary["skipped"] else ""
    print(f"{out}: {summary['detections']} object poses in {summary['images']} images{skipped}")
