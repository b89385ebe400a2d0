"""What a camera does to the light: exposure, white balance, blur, noise, tone curve, JPEG."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Sensor:
    """The settings of one exposure."""

    exposure: float = 1.0
    """Gain on linear light."""
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Gain of red, green and blue."""
    gamma: float = 2.2
    """Tone curve."""
    blur: float = 0.0
    """Standard deviation of the defocus, pixels."""
    motion: tuple[float, float] = (0.0, 0.0)
    """Way of the image during the exposure, pixels."""
    noise: float = 0.01
    """Standard deviation of the noise at full brightness, of a range of 1; it grows with the root of the light."""
    quality: int = 95
    """JPEG quality."""


def random_sensor(rng: np.random.Generator, mean_light: float) -> Sensor:
    """Return random settings whose exposure suits the mean light of an image more or less."""
    exposure = 0.22 / max(mean_light, 0.02) * np.exp(rng.normal(0.0, 0.35))
    balance = tuple(float(gain) for gain in 1.0 + rng.normal(0.0, 0.06, 3))
    angle, length = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 5.0) if rng.random() < 0.25 else 0.0
    return Sensor(
        exposure=float(exposure),
        balance=balance,  # type: ignore[arg-type]
        gamma=float(rng.uniform(1.9, 2.5)),
        blur=float(rng.uniform(0.3, 1.2)) if rng.random() < 0.3 else 0.0,
        motion=(length * np.cos(angle), length * np.sin(angle)),
        noise=float(rng.uniform(0.002, 0.035)),
        quality=int(rng.integers(70, 98)),
    )


def expose(light: NDArray[np.float32], sensor: Sensor, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the uint8 RGB image of linear light (H, W, 3)."""
    signal = light * (np.asarray(sensor.balance, np.float32) * np.float32(sensor.exposure))
    length = float(np.hypot(*sensor.motion))
    if length > 0.5:
        signal = cv2.filter2D(signal, -1, _streak(sensor.motion, length), borderType=cv2.BORDER_REPLICATE)
    if sensor.blur > 0:
        signal = cv2.GaussianBlur(signal, (0, 0), sensor.blur)
    grain = rng.standard_normal(signal.shape, dtype=np.float32)
    signal = signal + grain * np.float32(sensor.noise) * np.sqrt(np.clip(signal, 0.02, 1.0))
    tone = np.clip(signal, 0.0, 1.0) ** np.float32(1.0 / sensor.gamma)
    return (tone * 255.0 + 0.5).astype(np.uint8)


def _streak(motion: tuple[float, float], length: float) -> NDArray[np.float32]:
    reach = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for share in np.linspace(-0.5, 0.5, 4 * reach + 1):
        x, y = reach + share * motion[0], reach + share * motion[1]
        column, row = int(np.floor(x)), int(np.floor(y))
        fx, fy = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer([1 - fy, fy], [1 - fx, fx]).astype(np.float32)
    return kernel / kernel.sum()
