"""A BOP data set of coloured squares, small enough to learn from in seconds, and a tiny network on top of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from poet_loc.model.checkpoint import ModelConfig, save_model
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.small_detector import SmallDetector, SmallDetectorOptions

SIZE = (96, 64)
FOCAL = 80.0
OBJECT_IDS = (2, 5)


def turned(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def write_bop_split(folder: Path, images: int = 6, seed: int = 0, scene: int = 1) -> Path:
    """Squares of two objects, 0.1 m wide, turned about the optical axis; the colour tells the object."""
    rng = np.random.default_rng(seed)
    scene_folder = folder / f"{scene:06d}"
    (scene_folder / "rgb").mkdir(parents=True)
    cameras, truth, info = {}, {}, {}
    for number in range(1, images + 1):
        picture = rng.integers(0, 60, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        truth[number], info[number] = [], []
        for index, object_id in enumerate(OBJECT_IDS):
            z = rng.uniform(0.4, 0.7)
            side = 0.1 * FOCAL / z
            x, y = rng.uniform(side / 2 + 2, SIZE[0] / 2 - side / 2) + index * SIZE[0] / 2, rng.uniform(20, 44)
            left, top = round(x - side / 2), round(y - side / 2)
            picture[max(top, 0) : round(y + side / 2), left : round(x + side / 2)] = (
                (250, 90, 0) if index else (0, 90, 250)
            )
            t = [(x - SIZE[0] / 2) / FOCAL * z * 1000, (y - SIZE[1] / 2) / FOCAL * z * 1000, z * 1000]
            rotation = turned(rng.uniform(-1, 1)).ravel().tolist()
            truth[number].append({"obj_id": object_id, "cam_R_m2c": rotation, "cam_t_m2c": t})
            box = [left, top, round(side), round(side)]
            info[number].append({"visib_fract": 1.0, "bbox_obj": box, "bbox_visib": box})
        matrix = [FOCAL, 0, SIZE[0] / 2, 0, FOCAL, SIZE[1] / 2, 0, 0, 1]
        cameras[number] = {"cam_K": matrix, "depth_scale": 1.0}
        Image.fromarray(picture).save(scene_folder / "rgb" / f"{number:06d}.png")
    for name, content in (("scene_camera", cameras), ("scene_gt", truth), ("scene_gt_info", info)):
        (scene_folder / f"{name}.json").write_text(json.dumps(content))
    return folder


def tiny_network(**changes: object) -> tuple[PoET, ModelConfig]:
    torch.manual_seed(1)
    detector_options = SmallDetectorOptions(class_count=2, widths=(32, 32, 32, 32), blocks=(1, 1, 1, 1), pyramid_dim=32)
    detector = SmallDetector(detector_options)
    shape = detector.shape()
    values = {
        "hidden_dim": 32,
        "heads": 4,
        "encoder_layers": 1,
        "decoder_layers": 2,
        "feedforward_dim": 64,
        "levels": len(shape.channels),
        "queries": 4,
        "map_channels": shape.channels,
        "map_strides": shape.strides,
        "class_count": 2,
        **changes,
    }
    options = NetworkOptions(**values)
    return PoET(options, detector), ModelConfig(options, detector_options, OBJECT_IDS)


def save_tiny(path: Path, **changes: object) -> Path:
    save_model(path, *tiny_network(**changes))
    return path
