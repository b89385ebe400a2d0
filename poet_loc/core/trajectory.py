"""A trajectory: stamps and poses of one body in one world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.geometry import local, retract

Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Trajectory:
    """Strictly increasing stamps (N,) int64 ns and N poses T_world_body."""

    stamps_ns: Stamps
    T_world_body: RigidTransform

    def __post_init__(self) -> None:
        if len(self.stamps_ns) != len(self.T_world_body):
            raise ValueError(f"{len(self.stamps_ns)} stamps for {len(self.T_world_body)} poses")
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise ValueError("stamps must increase strictly")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Trajectory:
        return Trajectory(self.stamps_ns[index], self.T_world_body[index])

    def between(self, start_ns: int, end_ns: int) -> Trajectory:
        """Return the poses with start_ns <= stamp <= end_ns."""
        first, last = np.searchsorted(self.stamps_ns, [start_ns, end_ns + 1])
        return self[first:last]

    def to_body(self, T_body_other: RigidTransform) -> Trajectory:
        """Return the trajectory of another frame fixed to the body."""
        return Trajectory(self.stamps_ns, self.T_world_body * T_body_other)

    def later(self, by_ns: int) -> Trajectory:
        """Return the same poses with stamps that are later by so much: on a clock that is ahead."""
        return Trajectory(self.stamps_ns + by_ns, self.T_world_body)

    def interpolate(self, stamps_ns: Stamps, max_gap_ns: int | None = None) -> tuple[RigidTransform, NDArray[np.bool_]]:
        """Return the poses at other stamps, along the SE(3) geodesic between neighbours, and which are valid.

        A stamp outside the span is not valid and gets the nearest pose; one inside a gap longer than max_gap_ns is not
        valid either.
        """
        if len(self) == 0:
            raise ValueError("an empty trajectory has no pose to interpolate")
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, side="left"), 1, max(len(self) - 1, 1))
        before = np.minimum(after - 1, len(self) - 1)
        after = np.minimum(after, len(self) - 1)
        span = self.stamps_ns[after] - self.stamps_ns[before]
        share = np.clip((stamps_ns - self.stamps_ns[before]) / np.maximum(span, 1), 0.0, 1.0)
        T_before, T_after = self.T_world_body[before], self.T_world_body[after]
        poses = retract(T_before, share[:, None] * local(T_before, T_after))
        valid = (stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1])
        if max_gap_ns is not None:
            on_sample = (stamps_ns == self.stamps_ns[before]) | (stamps_ns == self.stamps_ns[after])
            valid &= on_sample | (span <= max_gap_ns)
        return poses, valid


def match_stamps(
    stamps_a: Stamps, stamps_b: Stamps, max_difference_ns: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return index pairs (i, j) of mutually nearest stamps at most max_difference_ns apart, in order of time."""
    if len(stamps_a) == 0 or len(stamps_b) == 0:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    nearest_b = nearest_stamps(stamps_a, stamps_b)
    nearest_a = nearest_stamps(stamps_b, stamps_a)
    index_a = np.arange(len(stamps_a))
    mutual = nearest_a[nearest_b] == index_a
    close = np.abs(stamps_a - stamps_b[nearest_b]) <= max_difference_ns
    keep = mutual & close
    return index_a[keep], nearest_b[keep]


def nearest_stamps(queries: Stamps, sorted_stamps: Stamps) -> NDArray[np.intp]:
    """Return the index of the stamp nearest each query, the earlier of two equally near; sorted_stamps not empty."""
    right = np.clip(np.searchsorted(sorted_stamps, queries), 1, max(len(sorted_stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(sorted_stamps) - 1)
    take_left = np.abs(queries - sorted_stamps[left]) <= np.abs(sorted_stamps[right] - queries)
    return np.where(take_left, left, right)
