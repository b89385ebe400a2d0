"""The stage behind `poet-loc detect`: images in, object poses out."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections import Counter, deque
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
    tally = _Tally(_objects_of_map(Path(source), options))
    with whole_folder(out, overwrite, inputs=[source]) as folder:
        files = PoseFiles(folder, options.scene)
        for found in _with_bar(_sightings(images, estimator, options.batch, tally.skipped), images, progress):
            kept = tally.kept(found)
            files.append(kept)
            if options.overlays:
                _draw(kept, estimator, options, folder / "overlays")
        if tally.images == 0:
            raise InputError("no image could be read", path=source)
        files.finish()
        (folder / "summary.json").write_text(json.dumps(tally.summary(), indent=1) + "\n")
    tally.warn_of_unknown()
    return Path(out)


class _Tally:
    """What was found, what was left out, and how long it took."""

    def __init__(self, known: NDArray[np.int64] | None) -> None:
        """known: the map's objects, others are left out; None: all are kept."""
        self.known, self.unknown = known, Counter[int]()
        self.images, self.detections = 0, 0
        self.skipped: list[str] = []
        self.seconds: deque[float] = deque(maxlen=1000)

    def kept(self, found: list[Sighting]) -> list[Sighting]:
        """Count a group of pictures and return it without unknown objects."""
        if self.known is not None:
            for sighting in found:
                self.unknown.update(sighting.object_ids[~np.isin(sighting.object_ids, self.known)].tolist())
            found = [sighting.of_objects(self.known) for sighting in found]
        self.images += len(found)
        self.detections += sum(len(sighting.labels) for sighting in found)
        self.seconds.append(found[0].seconds)
        return found

    def summary(self) -> dict[str, object]:
        """Return what summary.json holds."""
        return {
            "images": self.images,
            "detections": self.detections,
            "skipped": self.skipped,
            "median_seconds_per_image": float(np.median(self.seconds)),
            "not_on_the_map": {str(number): self.unknown[number] for number in sorted(self.unknown)},
        }

    def warn_of_unknown(self) -> None:
        """Warn, once, of objects that were left out."""
        if not self.unknown:
            return
        which = ", ".join(f"{number} ({self.unknown[number]})" for number in sorted(self.unknown))
        what = f"left out {self.unknown.total()} detections of objects that landmarks.json does not have: {which}"
        warnings.warn(what, stacklevel=3)


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
