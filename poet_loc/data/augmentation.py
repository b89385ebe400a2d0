"""The published augmentations: noisy boxes, colours, gray images, backgrounds for rendered objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError
from poet_loc.model.matcher import PoseTargets

JITTER_DEVIATION = 0.02
JITTER_LIMIT = 0.3
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class AugmentationOptions:
    """What happens to a training image before the network sees it."""

    jitter_probability: float = 0.5
    """Share of the boxes that are moved and scaled; box mode jitter only."""
    colour: bool = False
    """Blur, sharpness, contrast, brightness and colour, each at random."""
    grayscale: bool = False
    """Fifteen percent of the images turn gray."""
    backgrounds: Path | None = None
    """Folder of images behind rendered objects (RGBA images of type synt)."""


def truncated_normal(rng: np.random.Generator, deviation: float, limit: float) -> float:
    """Draw from a normal distribution around zero until the value lies within +-limit."""
    while True:
        value = float(rng.normal(0.0, deviation))
        if abs(value) <= limit:
            return value


def jitter_boxes(targets: PoseTargets, rng: np.random.Generator, probability: float) -> PoseTargets:
    """Return the targets with `jittered_boxes`: centres move within the box, sides change by at most 30 %."""
    boxes = targets.boxes.clone()
    for box in boxes:
        if rng.random() >= probability:
            continue
        for axis in (0, 1):
            box[axis] += truncated_normal(rng, JITTER_DEVIATION, float(box[2 + axis]) / 2)
        for axis in (2, 3):
            box[axis] *= 1.0 + truncated_normal(rng, JITTER_DEVIATION, JITTER_LIMIT)
    return replace(targets, jittered_boxes=boxes)


def augment_colours(image: Bytes, rng: np.random.Generator) -> Bytes:
    """Blur, sharpen, change contrast, brightness and colour of an RGB image, each with its published chance."""
    from PIL import Image, ImageEnhance, ImageFilter

    picture = Image.fromarray(image)
    if rng.random() < 0.3:
        picture = picture.filter(ImageFilter.GaussianBlur(int(rng.integers(1, 4))))
    steps: list[tuple[Callable[[Image.Image], ImageEnhance._Enhance], float, float]] = [
        (ImageEnhance.Sharpness, 0.0, 50.0),
        (ImageEnhance.Contrast, 0.2, 25.0),
        (ImageEnhance.Brightness, 0.1, 6.0),
        (ImageEnhance.Color, 0.0, 20.0),
    ]
    for enhance, low, high in steps:
        if rng.random() < 0.2:
            picture = enhance(picture).enhance(float(rng.uniform(low, high)))
    return np.asarray(picture)


def maybe_gray(image: Bytes, rng: np.random.Generator, probability: float = 0.15) -> Bytes:
    """Turn an RGB image gray, three equal channels, with a probability."""
    if rng.random() >= probability:
        return image
    gray = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.repeat(np.round(gray).astype(np.uint8)[..., None], 3, axis=2)


def paste_over(image: Bytes, background: Bytes, rng: np.random.Generator) -> Bytes:
    """Return an RGBA image (h, w, 4) over a background (H, W, 3) that is flipped, cropped and resized at random."""
    from PIL import Image

    picture = Image.fromarray(background)
    chance = rng.random()
    if chance < 0.5:
        flip = Image.Transpose.FLIP_LEFT_RIGHT if chance < 0.25 else Image.Transpose.FLIP_TOP_BOTTOM
        picture = picture.transpose(flip)
    if rng.random() < 0.5:
        width, height = picture.size
        crop_width, crop_height = (int(rng.integers(max(side // 2, 1), side + 1)) for side in (width, height))
        left, top = int(rng.integers(0, width - crop_width + 1)), int(rng.integers(0, height - crop_height + 1))
        picture = picture.crop((left, top, left + crop_width, top + crop_height))
    behind = np.asarray(picture.resize((image.shape[1], image.shape[0]))).astype(np.float32)
    opacity = image[..., 3:].astype(np.float32) / 255.0
    return np.round(opacity * image[..., :3] + (1.0 - opacity) * behind).astype(np.uint8)


def background_files(folder: Path) -> list[Path]:
    """Return the images of a folder in order of their names.  Raises InputError if there is none."""
    suffixes = {".png", ".jpg", ".jpeg", ".bmp"}
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in suffixes)
    if not files:
        raise InputError("holds no background image", path=folder)
    return files


def random_stream(seed: int, epoch: int, index: int) -> np.random.Generator:
    """Return the generator of one sample in one epoch: the same for every number of workers and after every resume."""
    return np.random.default_rng([seed, epoch, index])
