"""What an online estimator may be fed: how late and how dense, in which shapes, on which clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from poet_loc.core.input_error import InputError, within
from poet_loc.core.stamp_unit import FASTEST_IMU_HZ

_FIRST = 100  # samples that tell the unit of the stamps


@dataclass(frozen=True)
class OnlineOptions:
    """How late and how dense the input of an online estimator may be."""

    horizon_s: float = 0.5
    """What is older than the newest IMU sample by more is refused and counted, s."""
    ahead_s: float = 2.0
    """Poses may run ahead of the IMU by so much and wait for it, s."""
    snapshot_s: float = 0.02
    """The state is kept so often, s; something late costs the integration since the snapshot before it."""
    max_imu_rate_hz: float = 1000.0
    """The buffers hold the horizon at this rate of the IMU, Hz; above it the horizon shrinks."""
    max_pose_rate_hz: float = 1000.0
    """The buffers hold so many poses per second, over all objects, Hz; what does not fit is refused and counted."""
    clock_set_s: float = 0.5
    """Where all samples of the IMU were too late for so long, s, its clock was set back: what was fed is forgotten."""

    def __post_init__(self) -> None:
        within("(0, inf)", self, "snapshot_s", "max_imu_rate_hz", "max_pose_rate_hz")
        within("[0, inf)", self, "horizon_s", "ahead_s")
        within("(0, inf]", self, "clock_set_s")


def shaped(name: str, values: ArrayLike, *shape: int) -> NDArray[np.float64]:
    """Return values as floats of a shape (N, ..); where N is 1, that dimension may be missing.

    Raises ValueError for any other shape, also one of as many numbers: it would be read across.
    """
    given = np.asarray(values, dtype=float)
    if given.shape == shape or (given.shape == (0,) and shape[0] == 0):
        return given.reshape(shape)
    if shape[0] == 1 and given.shape == shape[1:]:
        return given[None]
    wanted = shape[1:] if shape[0] == 1 else shape
    raise ValueError(f"{name} must have the shape {wanted}, not {given.shape}")


def vector(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return three numbers as floats; raises ValueError for any other shape."""
    given = np.asarray(values, dtype=float)
    if given.shape != (3,):
        raise ValueError(f"{name} must have the shape (3,), not {given.shape}")
    return given


def whole_numbers(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Return a number or N of them as integers (N,); raises ValueError for what is none."""
    given = np.atleast_1d(np.asarray(values))
    if given.ndim > 1 or given.dtype.kind not in "iuf" or (given.dtype.kind == "f" and not (given % 1 == 0).all()):
        raise ValueError(f"{name} must be whole numbers, not {values!r}")
    return given.astype(np.int64)


class ImuClock:
    """Notices stamps that are no nanoseconds, and a clock that was set back.

    After a stamp far ahead, or when a recording is played again, every sample is older than the horizon: where all are
    so for `set_after_ns`, what came before is of another clock.
    """

    def __init__(self, horizon_ns: int, set_after_ns: float) -> None:
        self._horizon_ns, self._set_after_ns = horizon_ns, set_after_ns
        self._newest_ns: int | None = None
        self._late_since_ns: int | None = None
        self._span_ns, self._count = (0, 0), 0

    def was_set(self, stamp_ns: int) -> bool:
        """Take in the stamp of a sample and tell whether it is the first after the clock was set back.

        Raises InputError, once, where the first samples came faster than those of any IMU.
        """
        if self._count < _FIRST:
            self._look_at_unit(stamp_ns)
        if self._newest_ns is None or stamp_ns >= self._newest_ns - self._horizon_ns:
            self._newest_ns = stamp_ns if self._newest_ns is None else max(self._newest_ns, stamp_ns)
            self._late_since_ns = None
            return False
        if self._late_since_ns is None or stamp_ns < self._late_since_ns:
            self._late_since_ns = stamp_ns
        if stamp_ns - self._late_since_ns < self._set_after_ns:
            return False
        self._newest_ns, self._late_since_ns = stamp_ns, None
        return True

    def _look_at_unit(self, stamp_ns: int) -> None:
        earliest, latest = self._span_ns if self._count else (stamp_ns, stamp_ns)
        self._span_ns, self._count = (min(earliest, stamp_ns), max(latest, stamp_ns)), self._count + 1
        seconds = (self._span_ns[1] - self._span_ns[0]) * 1e-9
        if self._count == _FIRST and seconds < _FIRST / FASTEST_IMU_HZ:
            what = f"{_FIRST} samples of the IMU within {seconds:.2g} s"
            raise InputError(what, fix="give stamps in whole nanoseconds")
