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
    """Folder of images, one image, a video, a log with frames.csv, or a BOP scene or split."""
    out: Path | None = None
    """Folder to write: object_poses.csv, boxes.csv, bop_results.csv, results.json, summary.json, overlays/.  Without
    it a log gets its own object_poses.csv and boxes.csv, and every other command can read it."""
    recording: bool = False
    """With --out: also recording.rrd for rerun (poet-loc view OUT): the images with boxes, axes, 3-sigma outlines of
    the positions, and, in up to sixty of them, the points that the network looked at."""
    name: str = ""
    """Without --out: the log gets object_poses_NAME.csv instead."""
    overwrite: bool = False
    """Replace what is there."""
    options: Flat[DetectOptions] = field(default_factory=DetectOptions)


def execute(arguments: Arguments) -> None:
    """Detect and say what came out."""
    from poet_loc.detect.stage import detect, detect_in_log
    from poet_loc.detect.unread_options import refuse_unread
    from poet_loc.io.object_poses_csv import read_object_poses

    refuse_unread(arguments.source, arguments.options)
    if arguments.out is None:
        if arguments.options.overlays or arguments.recording:
            raise InputError("overlays and recordings need a folder of their own", fix="give --out FOLDER")
        path = detect_in_log(arguments.source, arguments.name, arguments.options, arguments.overwrite, progress=True)
        print(f"{path}: {len(read_object_poses(path))} object poses")
        return
    if arguments.name:
        raise InputError("--name is for a log's own detections", fix="leave out --name or --out")
    if arguments.recording:
        _refuse_what_has_no_recording(arguments.source)
    out = detect(arguments.source, arguments.out, arguments.options, arguments.overwrite, progress=True)
    if arguments.recording:
        _record(arguments.source, out, arguments.options)
    summary = json.loads((out / "summary.json").read_text())
    skipped = f", {len(summary['skipped'])} images skipped" if summary["skipped"] else ""
    print(f"{out}: {summary['detections']} object poses in {summary['images']} images{skipped}")


def _refuse_what_has_no_recording(source: Path) -> None:
    from poet_loc.detect.image_source import VIDEO_SUFFIXES, open_images

    if source.suffix.lower() in VIDEO_SUFFIXES:
        raise InputError("a recording takes image files, not a video", path=source, fix="extract its frames")
    if source.exists() and len({place.scene for place in open_images(source).places}) > 1:
        raise InputError("a recording shows one scene", path=source, fix="give the folder of one scene")


def _record(source: Path, out: Path, options: DetectOptions) -> None:
    from poet_loc.core.records import Camera
    from poet_loc.detect.attention import attention_of_images
    from poet_loc.detect.image_source import open_images
    from poet_loc.io.boxes_csv import read_boxes
    from poet_loc.io.object_poses_csv import read_object_poses
    from poet_loc.report.rerun_log_images import Attention, write_image_recording
    from poet_loc.report.seen_images import SeenImages

    images = open_images(source, options.stamps, options.rate, options.keyframes)
    intrinsics = options.intrinsics or images.intrinsics
    camera = None if intrinsics is None else Camera(intrinsics)
    seen = SeenImages(images.stamps_ns, images.files, read_boxes(out / "boxes.csv"))
    looked = {stamp: Attention(*found) for stamp, found in attention_of_images(source, options).items()}
    write_image_recording(out / "recording.rrd", seen, read_object_poses(out / "object_poses.csv"), camera, looked)
