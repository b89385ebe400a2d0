"""Boxes and axes drawn into the images that they were found in."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from poet_loc.detect.estimator import Sighting

AXIS_COLOURS = ((230, 60, 60), (40, 180, 75), (60, 110, 240))
BOX_COLOUR = (255, 225, 25)


def draw_overlay(
    sighting: Sighting, intrinsics: tuple[float, float, float, float] | None, axis_m: float, path: Path
) -> None:
    """Write a copy of a picture with each object's box, id, score, and x, y, z axes in red, green, blue.

    Without intrinsics (fx, fy, cx, cy in px) the axes cannot be projected and are left out.
    """
    from PIL import Image, ImageDraw

    picture = Image.fromarray(sighting.picture.pixels)
    draw = ImageDraw.Draw(picture)
    size = np.array(picture.size * 2)
    for row, box in enumerate(sighting.boxes * size):
        x1, y1, x2, y2 = box[0] - box[2] / 2, box[1] - box[3] / 2, box[0] + box[2] / 2, box[1] + box[3] / 2
        draw.rectangle([x1, y1, x2, y2], outline=BOX_COLOUR)
        draw.text((x1 + 2, max(y1 - 11, 0)), f"{sighting.object_ids[row]} {sighting.scores[row]:.2f}", fill=BOX_COLOUR)
        corners = None if intrinsics is None else axis_ends(sighting, row, intrinsics, axis_m)
        if corners is not None:
            for end, colour in zip(corners[1:], AXIS_COLOURS):
                draw.line([*corners[0], *end], fill=colour, width=2)
    picture.save(path)


def axis_ends(
    sighting: Sighting, row: int, intrinsics: tuple[float, float, float, float], axis_m: float
) -> list[tuple[float, float]] | None:
    """Return the pixels of an object's origin and of the ends of its axes, None where one is behind the camera."""
    points = np.vstack([np.zeros(3), axis_m * np.eye(3)]) @ sighting.rotations[row].T + sighting.translations[row]
    if points[:, 2].min() <= 1e-6:
        return None
    fx, fy, cx, cy = intrinsics
    return [(float(fx * x / z + cx), float(fy * y / z + cy)) for x, y, z in points]
