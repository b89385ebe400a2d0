"""Where odometry breaks: jumps, and holes in which the motion is not known. Causal: each interval by those before it.

Tracking that relocalises or closes a loop puts one interval's motion off by decimetres; tracking that is lost leaves a
hole, behind which it goes on where it was, or in a frame of its own. Neither says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from poet_loc.core.geometry import local
from poet_loc.core.trajectory import Trajectory

Array = NDArray[np.float64]

FAR = 5.0
"""A twist is off where it differs so many times more from the one before than they mostly do."""
_LONG, _MOSTLY = 3.0, 90  # times the interval that so many in a hundred keep within make a hole
_REMEMBERED = 31  # intervals that say what is usual, odd
_TOLD, _TOLD_S = (np.radians(5.0), 0.05), 0.5  # rad and m of a jump, s of a hole, that are worth telling
_CORRELATED_S = 1.0  # for so long a motion goes one way; then it wanders


@dataclass(frozen=True)
class Expected:
    """What odometry mostly does, and what a camera may do while it says nothing: rotation and translation."""

    walk: tuple[float, float]
    """1-sigma of its drift, rad and m per square root of a second and axis."""
    longest_s: float
    """An interval longer than this, and than three times what most are, is a hole, s."""
    unseen: tuple[float, float]
    """1-sigma of the rates inside a hole, rad/s and m/s per axis; by as much they may change in a second."""


@dataclass(frozen=True)
class Believed:
    """What there is to believe of odometry's motion, interval by interval."""

    twists: Array
    """(N, 6) [rotation, translation] per second: as measured, or as far that way as the interval before it vouches."""
    sigmas: Array
    """(N, 2) 1-sigma per axis, rad and m, of what is not known of the interval's motion beside the drift; mostly 0."""
    taken_off: Array
    """(N, 2) rad and m of the interval's motion that is not believed."""
    holes_s: Array
    """(N,) how much longer than usual the interval is, s."""


def believed_motion(stamps_ns: NDArray[np.int64], twists: Array, expected: Expected) -> Believed:
    """Return what to believe of the twists (N, 6), per second, between N + 1 stamps.

    A twist may differ from the one that was believed before it by FAR times what is usual, and in a hole by what a
    camera may do unseen; what it is off beyond that is taken off, and is a 1-sigma of what is not known. It may
    slow down at once: so jumps end. Before the first two the slower of them stands.
    """
    seconds = np.diff(stamps_ns) * 1e-9
    holes = holes_between(stamps_ns, expected.longest_s)
    believed, unseen, taken_off = twists.copy(), unseen_sigmas(holes, expected), np.zeros((len(twists), 2))
    for part in range(2):
        own = believed[:, 3 * part : 3 * part + 3]
        loose = unseen[:, part] / seconds
        before = own[[np.argmin(np.linalg.norm(own[:2], axis=1))]]
        differences = np.linalg.norm(np.diff(own, axis=0, prepend=before), axis=1)
        moved = expected.unseen[part] * np.minimum(seconds - holes, _CORRELATED_S)
        least = np.hypot(np.sqrt(6.0 / seconds) * expected.walk[part], moved)  # drift of both, and a change of motion
        usual = np.maximum(_running_percentile(differences, 50), least)
        limits = FAR * usual + loose + np.r_[0.0, loose[:-1]]
        taken_off[:, part] = _hold(own, before[0], limits, differences > limits) * seconds
    return Believed(believed, np.hypot(unseen, taken_off), taken_off, holes)


def unseen_sigmas(holes_s: Array, expected: Expected) -> Array:
    """Return the 1-sigma (N, 2) per axis, rad and m, of what a camera may have done in holes (N,) of so many s."""
    return np.sqrt(holes_s * np.minimum(holes_s, _CORRELATED_S))[:, None] * expected.unseen


def holes_between(stamps_ns: NDArray[np.int64], longest_s: float) -> Array:
    """Return how much longer than usual each of the N intervals between N + 1 stamps is, s; mostly 0."""
    seconds = np.diff(stamps_ns) * 1e-9
    usual = _running_percentile(seconds, _MOSTLY)
    usual[:1] = seconds[1:2].sum()  # of one alone it is not known
    return np.maximum(0.0, seconds - np.maximum(longest_s, _LONG * usual))


def _running_percentile(values: Array, percentile: int) -> Array:
    """Return the percentile of each value and those before it, as far back as is remembered; 0 for the first, alone."""
    found = np.asarray(percentile_filter(values, percentile, _REMEMBERED, mode="nearest", origin=_REMEMBERED // 2))
    for k in range(min(len(values), _REMEMBERED)):
        found[k] = np.percentile(values[: k + 1], percentile, method="lower") if k else 0.0
    return found


def _hold(twists: Array, before: Array, limits: Array, off: NDArray[np.bool_]) -> Array:
    """Keep twists (N, 3) within the limits of the ones before, in place; return by how much they were beyond.

    before (3,) is that before the first; off tells which are beyond the limits of the ones before as measured.
    """
    beyond = np.zeros(len(twists))
    for k in range(len(twists)):
        if not off[k] and (k == 0 or beyond[k - 1] == 0.0):
            continue
        last = twists[k - 1] if k else before
        slowed = last * np.clip(twists[k] @ last / max(float(last @ last), 1e-12), 0.0, 1.0)
        difference = twists[k] - slowed
        size = float(np.linalg.norm(difference))
        if size > limits[k]:
            beyond[k] = size - limits[k]
            twists[k] = slowed + difference * (limits[k] / size)
    return beyond


@dataclass(frozen=True)
class Break:
    """A jump or a hole of odometry."""

    after_ns: int
    """Stamp of the last pose before it."""
    seconds: float
    """Between the poses at its ends."""
    hole: bool
    angle: float
    """rad of it that are not believed"""
    distance: float
    """and m."""

    @property
    def text(self) -> str:
        """What it is, in words."""
        jumped = f"{self.distance:.2f} m and {np.degrees(self.angle):.0f} deg"
        if not self.hole:
            return f"a jump of {jumped}"
        off = self.angle > _TOLD[0] or self.distance > _TOLD[1]
        return f"a hole of {self.seconds:.1f} s" + (f" with a jump of {jumped} in it" if off else "")


def odometry_breaks(T_odom_cam: Trajectory, expected: Expected) -> list[Break]:
    """Return the holes of more than half a second, and the jumps of more than 5 deg or 5 cm, in order of time."""
    if len(T_odom_cam) < 2:
        return []
    stamps, poses = T_odom_cam.stamps_ns, T_odom_cam.T_world_body
    seconds = np.diff(stamps) * 1e-9
    believed = believed_motion(stamps, local(poses[:-1], poses[1:]) / seconds[:, None], expected)
    holes, off = (believed.holes_s > 0.0) & (seconds > _TOLD_S), believed.taken_off
    return [
        Break(int(stamps[k]), float(seconds[k]), bool(holes[k]), float(off[k, 0]), float(off[k, 1]))
        for k in np.flatnonzero(holes | (off > _TOLD).any(axis=1))
    ]


def hole_between(start_ns: int, end_ns: int, usual_s: float) -> list[Break]:
    """Return the time in which there is no odometry at all as a hole; none where it is short, or odometry that slow."""
    seconds = (end_ns - start_ns) * 1e-9
    return [Break(start_ns, seconds, True, 0.0, 0.0)] if seconds > max(_TOLD_S, _LONG * usual_s) else []
