"""Options of `detect` that nothing reads, with the images that are looked at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from poet_loc.core import unread_options
from poet_loc.core.unread_options import Rule
from poet_loc.detect.image_source import open_images
from poet_loc.detect.options import DetectOptions


@dataclass(frozen=True)
class Reader:
    """What is looked at."""

    options: DetectOptions
    folder: bool
    listed: bool
    """frames.csv names the images and tells their stamps."""
    named: bool
    """The images' names are their stamps."""
    bop: bool
    mapped: bool
    """There is a map beside the images."""


def refuse_unread(source: Path, options: DetectOptions) -> None:
    """Raise InputError for an option that is not at its default although nothing reads it with this source.

    Raises InputError, too, where there is nothing to look at.
    """
    images = open_images(source, options.stamps, options.rate, options.keyframes)
    listed = source.is_dir() and (options.stamps is not None or (source / "frames.csv").exists())
    named = any(stamp > 1e15 for stamp in images.stamps_ns[:1].tolist())
    mapped = (source / "landmarks.json").exists()
    reader = Reader(options, source.is_dir(), listed, named, bool(images.places), mapped)
    unread_options.refuse_unread(options, DetectOptions(), [reader], RULES)


RULES: tuple[Rule[Reader], ...] = (
    Rule("rate", "images without stamps", lambda reader: not reader.listed and not reader.named),
    Rule("stamps", "a folder of images", lambda reader: reader.folder),
    Rule("keyframes true_boxes", "a BOP scene or split", lambda reader: reader.bop),
    Rule("scene", "images that are no BOP scene", lambda reader: not reader.bop),
    Rule("unknown_objects", "a log with landmarks.json", lambda reader: reader.mapped),
    Rule("score", "detections, not true boxes", lambda reader: not reader.options.true_boxes),
)
"""Who reads what."""
