"""poet-loc detect: images become object poses."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat
from poet_loc.core.input_error import InputError
from poet_loc.detect.options import DetectOptions


@dataclass(frozen=True)
class Arguments:
    """Estimate the poses of all objects in images, a video or a log."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES|VIDEO|LOG")]
    """Folder of images, one image, a video, or a log with frames.csv."""
    out: Path | None = None
    """Folder to write: object_poses.csv, boxes.csv, bop_results.csv, results.json, summary.json, overlays/.  Without
    it a log gets its own object_poses.csv and boxes.csv, and every other command can read it."""
    name: str = ""
    """Without --out: the log gets object_poses_NAME.csv instead."""
    overwrite: bool = False
    """Replace what is there."""
    options: Flat[DetectOptions] = field(default_factory=DetectOptions)


def execute(arguments: Arguments) -> None:
    """Detect and say what came out."""
    from poet_loc.detect.stage import detect, detect_in_log
    from poet_loc.io.object_poses_csv import read_object_poses

    if arguments.out is None:
        if arguments.options.overlays:
            raise InputError("overlays need a folder of their own", fix="give --out FOLDER")
        path = detect_in_log(arguments.source, arguments.name, arguments.options, arguments.overwrite, progress=True)
        print(f"{path}: {len(read_object_poses(path))} object poses")
        return
    if arguments.name:
        raise InputError("--name is for a log's own detections", fix="leave out --name or --out")
    out = detect(arguments.source, arguments.out, arguments.options, arguments.overwrite, progress=True)
    summary = json.loads((out / "summary.json").read_text())
    skipped = f", {len(summary['skipped'])} images skipped" if summary["skipped"] else ""
    print(f"{out}: {summary['detections']} object poses in {summary['images']} images{skipped}")
