"""Stamps that are no nanoseconds show in a rate that no sensor has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.input_error import InputError

FASTEST_IMU_HZ, FASTEST_CAMERA_HZ = 20_000.0, 2_000.0


def refuse_other_units(stamps_ns: NDArray[np.int64], fastest_hz: float, path: str | Path) -> None:
    """Raise InputError where (N,) stamps come faster, in the mean, than such a sensor does."""
    stamps = np.unique(stamps_ns)
    if len(stamps) < 3:
        return
    rate = 1e9 * (len(stamps) - 1) / float(stamps[-1] - stamps[0])
    if rate > fastest_hz:
        fix = "write stamps in whole nanoseconds; poet-loc check --fix does it"
        raise InputError(f"the stamps say {rate:.3g} Hz", path=path, fix=fix)
