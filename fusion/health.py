"""How an estimator fares: initialising, tracking, coasting or lost, and what became of each object's poses.

A filter that is fed one sample at a time keeps count as it goes (`place_watch.tally`); of a whole log the same numbers
are read from what the gate wrote.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion.options import FuseOptions, HealthOptions
from fusion.place_watch import RATIO_CAP, RATIO_MEMORY
from poet_loc.core.consistency import chi_square_quantile

if TYPE_CHECKING:
    from fusion.result import FuseResult, GateLog

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Mode = Literal["initialising", "tracking", "coasting", "lost"]
MODES: tuple[Mode, ...] = ("initialising", "tracking", "coasting", "lost")
Key = tuple[int, int]

FEW_USED, WIDENED, LONG_LOST, LONG_MISSED_S, RUNAWAY = 2.0 / 3.0, 1.5, 0.01, 1.0, 100.0
"""What `troubles` tells: a smaller share of poses used, noise taken so many times larger than stated, a larger share of
time lost, poses so long after the end, s, a speed beyond that of any camera that looks at objects, m/s."""


@dataclass(frozen=True)
class ObjectHealth:
    """How the poses of one object, or the camera poses, have fared since the start."""

    poses: int
    """How many met a started filter."""
    position_accepted: float
    """Share, NaN without poses."""
    rotation_accepted: float
    """Share, NaN without poses."""
    test_ratio: float
    """NIS over its limit, mean over about the last 20 poses, each capped at 10; above 1 most are refused, NaN: none."""
    refused_in_a_row: int
    """How many of the last poses were refused."""
    longest_refused: int
    """The longest such row."""
    released: bool
    """Taken to have been moved, or turned where it stands: that part is out of the map now."""


@dataclass(frozen=True)
class RunHealth:
    """How an estimator fared over a whole log."""

    since_ns: Stamps
    """(C,) from when on each mode held; the first is the log's first sample."""
    modes: tuple[Mode, ...]
    """(C,)"""
    end_ns: int
    """The newest state."""
    objects: Mapping[Key, ObjectHealth]
    """By (object_id, instance); (-1, 0) for camera poses."""
    released: tuple[tuple[Key, int, int], ...]
    """Who was released from the map (or in rotation only), from the first to the last pose left out for it, ns."""
    restarts: int
    """How often the filter was lost and started again."""
    noise_scale: tuple[float, float]
    """How many times larger than stated the poses' 1-sigma of rotation and of position was taken in the end."""

    def mode_at(self, stamps_ns: Stamps) -> NDArray[np.str_]:
        """Return the mode at each of N stamps."""
        at = np.searchsorted(self.since_ns, np.asarray(stamps_ns), side="right") - 1
        return np.array(self.modes)[at.clip(min=0)]

    def share(self, mode: Mode) -> float:
        """Return the share of time that a mode held."""
        spans = np.diff(np.append(self.since_ns, self.end_ns)).astype(float)
        held = np.array([each == mode for each in self.modes])
        return float(spans[held].sum() / max(spans.sum(), 1.0))


def mode_of(silent_s: float, position_sigma: float, refused: int, options: HealthOptions) -> Mode:
    """Return the mode of a filter that has started.

    silent_s since a pose was accepted, the position's largest 1-sigma (m), poses refused in a row since then.
    """
    if silent_s <= options.coasting_after_s:
        return "tracking"
    lost = position_sigma > options.lost_sigma or refused >= options.lost_refused
    return "lost" if lost else "coasting"


def run_health(result: FuseResult, options: FuseOptions, begin_ns: int) -> RunHealth:
    """Return how an estimator fared over a log whose motion begins at begin_ns."""
    gate, limit = result.gate, float(chi_square_quantile(options.gate.probability, 6))
    started = (gate.stamps_ns > result.stamps_ns[0]) & (gate.stamps_ns <= result.stamps_ns[-1])
    waited = started & np.isnan(gate.nis)  # the filter had given up: such a pose was asked nothing but where to start
    gone = result.stamps_ns[np.searchsorted(result.stamps_ns, np.unique(gate.stamps_ns[waited])) - 1] + 1
    since, which = np.r_[begin_ns, result.stamps_ns, gone], np.r_[0, _modes(result, options.health), 0 * gone]
    order = np.argsort(since, kind="stable")
    since, which = since[order], which[order]
    changes = np.flatnonzero(np.diff(which, prepend=-1))
    since, modes, started = since[changes], tuple(MODES[i] for i in which[changes]), started & ~waited
    if since[1:2] == since[:1]:  # it started at the first sample
        since, modes = since[1:], modes[1:]
    keys = np.stack([gate.object_ids, gate.instances], axis=1)
    objects, released = {}, []
    for key in sorted({(int(i), int(k)) for i, k in keys}):
        own = np.flatnonzero((keys == key).all(axis=1) & started)
        objects[key] = _object(gate, own, limit)
        released += [(key, int(gate.stamps_ns[a]), int(gate.stamps_ns[b])) for a, b in _runs(gate.released[own], own)]
    end = int(result.stamps_ns[-1])
    return RunHealth(since, modes, end, objects, tuple(released), result.restarts, result.noise_scale)


def _modes(result: FuseResult, options: HealthOptions) -> NDArray[np.int64]:
    """Return the mode of every row as its place in MODES."""
    gate, stamps = result.gate, result.stamps_ns
    frames, first = np.unique(gate.stamps_ns, return_index=True)
    used = gate.position_accepted | gate.rotation_accepted
    accepted = np.logical_or.reduceat(used, first) if len(first) else np.zeros(0, dtype=bool)
    refusals = np.add.reduceat(~used & ~gate.released, first) if len(first) else np.zeros(0, dtype=np.int64)
    met = (frames > stamps[0]) & (frames <= stamps[-1])
    frames, accepted, refusals = frames[met], accepted[met], refusals[met]
    total = np.cumsum(refusals * ~accepted)
    row = total - np.maximum.accumulate(np.where(accepted, total, 0)) if len(frames) else total
    at = np.searchsorted(frames, stamps, side="right") - 1
    last = np.maximum.accumulate(np.r_[stamps[0], np.where(accepted, frames, 0)])[at + 1]
    coasting = (stamps - last) * 1e-9 > options.coasting_after_s
    refused = np.r_[0, row][at + 1] >= options.lost_refused
    lost = coasting & (refused | (result.sigmas[:, 3:6].max(axis=1) > options.lost_sigma))
    return np.asarray(1 + coasting + lost, dtype=np.int64)


def _object(gate: GateLog, own: NDArray[np.int64], limit: float) -> ObjectHealth:
    if not len(own):
        return ObjectHealth(0, math.nan, math.nan, math.nan, 0, 0, False)
    used = gate.position_accepted[own] | gate.rotation_accepted[own]
    longest = max((b - a + 1 for a, b in _runs(~used, np.arange(len(own)))), default=0)
    return ObjectHealth(
        len(own),
        float(gate.position_accepted[own].mean()),
        float(gate.rotation_accepted[own].mean()),
        _recent_ratio(gate.nis[own] / limit),
        int(len(own) if not used.any() else np.argmax(used[::-1])),
        int(longest),
        bool(gate.released[own[-1]]),
    )


def _recent_ratio(ratios: Array) -> float:
    mean = math.nan
    for count, ratio in enumerate(np.minimum(ratios[np.isfinite(ratios)], RATIO_CAP), start=1):
        mean = ratio if count == 1 else mean + (ratio - mean) / min(count, RATIO_MEMORY)
    return float(mean)


def _runs(mask: NDArray[np.bool_], places: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return first and last of the places of each run of a mask."""
    edges = np.diff(np.r_[0, mask.astype(np.int8), 0])
    ends = np.flatnonzero(edges < 0) - 1
    return [(int(places[a]), int(places[b])) for a, b in zip(np.flatnonzero(edges > 0), ends)]


def troubles(result: FuseResult) -> list[str]:
    """Return what a user should know of a run that may have followed wrong poses or ended early; mostly nothing."""
    found: list[str] = []
    health = result.health
    if health is None:
        return found
    moved = {key for key, _, _ in health.released}
    met = [each for key, each in health.objects.items() if each.poses and key not in moved]
    poses = sum(each.poses for each in met)
    used = sum(each.poses * each.position_accepted for each in met) / max(poses, 1)
    if poses and used < FEW_USED:
        found.append(f"used {100.0 * used:.0f} % of the poses")
    if health.restarts:
        found.append(f"started again {health.restarts} times" if health.restarts > 1 else "started again once")
    if max(health.noise_scale) > WIDENED:
        turn, place = health.noise_scale
        found.append(f"took the 1-sigma of the poses {turn:.1f} (rotation) and {place:.1f} (position) times larger")
    fastest = float(np.abs(result.velocity).max(initial=0.0))
    if not fastest <= RUNAWAY:
        found.append(f"ran away: its speed reached {fastest:.0g} m/s")
    if health.share("lost") > LONG_LOST:
        found.append(f"was lost for {100.0 * health.share('lost'):.0f} % of the time")
    missed_s = float(result.gate.stamps_ns[-1] - result.stamps_ns[-1]) * 1e-9 if len(result.gate) else 0.0
    if missed_s > LONG_MISSED_S:
        found.append(f"ends {missed_s:.1f} s before the last pose, where its {result.motion} ends")
    return found


def as_plain(health: RunHealth) -> dict[str, Any]:
    """Return what health.json holds: numbers, names and lists; NaN becomes null."""
    return {
        "modes": [{"since_ns": int(s), "mode": mode} for s, mode in zip(health.since_ns, health.modes)],
        "end_ns": health.end_ns,
        "share_of_time": {mode: round(health.share(mode), 6) for mode in MODES},
        "restarts": health.restarts,
        "noise_scale": dict(zip(("rotation", "position"), map(_number, health.noise_scale))),
        "objects": [_plain_object(key, each) for key, each in health.objects.items()],
        "released": [
            {"object_id": key[0], "instance": key[1], "from_ns": first, "to_ns": last}
            for key, first, last in health.released
        ],
    }


def _plain_object(key: Key, health: ObjectHealth) -> dict[str, Any]:
    values = {name: _number(value) for name, value in vars(health).items()}
    return {"object_id": key[0], "instance": key[1], **values}


def _number(value: Any) -> Any:
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, 6)
    return value
