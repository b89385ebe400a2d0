"""The stage behind `poet-loc detect`: images in, object poses out."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.detect.estimator import Estimator, Sighting
from poet_loc.detect.image_source import ImageSource, Picture, open_images
from poet_loc.detect.options import DetectOptions
from poet_loc.detect.outputs import PoseFiles
from poet_loc.detect.overlay import draw_overlay
from poet_loc.io.landmarks_json import read_landmarks
from poet_loc.io.log_folder import object_poses_file
from poet_loc.io.whole_folder import whole_folder


def detect(
    source: str | Path,
    out: str | Path,
    options: DetectOptions | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Path:
    """Estimate the poses of all objects in a folder of images, an image, a video, a log, or a BOP scene or split.

    Writes object_poses.csv (covariances where the network tells them), boxes.csv, bop_results.csv, results.json,
    summary.json, and overlays/.  Of a log with a map only the map's objects are kept; one warning counts the others.
    Memory does not grow with the number of images.  Raises InputError where no image can be read.
    """
    options = options or DetectOptions()
    images = open_images(source, options.stamps, options.rate, options.keyframes)
    estimator = Estimator(options, images.intrinsics, images.path)
    seconds: list[float] = []
    counts = {"images": 0, "detections": 0}
    known, unknown = _objects_of_map(Path(source), options), Counter[int]()
    with whole_folder(out, overwrite, inputs=[source]) as folder:
        files = PoseFiles(folder, options.scene)
        skipped: list[str] = []
        for sightings in _with_bar(_sightings(images, estimator, options.batch, skipped), images, progress):
            if known is not None:
                for sighting in sightings:
                    unknown.update(sighting.object_ids[~np.isin(sighting.object_ids, known)].tolist())
                sightings = [sighting.of_objects(known) for sighting in sightings]
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
        summary["not_on_the_map"] = {str(number): unknown[number] for number in sorted(unknown)}
        (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    if unknown:
        which = ", ".join(f"{number} ({unknown[number]})" for number in sorted(unknown))
        what = f"left out {unknown.total()} detections of objects that landmarks.json does not have: {which}"
        warnings.warn(what, stacklevel=2)
    return Path(out)


def detect_in_log(
    log: str | Path,
    name: str = "",
    options: DetectOptions | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Path:
    """Write a log's own object_poses.csv and boxes.csv (with a name: object_poses_NAME.csv, boxes_NAME.csv).

    Returns the former.  Raises InputError for a folder that is no log with images, and where the files are there and
    must not be overwritten.
    """
    log = Path(log)
    target = log / object_poses_file(name)
    if not (log / "frames.csv").exists():
        raise InputError("is no log with frames.csv", path=log, fix="give --out FOLDER for images that are no log")
    if target.exists() and not overwrite:
        raise InputError("exists already", path=target, fix="choose another --name or pass --overwrite")
    with tempfile.TemporaryDirectory(prefix=".detect.", dir=log) as folder:
        found = detect(log, Path(folder) / "found", options, progress=progress)
        (found / "boxes.csv").replace(log / target.name.replace("object_poses", "boxes"))
        (found / "object_poses.csv").replace(target)
    return target


def sightings(source: str | Path, options: DetectOptions | None = None) -> Iterator[Sighting]:
    """Yield what is in each picture, without writing anything."""
    options = options or DetectOptions()
    images = open_images(source, options.stamps, options.rate, options.keyframes)
    for found in _sightings(images, Estimator(options, images.intrinsics, images.path), options.batch, []):
        yield from found


def _objects_of_map(source: Path, options: DetectOptions) -> NDArray[np.int64] | None:
    landmarks = source / "landmarks.json"
    if options.unknown_objects or not landmarks.exists():
        return None
    return read_landmarks(landmarks).object_ids


def _with_bar(groups: Iterator[list[Sighting]], images: ImageSource, visible: bool) -> Iterator[list[Sighting]]:
    """Pass groups of pictures on and show how many there were."""
    from poet_loc.data.render import progress_bar

    with progress_bar("detecting", "images", len(images.files) or None, visible) as advance:
        for group in groups:
            yield group
            advance(len(group))


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
        name = "_".join(Path(sighting.picture.name).with_suffix("").parts) + ".png"
        draw_overlay(sighting, estimator.camera_of(sighting.picture), options.axis_m, folder / name)
