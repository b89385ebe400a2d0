"""Images one by one from a folder, a list, a video or a log, with their stamps."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.data.samples import read_image
from poet_loc.detect.bop_images import BopPlace, bop_files, is_bop
from poet_loc.io.calibration_yaml import read_calibration
from poet_loc.io.frames_csv import read_frames

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".webp"})
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v"})


@dataclass(frozen=True)
class Picture:
    """One image."""

    name: str
    """File name, or frame number in a video."""
    stamp_ns: int
    frame: int
    pixels: NDArray[np.uint8]
    """(h, w, 3) RGB."""
    place: BopPlace | None = None
    """Of an image of a BOP scene."""


@dataclass(frozen=True)
class ImageSource:
    """Where images come from; iterating reads one at a time and skips, with a warning, what cannot be read."""

    path: Path
    files: tuple[Path, ...]
    """Empty for a video."""
    stamps_ns: NDArray[np.int64]
    """Of the files; of a video, computed while it is read."""
    frames: NDArray[np.int64]
    rate: float
    intrinsics: tuple[float, float, float, float] | None = None
    places: tuple[BopPlace, ...] = ()
    """Of the files of BOP scenes."""

    def __iter__(self) -> Iterator[Picture]:
        if not self.files:
            yield from self._video()
            return
        several = len({place.scene for place in self.places}) > 1
        places = self.places or (None,) * len(self.files)
        for file, stamp, frame, place in zip(self.files, self.stamps_ns.tolist(), self.frames.tolist(), places):
            name = file.relative_to(file.parents[2]).as_posix() if several else file.name
            try:
                yield Picture(name, stamp, frame, read_image(file), place)
            except InputError as error:
                warnings.warn(f"skipped: {error}", stacklevel=2)

    def _video(self) -> Iterator[Picture]:
        import cv2

        video = cv2.VideoCapture(str(self.path))
        if not video.isOpened():
            raise InputError("not a readable video", path=self.path)
        rate = video.get(cv2.CAP_PROP_FPS) or self.rate
        number = 0
        while True:
            known, pixels = video.read()
            if not known:
                break
            rgb = np.ascontiguousarray(pixels[..., ::-1]).astype(np.uint8)
            yield Picture(f"{number:06d}", round(number / rate * 1e9), number, rgb)
            number += 1
        video.release()
        if number == 0:
            raise InputError("the video has no readable frame", path=self.path)


def open_images(
    path: str | Path, stamps: str | Path | None = None, rate: float = 30.0, keyframes: Path | None = None
) -> ImageSource:
    """Open a log (with frames.csv), a BOP scene or split, a folder of images, one image, or a video.

    keyframes restrict the images of a BOP split.  Stamps come from frames.csv, else from file names that are
    nanoseconds, else from the rate.  Raises InputError where there is nothing to look at.
    """
    path = Path(path)
    if path.is_dir():
        return _folder(path, stamps, rate, keyframes)
    if not path.exists():
        raise InputError("no such image, folder, video or log", path=path)
    suffix = path.suffix.lower()
    if suffix in IMAGE_SUFFIXES:
        return _files(path, [path], rate)
    if suffix in VIDEO_SUFFIXES:
        return ImageSource(path, (), np.empty(0, np.int64), np.empty(0, np.int64), rate)
    raise InputError(f"{suffix or 'a file without suffix'} is neither an image nor a video", path=path)


def _folder(path: Path, stamps: str | Path | None, rate: float, keyframes: Path | None) -> ImageSource:
    calibration = path / "calibration.yaml"
    camera = read_calibration(calibration).camera if calibration.exists() else None
    intrinsics = None if camera is None else camera.intrinsics
    table = Path(stamps) if stamps is not None else path / "frames.csv"
    if stamps is not None or table.exists():
        frames = read_frames(table)
        files = tuple(path / image for image in frames.images)
        return ImageSource(path, files, frames.stamps_ns, frames.frames, rate, intrinsics)
    if is_bop(path):
        bop, places = bop_files(path, keyframes)
        return replace(_files(path, bop, rate, places[0].intrinsics), places=tuple(places))
    if keyframes is not None:
        raise InputError("is no BOP scene or split, it has no key frames", path=path, fix="leave out --keyframes")
    found = sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=_by_number)
    if not found and (path / "rgb").is_dir():
        found = sorted((p for p in (path / "rgb").iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=_by_number)
    if not found:
        raise InputError("holds no images and no frames.csv", path=path)
    return _files(path, found, rate, intrinsics)


def _files(
    path: Path, files: list[Path], rate: float, intrinsics: tuple[float, float, float, float] | None = None
) -> ImageSource:
    nanoseconds = all(re.fullmatch(r"\d{16,19}", file.stem) for file in files)
    numbers = np.arange(len(files), dtype=np.int64)
    stamps = (
        np.array([int(file.stem) for file in files], np.int64)
        if nanoseconds
        else np.round(numbers / rate * 1e9).astype(np.int64)
    )
    return ImageSource(path, tuple(files), stamps, numbers, rate, intrinsics)


def _by_number(path: Path) -> tuple[int, str]:
    digits = "".join(re.findall(r"\d", path.stem))
    return int(digits) if digits else -1, path.name
