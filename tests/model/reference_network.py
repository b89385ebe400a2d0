"""The published network once more, in plain numpy and float64, read out of the state dict by the official names.

Nothing of poet_loc is used here: it is the oracle for configurations of which there is no official output.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Weights = dict[str, Array]

OFFICIAL_ARGUMENTS = {
    "lr": 2e-4, "lr_backbone_names": ["backbone.0"], "lr_backbone": 0.0, "lr_linear_proj_mult": 0.1,
    "lr_linear_proj_names": ["reference_points", "sampling_offsets"], "batch_size": 16, "eval_batch_size": 16,
    "weight_decay": 1e-4, "epochs": 50, "lr_drop": 100, "lr_drop_epochs": None, "clip_max_norm": 0.1, "sgd": False,
    "backbone": "yolov4", "backbone_cfg": "configs/ycbv_yolov4-csp.cfg", "backbone_weights": None,
    "backbone_conf_thresh": 0.4, "backbone_iou_thresh": 0.5, "backbone_agnostic_nms": False, "dilation": False,
    "position_embedding": "sine", "position_embedding_scale": 2 * np.pi, "num_feature_levels": 4, "bbox_mode": "gt",
    "reference_points": "bbox", "query_embedding": "bbox", "rotation_representation": "6d", "class_mode": "specific",
    "enc_layers": 2, "dec_layers": 2, "dim_feedforward": 96, "hidden_dim": 64, "dropout": 0.1, "nheads": 4,
    "num_queries": 5, "dec_n_points": 3, "enc_n_points": 4, "aleatoric": False, "calibrate": False,
    "matcher_type": "pose", "set_cost_class": 1, "set_cost_bbox": 1, "set_cost_giou": 2, "aux_loss": True,
    "translation_loss_coef": 1, "rotation_loss_coef": 1, "dataset": "ycbv", "dataset_path": "/data", "n_classes": 3,
    "train_set": "train", "eval_set": "test", "jitter_probability": 0.5, "rgb_augmentation": False, "device": "cuda",
    "grayscale": False, "seed": 42, "resume": "", "start_epoch": 0, "eval": False, "inference": False,
    "distributed": False, "world_size": 3, "dist_url": "env://", "num_workers": 0, "cache_mode": False,
}  # fmt: skip


@dataclass(frozen=True)
class Read:
    """What the last decoder layer and the ones before say, and the boxes that were asked about."""

    translation: Array
    """(layers, B, Q, 3)."""
    rotation: Array
    """(layers, B, Q, 3, 3), or quaternions w, x, y, z."""
    log_variances: tuple[Array, Array] | None
    boxes: Array
    classes: NDArray[np.int64]
    counts: list[int]


def linear(x: Array, w: Weights, name: str) -> Array:
    return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]


def layer_norm(x: Array, w: Weights, name: str) -> Array:
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * w[f"{name}.weight"] + w[f"{name}.bias"]


def softmax(x: Array) -> Array:
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


def nearest(mask: NDArray[np.bool_], height: int, width: int) -> NDArray[np.bool_]:
    rows = np.floor(np.arange(height) * mask.shape[1] / height).astype(int)
    columns = np.floor(np.arange(width) * mask.shape[2] / width).astype(int)
    return mask[:, rows][:, :, columns]


def project(x: Array, w: Weights, level: int) -> Array:
    kernel, bias = w[f"input_proj.{level}.0.weight"], w[f"input_proj.{level}.0.bias"]
    if kernel.shape[-1] == 1:
        y = np.einsum("bchw,dc->bdhw", x, kernel[..., 0, 0])
    else:
        padded = np.pad(x, ((0, 0), (0, 0), (1, 1), (1, 1)))
        height, width = (x.shape[2] + 1) // 2, (x.shape[3] + 1) // 2
        y = sum(
            np.einsum(
                "bchw,dc->bdhw",
                padded[:, :, i : i + 2 * height : 2, j : j + 2 * width : 2][..., :width],
                kernel[..., i, j],
            )
            for i in range(3)
            for j in range(3)
        )
    y = y + bias[None, :, None, None]
    grouped = y.reshape(len(y), 32, -1)
    grouped = grouped - grouped.mean(-1, keepdims=True)
    grouped = grouped / np.sqrt((grouped**2).mean(-1, keepdims=True) + 1e-5)
    gain, shift = (w[f"input_proj.{level}.1.{part}"][None, :, None, None] for part in ("weight", "bias"))
    return grouped.reshape(y.shape) * gain + shift


def sine_code(mask: NDArray[np.bool_], dim: int) -> Array:
    half = dim // 2
    frequency = 10000.0 ** (2 * np.floor(np.arange(half) / 2) / half)
    parts = []
    for axis in (1, 2):  # y, then x
        count = np.cumsum(~mask, axis=axis).astype(float)
        last = count[:, -1:] if axis == 1 else count[:, :, -1:]
        angle = ((count - 0.5) / (last + 1e-6) * 2 * np.pi)[..., None] / frequency
        parts.append(np.where(np.arange(half) % 2 == 0, np.sin(angle), np.cos(angle)))
    return np.concatenate(parts, -1)


def learned_code(mask: NDArray[np.bool_], w: Weights) -> Array:
    batch, height, width = mask.shape
    x = np.broadcast_to(
        w["backbone.1.col_embed.weight"][None, :width], (height, width, w["backbone.1.col_embed.weight"].shape[1])
    )
    y = np.broadcast_to(w["backbone.1.row_embed.weight"][:height, None], x.shape)
    return np.broadcast_to(np.concatenate([x, y], -1), (batch, height, width, 2 * x.shape[-1]))


def attend(
    query: Array, reference: Array, source: Array, padding: Array, shapes: list, w: Weights, name: str, heads: int
) -> Array:
    """Multi-scale deformable attention, one bilinear sample at a time over heads, levels and points."""
    batch, count, dim = query.shape
    levels = len(shapes)
    value = np.where(padding[..., None], 0.0, linear(source, w, f"{name}.value_proj")).reshape(
        batch, -1, heads, dim // heads
    )
    offsets = linear(query, w, f"{name}.sampling_offsets").reshape(batch, count, heads, levels, -1, 2)
    points = offsets.shape[4]
    weights = softmax(linear(query, w, f"{name}.attention_weights").reshape(batch, count, heads, -1))
    weights = weights.reshape(batch, count, heads, levels, points)
    found = np.zeros((batch, count, heads, dim // heads))
    start = 0
    for level, (height, width) in enumerate(shapes):
        plane = value[:, start : start + height * width].reshape(batch, height, width, heads, -1)
        start += height * width
        at = reference[:, :, None, None, level] + offsets[:, :, :, level] / [width, height]
        x, y = at[..., 0] * width - 0.5, at[..., 1] * height - 0.5
        for dy in (0, 1):
            for dx in (0, 1):
                column, row = np.floor(x) + dx, np.floor(y) + dy
                share = (1 - np.abs(x - column)) * (1 - np.abs(y - row))
                inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
                b, _, m, _ = np.indices(x.shape, sparse=True)
                picked = plane[b, np.clip(row, 0, height - 1).astype(int), np.clip(column, 0, width - 1).astype(int), m]
                found += ((share * inside * weights[:, :, :, level])[..., None] * picked).sum(3)
    return linear(found.reshape(batch, count, dim), w, f"{name}.output_proj")


def self_attention(q: Array, v: Array, w: Weights, name: str, heads: int) -> Array:
    dim = q.shape[-1]
    parts = [
        x @ w[f"{name}.in_proj_weight"][i * dim : (i + 1) * dim].T + w[f"{name}.in_proj_bias"][i * dim : (i + 1) * dim]
        for i, x in enumerate((q, q, v))
    ]
    a, b, c = (x.reshape(*x.shape[:2], heads, -1).swapaxes(1, 2) for x in parts)
    mixed = softmax(a @ b.swapaxes(-1, -2) / np.sqrt(dim / heads)) @ c
    return linear(mixed.swapaxes(1, 2).reshape(q.shape), w, f"{name}.out_proj")


def feed_forward(x: Array, w: Weights, name: str) -> Array:
    return linear(np.maximum(linear(x, w, f"{name}.linear1"), 0), w, f"{name}.linear2")


def box_code(boxes: NDArray[np.float32], dim: int) -> Array:
    codes = []
    for number in range(4):
        angle = boxes[..., number, None].astype(float) * 2.0 ** np.arange(dim // 8)
        codes += [np.sin(angle), np.cos(angle)]
    return np.concatenate(codes, -1)


def queries(
    detections: list, size: tuple[int, int], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int64], list[int]]:
    """Boxes and classes of the detector as the published code arranges them."""
    boxes = np.full((len(detections), count, 4), -1.0, np.float32)
    classes = np.full((len(detections), count), -1)
    counts = []
    for image, rows in enumerate(detections):
        rows = rows[np.argsort(-rows[:, 4], kind="stable")[:count]] if len(rows) > count else rows
        x1, y1, x2, y2 = rows[:, :4].astype(np.float32).T
        height, width = (np.float32(side) for side in size)
        two = np.float32(2)
        centre = [(x1 + x2) / two / width, (y1 + y2) / two / height]
        boxes[image, : len(rows)] = np.stack([*centre, (x2 - x1) / width, (y2 - y1) / height], -1)
        classes[image, : len(rows)] = rows[:, 5]
        counts.append(len(rows))
    return boxes, classes, counts


def forward(w: Weights, a: dict, maps: list[Array], mask: NDArray[np.bool_], detections: list) -> Read:
    """Run the network of a state dict and of official arguments on feature maps, a padding mask and detections."""
    dim, heads, levels = a["hidden_dim"], a["nheads"], a["num_feature_levels"]
    projected: list[Array] = []
    for level in range(levels):
        source = maps[level] if level < len(maps) else maps[-1] if level == len(maps) else projected[-1]
        projected.append(project(source, w, level))
    masks = [nearest(mask, *x.shape[2:]) for x in projected]
    shapes = [x.shape[2:] for x in projected]
    codes = [learned_code(m, w) if a["position_embedding"] == "learned" else sine_code(m, dim) for m in masks]
    batch = len(mask)
    tokens = np.concatenate([x.reshape(batch, dim, -1).swapaxes(1, 2) for x in projected], 1)
    places = [c.reshape(batch, -1, dim) + w["transformer.level_embed"][i] for i, c in enumerate(codes)]
    position, padding = np.concatenate(places, 1), np.concatenate([m.reshape(batch, -1) for m in masks], 1)
    ratios = np.stack([np.stack([(~m[:, 0]).mean(1), (~m[:, :, 0]).mean(1)], -1) for m in masks], 1)  # (B, L, 2)
    centres = []
    for (height, width), ratio in zip(shapes, ratios.swapaxes(0, 1)):
        y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
        centres.append(np.stack([x, y], -1).reshape(1, -1, 2) / (ratio * [width, height])[:, None])
    reference = np.concatenate(centres, 1)[:, :, None] * ratios[:, None]
    memory = tokens
    for i in range(a["enc_layers"]):
        name = f"transformer.encoder.layers.{i}"
        seen = attend(memory + position, reference, memory, padding, shapes, w, f"{name}.self_attn", heads)
        memory = layer_norm(memory + seen, w, f"{name}.norm1")
        memory = layer_norm(memory + feed_forward(memory, w, name), w, f"{name}.norm2")
    boxes, classes, counts = queries(detections, mask.shape[1:], a["num_queries"])
    if a["query_embedding"] == "learned":
        both = np.broadcast_to(w["query_embed.weight"], (batch, *w["query_embed.weight"].shape))
        query_position, state = both[..., :dim], both[..., dim:]
    else:
        code = box_code(boxes, dim)
        real = np.arange(a["num_queries"]) < np.array(counts)[:, None]
        query_position = state = np.where(real[..., None], code, -10.0)
    points = boxes[..., :2].astype(float)
    if a["reference_points"] == "learned":
        points = sigmoid(linear(query_position, w, "transformer.reference_points"))
    reference = points[:, :, None] * ratios[:, None]
    states = []
    for i in range(a["dec_layers"]):
        name = f"transformer.decoder.layers.{i}"
        mixed = self_attention(state + query_position, state, w, f"{name}.self_attn", heads)
        state = layer_norm(state + mixed, w, f"{name}.norm2")
        seen = attend(state + query_position, reference, memory, padding, shapes, w, f"{name}.cross_attn", heads)
        state = layer_norm(state + seen, w, f"{name}.norm1")
        state = layer_norm(state + feed_forward(state, w, name), w, f"{name}.norm3")
        states.append(state)

    def read(head: str) -> Array:
        found = []
        for i, x in enumerate(states):
            for k in range(3):
                x = linear(x, w, f"{head}.{i}.layers.{k}")
                x = np.maximum(x, 0) if k < 2 else x
            if a["class_mode"] == "specific":
                slots = x.reshape(*x.shape[:2], a["n_classes"] + 1, -1)
                x = np.take_along_axis(slots, np.maximum(classes, 0)[..., None, None], 2)[:, :, 0]
            found.append(x)
        return np.stack(found)

    rotation = read("rotation_head")
    if a["rotation_representation"] == "6d":
        first = rotation[..., :3] / np.linalg.norm(rotation[..., :3], axis=-1, keepdims=True)
        third = np.cross(first, rotation[..., 3:])
        third /= np.linalg.norm(third, axis=-1, keepdims=True)
        rotation = np.stack([first, np.cross(third, first), third], -1)
    else:
        rotation = rotation / np.linalg.norm(rotation, axis=-1, keepdims=True)
    aleatoric = (read("translation_head_aleatoric"), read("rotation_head_aleatoric")) if a["aleatoric"] else None
    return Read(read("translation_head"), rotation, aleatoric, boxes, classes, counts)
