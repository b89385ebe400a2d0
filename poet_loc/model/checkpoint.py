"""A network in one file: safetensors with its whole configuration and a checksum of its weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.model.detectors import build_detector, kind_of, options_of_kind, record_from, record_to_dict
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.refiner import PoseRefiner, RefinerOptions

FORMAT = "poet-loc network 1"


@dataclass(frozen=True)
class ModelConfig:
    """All that is needed to use a network's weights."""

    network: NetworkOptions
    detector: Any = None
    """Options record of the backbone; None: features and boxes come from elsewhere."""
    object_ids: tuple[int, ...] = ()
    """Object id of class 1, 2, ...; empty: the class is the id."""
    object_names: tuple[str, ...] = ()
    """Name of class 1, 2, ..."""
    image_size: tuple[int, int] | None = None
    """(width, height) px of the training images; the network knows no other camera."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy (px) of the training images."""
    variance_scale: tuple[float, float] = (1.0, 1.0)
    """Factors on the translation's and the rotation's variances, found on held-out data."""
    refiner: RefinerOptions | None = None
    """What corrects the poses by comparing them with the models; None: nothing does."""
    source: dict[str, Any] = field(default_factory=dict)
    """Where the weights come from, for the record."""

    def object_id(self, label: int) -> int:
        """Return the object id of a class, counted from 1."""
        return self.object_ids[label - 1] if self.object_ids else label

    def to_json(self) -> dict[str, Any]:
        """Return the configuration as JSON values."""
        values = record_to_dict(replace(self, detector=None))
        if self.detector is not None:
            values["detector"] = {"kind": kind_of(self.detector), **record_to_dict(self.detector)}
        if self.refiner is None:
            del values["refiner"]
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ModelConfig:
        """Return the configuration of `to_json`.  Raises InputError for unknown or impossible values."""
        given = dict(values)
        network = record_from(NetworkOptions, dict(given.pop("network", {})))
        detector = given.pop("detector", None)
        if detector is not None:
            detector = dict(detector)
            detector = options_of_kind(detector.pop("kind", ""), detector)
        refiner = given.pop("refiner", None)
        refiner = None if refiner is None else record_from(RefinerOptions, dict(refiner))
        parts = {"network": network, "detector": detector, "refiner": refiner}
        config: ModelConfig = record_from(cls, given | parts)
        return config


def checksum(weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of names, types, shapes and bytes of all tensors, in order of their names."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        tensor = weights[name].detach().contiguous().cpu()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def save_weights(path: str | Path, weights: Mapping[str, Tensor], config: ModelConfig) -> str:
    """Write weights with their configuration and return their checksum; the file appears whole or not at all.

    The same weights and configuration are the same bytes.
    """
    from safetensors.torch import save

    path = Path(path)
    tensors = {name: tensor.detach().contiguous().cpu() for name, tensor in weights.items()}
    digest = checksum(tensors)
    metadata = {"format": FORMAT, "config": json.dumps(config.to_json()), "sha256": digest}
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_bytes(_in_order(save(tensors, metadata)))
    unfinished.replace(path)
    return digest


def _in_order(data: bytes) -> bytes:
    """Return a safetensors file with its metadata sorted; the library writes them in an order of chance."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[start:]


def save_model(path: str | Path, network: PoET, config: ModelConfig, half: bool = False) -> str:
    """Write a network, in float16 if `half`, and return the checksum of its weights."""
    weights = network.state_dict()
    if half:
        weights = {name: w.half() if w.is_floating_point() else w for name, w in weights.items()}
    return save_weights(path, weights, config)


def read_weights(path: str | Path) -> tuple[dict[str, Tensor], ModelConfig]:
    """Read weights and configuration.  Raises InputError for files that are damaged or are something else."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise InputError("no such file", path=path) from None
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"not a whole safetensors file ({error})",
            path=path,
            fix="official .pth files go through convert checkpoint",
        ) from None
    if metadata.get("format") != FORMAT:
        raise InputError("has no configuration of a pose network", path=path, fix="make it with convert or train")
    if checksum(weights) != metadata.get("sha256"):
        raise InputError("the weights do not match their checksum: the file was changed or damaged", path=path)
    try:
        config = ModelConfig.from_json(json.loads(metadata["config"]))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"its configuration cannot be read ({error})", path=path) from None
    except InputError as error:
        raise InputError(error.what, path=path, fix=error.fix) from None
    return weights, config


def load_model(path: str | Path, with_detector: bool = True) -> tuple[PoET, ModelConfig]:
    """Return the network of a file, in evaluation mode and float32, and its configuration.

    Raises InputError where weights and configuration do not fit each other exactly.
    """
    weights, config = read_weights(path)
    if not with_detector:
        weights = {name: tensor for name, tensor in weights.items() if not name.startswith("backbone.0.")}
    network = build_network(config, with_detector)
    load_strictly(network, weights, path)
    return network.eval(), config


def build_network(config: ModelConfig, with_detector: bool = True) -> PoET:
    """Return the network of a configuration, its weights at random."""
    detector = build_detector(config.detector) if with_detector and config.detector is not None else None
    return PoET(config.network, detector, None if config.refiner is None else PoseRefiner(config.refiner))


def load_strictly(network: torch.nn.Module, weights: Mapping[str, Tensor], path: str | Path) -> None:
    """Copy weights into a network.  Raises InputError that lists keys which are missing, unexpected or misshapen."""
    wanted = network.state_dict()
    complaints = {
        "missing": sorted(set(wanted) - set(weights)),
        "unexpected": sorted(set(weights) - set(wanted)),
        "misshapen": [
            f"{name} {tuple(weights[name].shape)} for {tuple(wanted[name].shape)}"
            for name in wanted
            if name in weights and weights[name].shape != wanted[name].shape
        ],
    }
    told = [f"{kind}: {_some(names)}" for kind, names in complaints.items() if names]
    if told:
        raise InputError("the weights do not fit the configuration; " + "; ".join(told), path=path)
    network.load_state_dict({n: w.to(wanted[n].dtype) for n, w in weights.items()}, strict=True)


def _some(names: Iterable[str], most: int = 5) -> str:
    listed = list(names)
    rest = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(listed[:most]) + rest
