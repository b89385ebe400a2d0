"""Label textures drawn by code from a seed: text, bar codes, pictures, tables and backgrounds (uint8 RGB)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Color = tuple[int, ...]

_LETTERS = np.array(list("ABCDEFGHIKLMNOPRSTUVXZ0123456789"))


def plain(height: int, width: int, color: Color, rng: np.random.Generator, grain: float = 3.0) -> Image:
    """Return one colour with a little grain."""
    noise = rng.normal(0.0, grain, (height, width, 1))
    return np.clip(np.asarray(color, float) + noise, 0, 255).astype(np.uint8)


def write(image: Image, text: str, box: tuple[float, float, float, float], color: Color, thick: float = 1.0) -> None:
    """Write text into a box (left, top, right, bottom, shares of the image), as large as fits."""
    height, width = image.shape[:2]
    left, top, right, bottom = box[0] * width, box[1] * height, box[2] * width, box[3] * height
    font = cv2.FONT_HERSHEY_DUPLEX
    (text_width, text_height), base = cv2.getTextSize(text, font, 1.0, 2)
    scale = min((right - left) / text_width, (bottom - top) / (text_height + base))
    stroke = max(1, round(1.6 * scale * thick))
    y = round((top + bottom + scale * (text_height - base * 0.3)) / 2)
    cv2.putText(image, text, (round(left), y), font, scale, color, stroke, cv2.LINE_AA)


def bar_code(image: Image, box: tuple[float, float, float, float], rng: np.random.Generator) -> None:
    """Draw a bar code on white into a box given as shares of the image."""
    height, width = image.shape[:2]
    left, top, right, bottom = (round(share * side) for share, side in zip(box, (width, height, width, height)))
    image[top:bottom, left:right] = 245
    bars = rng.random(max((right - left) // 3, 1)) < 0.5
    margin = max((bottom - top) // 10, 1)
    for index, dark in enumerate(bars[1:-1], start=1):
        if dark:
            image[top + margin : bottom - margin, left + 3 * index : left + 3 * index + 3] = 20


def picture(image: Image, box: tuple[float, float, float, float], rng: np.random.Generator, shapes: int = 9) -> None:
    """Draw a picture of overlapping discs, polygons and stripes into a box given as shares of the image."""
    height, width = image.shape[:2]
    left, top, right, bottom = (round(share * side) for share, side in zip(box, (width, height, width, height)))
    part = np.ascontiguousarray(image[top:bottom, left:right])
    rows, columns = part.shape[:2]
    for _ in range(shapes):
        color = tuple(int(value) for value in rng.integers(20, 250, 3))
        middle = (int(rng.integers(0, columns)), int(rng.integers(0, rows)))
        reach = int(min(rows, columns) * rng.uniform(0.1, 0.35)) + 2
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(part, middle, reach, color, -1, cv2.LINE_AA)
        elif kind == 1:
            corners = np.asarray(middle) + rng.integers(-reach, reach + 1, (5, 2))
            cv2.fillPoly(part, [corners.astype(np.int32)], color, cv2.LINE_AA)
        else:
            end = (middle[0] + int(rng.integers(-2 * reach, 2 * reach)), middle[1] + reach)
            cv2.line(part, middle, end, color, max(2, reach // 3), cv2.LINE_AA)
    image[top:bottom, left:right] = part


def small_print(image: Image, box: tuple[float, float, float, float], rng: np.random.Generator, color: Color) -> None:
    """Draw lines that look like a list of ingredients into a box given as shares of the image."""
    left, top, right, bottom = box
    lines = 7
    for line in range(lines):
        word = "".join(rng.choice(_LETTERS, 14))
        row = top + (bottom - top) * line / lines
        write(
            image, word, (left, row, left + (right - left) * rng.uniform(0.7, 1.0), row + (bottom - top) / lines), color
        )


def word(rng: np.random.Generator, length: int) -> str:
    """Return a random word in capitals."""
    return "".join(rng.choice(_LETTERS[:22], length))


def noise_texture(size: int, rng: np.random.Generator) -> Image:
    """Return a random surface: octaves of noise between two or three colours, sometimes checked or striped."""
    weight = np.zeros((size, size), np.float32)
    stretch = rng.choice([1, 1, 4, 12])
    for octave in range(2, 8):
        rows, columns = max(2**octave // stretch, 2), 2**octave
        coarse = rng.random((rows, columns), dtype=np.float32) - 0.5
        weight += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC) * 0.6 ** (octave - 2)
    weight = (weight - weight.min()) / max(float(np.ptp(weight)), 1e-6)
    if rng.random() < 0.35:
        period = int(rng.integers(8, 64))
        y, x = np.mgrid[0:size, 0:size] // period
        pattern = (x + y) % 2 if rng.random() < 0.5 else x % 2
        weight = np.clip(weight * 0.4 + 0.6 * pattern, 0, 1)
    colors = rng.uniform(10, 245, (3, 3)) * rng.uniform(0.4, 1.0)
    if rng.random() < 0.5:  # mostly muted surfaces, as tables are
        colors = 0.3 * colors + 0.7 * colors.mean(1, keepdims=True)
    first = colors[0] + (colors[1] - colors[0]) * weight[..., None]
    mixed = first + (colors[2] - first) * np.clip(3 * weight[..., None] - 2, 0, 1)
    return np.clip(mixed, 0, 255).astype(np.uint8)


def scenery(size: int, rng: np.random.Generator) -> Image:
    """Return a background: a surface with a cluttered picture and some text on it."""
    image = noise_texture(size, rng)
    picture(image, (0.0, 0.0, 1.0, 1.0), rng, shapes=int(rng.integers(0, 25)))
    for _ in range(int(rng.integers(0, 4))):
        x, y = rng.uniform(0, 0.6, 2)
        color = tuple(int(value) for value in rng.integers(0, 255, 3))
        write(image, word(rng, int(rng.integers(3, 8))), (x, y, x + 0.4, y + 0.15), color)
    if rng.random() < 0.4:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), float(rng.uniform(1, 5))), np.uint8)
    return image
