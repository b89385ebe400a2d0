"""Noise of detections as a file: written by fit-noise, read by fuse and run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from fusion.options import DetectionBias, DetectionNoise, FuseOptions
from poet_loc.core.input_error import InputError

Group = TypeVar("Group", DetectionNoise, DetectionBias)


def noise_text(noise: DetectionNoise, bias: DetectionBias) -> str:
    """Return what `with_noise_from` reads: YAML with every option of both groups."""
    return yaml.safe_dump({"noise": asdict(noise), "bias": asdict(bias)}, sort_keys=False, default_flow_style=None)


def with_noise_from(path: Path | None, options: FuseOptions) -> FuseOptions:
    """Return the options with noise and bias taken from a file, or as they are without one.

    Raises InputError for a file that is not YAML, an unknown option, a value that is no number, and an option that the
    file has and the options, too, have changed.
    """
    if path is None:
        return options
    try:
        document = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        line = getattr(getattr(error, "problem_mark", None), "line", None)
        raise InputError("is not YAML", path=path, line=None if line is None else line + 1, fix=_FIX) from None
    if not isinstance(document, Mapping) or not set(document) <= {"noise", "bias"}:
        raise InputError("has more or less than noise and bias", path=path, fix=_FIX)
    noise = _changed(options.noise, "noise", document, path)
    bias = _changed(options.bias, "bias", document, path)
    try:
        return replace(options, noise=noise, bias=bias)
    except InputError as error:
        raise InputError(error.what, path=path, fix=error.fix) from None


_FIX = "write it with poet-loc fit-noise"


def _changed(group: Group, name_of_group: str, document: Mapping[str, Any], path: Path) -> Group:
    values = document.get(name_of_group, {})
    if not isinstance(values, Mapping):
        raise InputError("noise and bias hold options by name", path=path, fix=_FIX)
    known = {field.name: type(getattr(group, field.name)) for field in fields(group)}
    for name, value in values.items():
        if name not in known:
            raise InputError(f"unknown option '{name}'", path=path, fix=f"one of {', '.join(known)}")
        if name != "means" and (
            isinstance(value, bool) != (known[name] is bool) or not isinstance(value, (bool, int, float))
        ):
            raise InputError(f"{name} is {value!r}", path=path, fix=f"give it a {known[name].__name__}")
        if getattr(group, name) != getattr(type(group)(), name):
            what = f"has {name_of_group}.{name.replace('_', '-')}, which the command line gives too"
            raise InputError(what, path=path, fix="leave it out of one of them")
    if "means" in values:
        values = {**values, "means": _rows(values["means"], path)}
    return replace(group, **values)


def _rows(value: Any, path: Path) -> tuple[tuple[Any, ...], ...]:
    rows: list[Any] = value if isinstance(value, list) else [value]
    for row in rows:
        if not isinstance(row, list) or len(row) != 7 or not isinstance(row[0], int) or not _are_numbers(row):
            raise InputError(f"means has {row!r}", path=path, fix="give each object its id and six numbers")
    return tuple((row[0], *map(float, row[1:])) for row in rows)


def _are_numbers(row: list[Any]) -> bool:
    return all(isinstance(each, (int, float)) and not isinstance(each, bool) for each in row)
