"""What to look at, with which network, and what to write."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from poet_loc.core.input_error import at_least

Engine = Literal["fast", "bfloat16", "eager"]


@dataclass(frozen=True)
class DetectOptions:
    """How images become object poses."""

    weights: Path | None = None
    """Network (.safetensors); without it the embedded one."""
    exported: Path | None = None
    """Exported pose network (.onnx or .xml) that is run instead; `weights` still has detector and configuration."""
    engine: Engine = "fast"
    """fast: fused path for CPUs; bfloat16: the same at half width, less exact; eager: plain torch, also on a GPU."""
    rounds: int | None = None
    """Rounds in which poses are compared with views of the models and corrected; 0: none, without it as many as the
    weights were made for."""
    device: str = "cpu"
    """cpu or cuda; a GPU takes engine eager."""
    threads: int | None = None
    """CPU threads; on a machine that others load, 1 is often fastest.  Without it torch's default."""
    batch: int = 1
    """Images at a time."""
    score: float = 0.0
    """Detections below this score are dropped."""
    boxes: Path | None = None
    """Boxes and classes from elsewhere instead of the detector's: csv with image,x1,y1,x2,y2,score,class (px)."""
    true_boxes: bool = False
    """Of a BOP scene or split: ask about the boxes and classes of the objects that are there."""
    keyframes: Path | None = None
    """Of a BOP split: file of lines like 0048/000001 that restricts the images."""
    stamps: Path | None = None
    """frames.csv with the stamps of the images, if it does not lie in the folder."""
    rate: float = 30.0
    """Hz, for images without stamps: frame k gets k / rate."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy (px); else those of the BOP scene or of the log's calibration.yaml, else of the camera of the
    training images."""
    scene: int = 0
    """Scene number in the BOP results, for images that are no BOP scene."""
    unknown_objects: bool = False
    """On a log with landmarks.json, keep detections of objects that the map does not have."""
    overlays: bool = False
    """Draw boxes and axes into copies of the images."""
    axis_m: float = 0.05
    """Length of the drawn axes."""

    def __post_init__(self) -> None:
        at_least(1, self, "batch", *([] if self.threads is None else ["threads"]))
        at_least(0, self, *([] if self.rounds is None else ["rounds"]))
        at_least(1e-6, self, "rate")
