"""The stage behind `poet-loc detect`: images in, object poses out."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from poet_loc.core.input_error import InputError
from poet_loc.detect.estimator import Estimator, Sighting
from poet_loc.detect.image_source import ImageSource, Picture, open_images
from poet_loc.detect.options import DetectOptions
from poet_loc.detect.outputs import PoseFiles
from poet_loc.detect.overlay import draw_overlay
from poet_loc.io.whole_folder import whole_folder


def detect(source: str | Path, out: str | Path, options: DetectOptions | None = None, overwrite: bool = False) -> Path:
    """Estimate the poses of all objects in a folder of images, an image, a video or a log.

    Writes object_poses.csv (covariances where the network tells them), bop_results.csv, results.json, summary.json,
    and overlays/.  Memory does not grow with the number of images.  Raises InputError where no image can be read.
    """
    options = options or DetectOptions()
    images = open_images(source, options.stamps, options.rate)
    estimator = Estimator(options, images.intrinsics)
    seconds: list[float] = []
    counts = {"images": 0, "detections": 0}
    with whole_folder(out, overwrite, inputs=[source]) as folder:
        files = PoseFiles(folder, options.scene)
        skipped: list[str] = []
        for sightings in _sightings(images, estimator, options.batch, skipped):
            files.append(sightings)
            counts["images"] += len(sightings)
            counts["detections"] += sum(len(s.labels) for s in sightings)
            seconds = [*seconds[-999:], sightings[0].seconds]
            if options.overlays:
                _draw(sightings, estimator, options, folder / "overlays")
        if counts["images"] == 0:
            raise InputError("no image could be read", path=source)
        files.finish()
        summary = {**counts, "skipped": skipped, "median_seconds_per_image": float(np.median(seconds))}
        (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return Path(out)


def sightings(source: str | Path, options: DetectOptions | None = None) -> Iterator[Sighting]:
    """Yield what is in each picture, without writing anything."""
    options = options or DetectOptions()
    images = open_images(source, options.stamps, options.rate)
    for found in _sightings(images, Estimator(options, images.intrinsics), options.batch, []):
        yield from found


def _sightings(images: ImageSource, estimator: Estimator, batch: int, skipped: list[str]) -> Iterator[list[Sighting]]:
    stream = _told(images, skipped)
    while pictures := list(islice(stream, batch)):
        # pictures of other sizes would be padded, and padding changes what a network sees
        sizes = {picture.pixels.shape for picture in pictures}
        groups = [pictures] if len(sizes) == 1 else [[picture] for picture in pictures]
        for group in groups:
            yield estimator(group)


def _told(images: ImageSource, skipped: list[str]) -> Iterator[Picture]:
    """Pass pictures on and note the names of those that were skipped."""
    stream = iter(images)
    while True:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            picture = next(stream, None)
        for warning in caught:
            warnings.warn(str(warning.message), stacklevel=2)
            skipped.append(str(warning.message).removeprefix("skipped: "))
        if picture is None:
            return
        yield picture


def _draw(found: list[Sighting], estimator: Estimator, options: DetectOptions, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for sighting in found:
        name = f"{Path(sighting.picture.name).stem}.png"
        draw_overlay(sighting, estimator.intrinsics, options.axis_m, folder / name)
