"""The device that a name means."""

from __future__ import annotations

import torch

from poet_loc.core.input_error import InputError


def device_of(name: str) -> torch.device:
    """Return the device of cpu, cuda, cuda:1, or auto: cuda where there is one.

    Raises InputError for other names and for a GPU that is not there.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    kind, _, number = name.partition(":")
    if kind not in ("cpu", "cuda") or (number and not number.isdigit()):
        raise InputError(f"unknown device {name!r}", fix="give cpu, cuda or cuda:1")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        raise InputError(f"there is no GPU {number or 0} here", fix="give --device cpu")
    return torch.device(name)
