"""Images of ROS bags as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from poet_loc.core.input_error import InputError

_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "mono16": 1, "16UC1": 1}


def write_image(folder: Path, number: int, message: Any) -> str:
    """Write sensor_msgs/CompressedImage as it is, sensor_msgs/Image as PNG; return the path relative to the folder.

    Raises InputError for an encoding that is unknown here.
    """
    (folder / "images").mkdir(exist_ok=True)
    if hasattr(message, "format"):
        ending = "png" if "png" in message.format.lower() else "jpg"
        name = f"images/{number:06d}.{ending}"
        (folder / name).write_bytes(message.data.tobytes())
        return name
    import cv2

    if message.encoding not in _CHANNELS:
        what = f"images are encoded as {message.encoding}"
        raise InputError(what, fix=f"one of {', '.join(_CHANNELS)}; debayer others first")
    wide = message.encoding in ("mono16", "16UC1")
    kind = np.dtype(np.uint16 if wide else np.uint8).newbyteorder(">" if message.is_bigendian else "<")
    channels = _CHANNELS[message.encoding]
    rows = np.frombuffer(message.data.tobytes(), np.uint8).reshape(message.height, message.step)
    used = np.ascontiguousarray(rows[:, : message.width * channels * kind.itemsize])  # rows may be padded
    pixels = used.view(kind).reshape(message.height, message.width, channels).astype(kind.newbyteorder("="))
    if message.encoding.startswith("rgb"):
        pixels = pixels[:, :, [2, 1, 0, 3][:channels]]
    name = f"images/{number:06d}.png"
    cv2.imwrite(str(folder / name), pixels)
    return name
