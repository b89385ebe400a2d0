"""The backbones by name, and their options to and from a checkpoint's configuration."""

from __future__ import annotations

from dataclasses import asdict, fields
from importlib import import_module
from typing import Any

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Backbone

KINDS = {
    "small": ("poet_loc.model.small_detector", "SmallDetectorOptions", "SmallDetector"),
    "yolov4": ("poet_loc.model.yolov4", "YoloOptions", "YoloV4Csp"),
    "torchvision": ("poet_loc.model.torchvision_detector", "TorchvisionOptions", "TorchvisionDetector"),
}


def build_detector(options: Any) -> Backbone:
    """Return the backbone that an options record describes."""
    for module_name, options_name, class_name in KINDS.values():
        if type(options).__module__ == module_name and type(options).__name__ == options_name:
            detector = getattr(import_module(module_name), class_name)(options)
            assert isinstance(detector, Backbone)
            return detector
    raise InputError(f"no backbone has options of type {type(options).__name__}")


def kind_of(options: Any) -> str:
    """Return the name of the backbone that an options record belongs to."""
    for kind, (module_name, options_name, _) in KINDS.items():
        if type(options).__module__ == module_name and type(options).__name__ == options_name:
            return kind
    raise InputError(f"no backbone has options of type {type(options).__name__}")


def options_of_kind(kind: str, values: dict[str, Any] | None = None) -> Any:
    """Return the options record of a kind of backbone.  Raises InputError for unknown kinds and fields."""
    if kind not in KINDS:
        raise InputError(f"unknown backbone '{kind}'", fix=f"one of {', '.join(KINDS)}")
    module_name, options_name, _ = KINDS[kind]
    return record_from(getattr(import_module(module_name), options_name), values or {})


def record_to_dict(record: Any) -> dict[str, Any]:
    """Return the fields of an options record, ready for JSON."""
    return asdict(record)


def record_from(kind: type, values: dict[str, Any]) -> Any:
    """Return the frozen record of a dictionary; lists become tuples.  Raises InputError for unknown fields."""
    unknown = sorted(set(values) - {f.name for f in fields(kind)})
    if unknown:
        raise InputError(f"{kind.__name__} has no field {', '.join(unknown)}")
    return kind(**{name: _tuples(value) for name, value in values.items()})


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
