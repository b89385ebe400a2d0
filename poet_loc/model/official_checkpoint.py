"""Official PoET checkpoints: read without running what they hold, and turned into a file of ours."""

from __future__ import annotations

import argparse
import pickle
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.io.whole_folder import not_there
from poet_loc.model.checkpoint import ModelConfig, load_strictly, save_weights
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.torchvision_detector import LMO_LABELS, TorchvisionOptions, current_names
from poet_loc.model.yolov4 import YoloOptions, YoloV4Csp

ALLOWED: list[Any] = [argparse.Namespace]
"""All that a checkpoint may hold beside tensors, numbers, text and containers."""
LMO_OBJECTS = {1: "ape", 5: "can", 6: "cat", 8: "driller", 9: "duck", 10: "eggbox", 11: "glue", 12: "holepuncher"}


@dataclass(frozen=True)
class ConvertCheckpoint:
    """What an official checkpoint does not tell where its `args` are missing."""

    source: Path
    """Official checkpoint (.pth)."""
    target: Path
    """File to write (.safetensors)."""
    heads: int | None = None
    """Attention heads, if the file does not say."""
    queries: int | None = None
    """Object queries, if the file does not say."""
    overwrite: bool = False
    """Replace the target."""


def read_official(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any], int | None]:
    """Read weights, `args` and epoch of an official checkpoint, or a bare state dict.

    Nothing in the file is executed: anything beside tensors, plain values and `ALLOWED` is refused with InputError.
    """
    try:
        with torch.serialization.safe_globals(ALLOWED), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on pickles that torch did not write: what matters is said below
            content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise InputError("no such file", path=path) from None
    except pickle.UnpicklingError as error:
        raise InputError(_refusal(str(error)), path=path) from None
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, AttributeError, IndexError, TypeError) as error:
        raise InputError(f"not a whole checkpoint ({_reason(error)})", path=path) from None
    if not isinstance(content, Mapping):
        raise InputError(f"holds a {type(content).__name__}, not a checkpoint", path=path)
    weights = content.get("model", content)
    if not isinstance(weights, Mapping) or not all(isinstance(w, Tensor) for w in weights.values()) or not weights:
        raise InputError("holds no state dict of tensors", path=path)
    arguments = content.get("args") or {} if "model" in content else {}
    arguments = vars(arguments) if isinstance(arguments, argparse.Namespace) else arguments
    if not isinstance(arguments, Mapping):
        raise InputError(f"its args are a {type(arguments).__name__}, not a Namespace", path=path)
    epoch = content.get("epoch") if "model" in content else None
    return current_names(dict(weights)), dict(arguments), epoch


def _reason(error: Exception) -> str:
    if isinstance(error, EOFError) or not str(error):
        return "it ends early"
    if isinstance(error, RuntimeError | OSError):
        return str(error).splitlines()[0].partition(". ")[0]
    return "it is another kind of file"


def _refusal(message: str) -> str:
    found = re.search(r"GLOBAL (\S+)", message)
    wants = f"it wants to load {found.group(1)}" if found else "its pickle is damaged or holds more than tensors"
    return f"refused, nothing was executed: {wants}"


def options_of_weights(
    weights: Mapping[str, Tensor], arguments: Mapping[str, Any], path: str | Path = "checkpoint"
) -> NetworkOptions:
    """Infer what the weights tell and take the rest from `args`.

    Raises InputError where a needed tensor or argument is missing, or where both disagree.
    """
    try:
        inferred = _inferred(weights)
    except (KeyError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"no weights of a PoET network (at {error})", path=path) from None
    for name, official in (("heads", "nheads"), ("queries", "num_queries")):
        if arguments.get(official) is not None:
            inferred.setdefault(name, arguments[official])
        elif name not in inferred:
            raise InputError(f"does not say the number of {name}", path=path, fix=f"give --{name}")
    heads = int(inferred["heads"])
    for part in ("encoder", "decoder"):
        samples = inferred.pop(f"{part}_samples")
        if samples % heads:
            raise InputError(f"{samples} {part} samples cannot be shared by {heads} heads", path=path)
        inferred[f"{part}_points"] = samples // heads
    kind = arguments.get("rotation_representation", "6d")
    if inferred["rotation"] == "quat" and kind == "silho_quat":
        inferred["rotation"] = kind
    inferred["reference_points"] = arguments.get("reference_points", "bbox")
    inferred["dropout"] = float(arguments.get("dropout", 0.1))
    strides = (8, 16, 32) if arguments.get("backbone", "yolov4") == "yolov4" else (16, 32, 64)
    count = len(inferred["map_channels"])
    inferred["map_strides"] = strides[:count] if count <= 3 else tuple(strides[0] * 2**i for i in range(count))
    _compare(inferred, arguments, path)
    return NetworkOptions(**inferred)


def _inferred(weights: Mapping[str, Tensor]) -> dict[str, Any]:
    levels, dim = weights["transformer.level_embed"].shape
    layers = {
        part: 1 + max(int(m[1]) for m in (re.match(rf"transformer\.{part}\.layers\.(\d+)\.", k) for k in weights) if m)
        for part in ("encoder", "decoder")
    }
    projections = [weights[f"input_proj.{level}.0.weight"] for level in range(levels)]
    translation = len(weights[f"translation_head.{layers['decoder'] - 1}.layers.2.bias"])
    rotation = len(weights[f"rotation_head.{layers['decoder'] - 1}.layers.2.bias"])
    slots = translation // 3
    options: dict[str, Any] = {
        "hidden_dim": dim,
        "levels": levels,
        "encoder_layers": layers["encoder"],
        "decoder_layers": layers["decoder"],
        "feedforward_dim": len(weights["transformer.encoder.layers.0.linear1.bias"]),
        "encoder_samples": len(weights["transformer.encoder.layers.0.self_attn.attention_weights.bias"]) // levels,
        "decoder_samples": len(weights["transformer.decoder.layers.0.cross_attn.attention_weights.bias"]) // levels,
        "map_channels": tuple(int(w.shape[1]) for w in projections if w.shape[-1] == 1),
        "class_mode": "agnostic" if slots == 1 else "specific",
        "rotation": {6: "6d", 4: "quat"}[rotation // slots],
        "query_embedding": "learned" if "query_embed.weight" in weights else "bbox",
        "position_encoding": "learned" if "backbone.1.row_embed.weight" in weights else "sine",
        "uncertainty": "aleatoric" if "translation_head_aleatoric.0.layers.0.weight" in weights else "none",
    }
    if slots > 1:
        options["class_count"] = slots - 1
    if "query_embed.weight" in weights:
        options["queries"] = len(weights["query_embed.weight"])
    return options


def _compare(inferred: dict[str, Any], arguments: Mapping[str, Any], path: str | Path) -> None:
    official = {
        "hidden_dim": "hidden_dim",
        "levels": "num_feature_levels",
        "heads": "nheads",
        "queries": "num_queries",
        "encoder_layers": "enc_layers",
        "decoder_layers": "dec_layers",
        "feedforward_dim": "dim_feedforward",
        "encoder_points": "enc_n_points",
        "decoder_points": "dec_n_points",
        "class_count": "n_classes",
        "class_mode": "class_mode",
        "rotation": "rotation_representation",
        "query_embedding": "query_embedding",
        "position_encoding": "position_embedding",
    }
    if inferred["class_mode"] == "agnostic" and "n_classes" in arguments:
        inferred["class_count"] = int(arguments["n_classes"])
    wrong = [
        f"{name} is {inferred[name]} by the weights and {arguments[key]} by args"
        for name, key in official.items()
        if name in inferred and key in arguments and inferred[name] != arguments[key]
    ]
    if wrong:
        raise InputError("weights and args disagree: " + "; ".join(wrong), path=path)


def detector_of_weights(weights: Mapping[str, Tensor], arguments: Mapping[str, Any]) -> Any:
    """Return the options of the detector whose weights are there, or None."""
    names = [name.removeprefix("backbone.0.") for name in weights if name.startswith("backbone.0.")]
    if not names:
        return None
    if any(name.startswith("module_list.") for name in names):
        outputs = len(weights["backbone.0.module_list.143.Conv2d.bias"])
        return YoloOptions(
            class_count=outputs // 3 - 5,
            confidence=float(arguments.get("backbone_conf_thresh", YoloOptions.confidence)),
            overlap=float(arguments.get("backbone_iou_thresh", YoloOptions.overlap)),
            agnostic_overlap=bool(arguments.get("backbone_agnostic_nms", False)),
        )
    labels = len(weights["backbone.0.roi_heads.box_predictor.cls_score.bias"])
    return TorchvisionOptions(
        masks=any("mask_head" in name for name in names),
        label_count=labels,
        labels=LMO_LABELS if arguments.get("dataset") == "lmo" else (),
    )


def convert_checkpoint(options: ConvertCheckpoint) -> ModelConfig:
    """Turn an official checkpoint into safetensors with its whole configuration.

    The weights are held against the network that the configuration describes before anything is written.
    """
    not_there(options.target, options.overwrite)
    weights, arguments, epoch = read_official(options.source)
    given = {"nheads": options.heads, "num_queries": options.queries}
    known = {**arguments, **{name: value for name, value in given.items() if value is not None}}
    try:
        network_options = options_of_weights(weights, known, options.source)
        detector = detector_of_weights(weights, known)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"its args do not describe a network ({error})", path=options.source) from None
    except InputError as error:
        raise InputError(error.what, path=options.source, fix=error.fix) from None
    own = {name: w for name, w in weights.items() if not name.startswith("backbone.0.")}
    load_strictly(PoET(network_options), own, options.source)
    if isinstance(detector, YoloOptions):
        part = {n.removeprefix("backbone.0."): w for n, w in weights.items() if n.startswith("backbone.0.")}
        load_strictly(YoloV4Csp(detector), part, options.source)
    lmo = known.get("dataset") == "lmo"
    config = ModelConfig(
        network=network_options,
        detector=detector,
        object_ids=tuple(LMO_OBJECTS) if lmo else (),
        object_names=tuple(LMO_OBJECTS.values()) if lmo else (),
        source={"file": Path(options.source).name, "epoch": epoch, "args": _plain(arguments)},
    )
    digest = save_weights(options.target, weights, config)
    return replace(config, source={**config.source, "sha256": digest})


def _plain(arguments: Mapping[str, Any]) -> dict[str, Any]:
    simple = (str, int, float, bool, type(None), list, tuple)
    return {name: value if isinstance(value, simple) else str(value) for name, value in arguments.items()}


def read_detector_weights(path: str | Path, options: YoloOptions | None = None) -> YoloV4Csp:
    """Return Scaled-YOLOv4-CSP with the weights of a .pt file (key `model`) or a Darknet binary (.weights).

    The number of classes is that of the file, unless options are given.
    """
    if Path(path).suffix == ".weights":
        detector = YoloV4Csp(options or YoloOptions(class_count=_darknet_classes(path)))
        detector.load_darknet(path)
        return detector
    weights, _, _ = read_official(path)
    weights = {name.removeprefix("module.").removeprefix("backbone.0."): w.float() for name, w in weights.items()}
    if "module_list.143.Conv2d.bias" not in weights:
        raise InputError("holds no Scaled-YOLOv4-CSP", path=path)
    detector = YoloV4Csp(options or YoloOptions(class_count=len(weights["module_list.143.Conv2d.bias"]) // 3 - 5))
    load_strictly(detector, weights, path)
    return detector


def _darknet_classes(path: str | Path) -> int:
    """Return the number of classes that fits a Darknet file's length: each adds 3 (256 + 512 + 1024 + 3) weights."""
    with torch.device("meta"):
        one = YoloV4Csp(YoloOptions(class_count=1))
    fixed = sum(tensor.numel() for name, tensor in one.state_dict().items() if "num_batches" not in name)
    spare = (Path(path).stat().st_size - 20) // 4 - fixed
    per_class = 3 * (256 + 512 + 1024 + 3)
    return max(1 + round(spare / per_class), 1)
