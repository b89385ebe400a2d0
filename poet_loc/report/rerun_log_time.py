"""The time line of a recording: the sensor's own."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

TIMELINE = "sensor_time"

_EPOCH_NS = 10**17  # stamps beyond it (1973) count from 1970, stamps before it from the sensor's start


def time_column(stamps_ns: NDArray[np.int64]) -> rr.TimeColumn:
    """Return stamps as a column: dates where they count from 1970, durations otherwise."""
    if len(stamps_ns) and stamps_ns[0] > _EPOCH_NS:
        return rr.TimeColumn(TIMELINE, timestamp=stamps_ns.astype("datetime64[ns]"))
    return rr.TimeColumn(TIMELINE, duration=stamps_ns.astype("timedelta64[ns]"))
