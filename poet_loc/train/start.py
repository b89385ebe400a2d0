"""The network that a training run starts from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Backbone
from poet_loc.model.checkpoint import ModelConfig, build_network, load_strictly, read_weights
from poet_loc.model.detectors import build_detector, options_of_kind
from poet_loc.model.official_checkpoint import read_detector_weights
from poet_loc.model.poet import PoET
from poet_loc.train.options import TrainOptions

REPLACEABLE = ("translation_head", "rotation_head", "query_embed")


def starting_network(options: TrainOptions, object_ids: tuple[int, ...]) -> tuple[PoET, ModelConfig, list[str]]:
    """Return network, configuration, and the names of the tensors that start at random although `start` is given."""
    if options.start is not None:
        return _from_file(options, options.start, object_ids)
    detector, detector_options = _detector(options)
    shape = detector.shape()
    network_options = replace(
        options.network,
        map_channels=shape.channels,
        map_strides=shape.strides,
        class_count=len(object_ids),
    )
    config = ModelConfig(network_options, detector_options, object_ids)
    return PoET(network_options, detector), config, []


def _from_file(options: TrainOptions, path: Path, object_ids: tuple[int, ...]) -> tuple[PoET, ModelConfig, list[str]]:
    weights, config = read_weights(path)
    network_options = replace(config.network, class_count=len(object_ids))
    if options.uncertainty != "as the network":
        network_options = replace(network_options, uncertainty=options.uncertainty)
    if config.detector is None:
        raise InputError("has no detector to train on", path=path)
    refiner = config.refiner if object_ids == config.object_ids else None  # its models are of other objects
    if refiner is None:
        weights = {name: w for name, w in weights.items() if not name.startswith("refiner.")}
    config = replace(config, network=network_options, object_ids=object_ids, refiner=refiner)
    network = build_network(config)
    wanted = network.state_dict()
    unfit = [
        name
        for name in wanted
        if name.startswith(REPLACEABLE) and (name not in weights or weights[name].shape != wanted[name].shape)
    ]
    gone = [name for name in weights if name.startswith(REPLACEABLE) and name not in wanted]
    kept = {name: w for name, w in weights.items() if name not in unfit and name not in gone}
    load_strictly(network, {**kept, **{name: wanted[name] for name in unfit}}, path)
    return network, config, unfit


def _detector(options: TrainOptions) -> tuple[Backbone, Any]:
    path = options.backbone_weights
    if path is None:
        chosen = options_of_kind(options.backbone)
        return build_detector(chosen), chosen
    if path.suffix == ".safetensors":
        weights, config = read_weights(path)
        if config.detector is None:
            raise InputError("holds no detector", path=path)
        detector = build_detector(config.detector)
        own = {name.removeprefix("backbone.0."): w for name, w in weights.items() if name.startswith("backbone.0.")}
        load_strictly(detector, own, path)
        return detector, config.detector
    if options.backbone != "yolov4":
        raise InputError(f"{path.suffix} weights belong to yolov4, not to {options.backbone}", path=path)
    yolo = read_detector_weights(path)
    return yolo, yolo.options


def trainable(options: TrainOptions, network: PoET) -> None:
    """Freeze what is not to be trained.  Raises InputError where nothing would be left."""
    if options.train_only == "uncertainty":
        for name, parameter in network.named_parameters():
            parameter.requires_grad_("_aleatoric" in name or "_covariance" in name)
    if not any(parameter.requires_grad for parameter in network.parameters()):
        raise InputError("nothing is left to train", fix="give the network uncertainty heads")
