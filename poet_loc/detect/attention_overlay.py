"""Draws where the network looked for an object's pose."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def draw_attention(
    pixels: NDArray[np.uint8], points: NDArray[np.float64], weights: NDArray[np.float64], scale: int = 3
) -> NDArray[np.uint8]:
    """Return the image, enlarged, with a disc at each sampling point whose area shows its weight.

    pixels (h, w, 3) RGB, points (K, 2) px, weights (K,) -> (scale h, scale w, 3).
    """
    canvas = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    canvas = (canvas * 0.6).astype(np.uint8)
    share = weights / max(float(weights.max(initial=0.0)), 1e-12)
    colors = cv2.applyColorMap((255 * share).astype(np.uint8)[:, None], cv2.COLORMAP_PLASMA)[:, 0, ::-1]
    for index in np.argsort(share):
        middle = tuple(round(float(value) * scale * 16) for value in points[index])
        radius = round(16 * scale * (0.4 + 2.2 * float(np.sqrt(share[index]))))
        color = tuple(int(value) for value in colors[index])
        cv2.circle(canvas, middle, radius, color, -1, cv2.LINE_AA, shift=4)
    return np.asarray(canvas, np.uint8)
