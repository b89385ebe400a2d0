"""Checks of odometry alone: jumps and holes of its tracking."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from poet_loc.check.finding import Evidence, Finding
from poet_loc.core.odometry_breaks import Break, Expected, odometry_breaks
from poet_loc.io.log_folder import Log

EXPECTED = Expected((float(np.radians(0.25)), 0.005), 0.1, (0.5, 0.3))
"""What fusion expects by default, whose options a check knows nothing of; a test holds the two together."""


def check_odometry(log: Log) -> Iterator[Finding]:
    """Yield jumps and holes of T_odom_cam.tum, each kind once with where its worst is."""
    if log.T_odom_cam is None:
        return
    breaks = odometry_breaks(log.T_odom_cam, EXPECTED)
    jumps, holes = [each for each in breaks if not each.hole], [each for each in breaks if each.hole]
    if jumps:
        what = "the odometry jumps: it relocalised or closed a loop"
        fix = "write the odometry as it was tracked, not as it was corrected; fusion takes such jumps off"
        yield _finding("odometry-jump", what, fix, jumps, max(jumps, key=_size))
    if holes:
        what = "the odometry has holes: its tracking was lost"
        fix = "see whether the camera was covered, blurred or too fast; fusion does not know how it moved meanwhile"
        yield _finding("odometry-hole", what, fix, holes, max(holes, key=lambda each: each.seconds))


def _size(jump: Break) -> float:
    return jump.distance + jump.angle  # at arm's length


def _finding(check: str, what: str, fix: str, breaks: Sequence[Break], worst: Break) -> Finding:
    evidence: Evidence = {"number": len(breaks), "after_stamp_ns": worst.after_ns, "interval_s": worst.seconds}
    evidence |= {"jump_m": worst.distance, "jump_deg": float(np.degrees(worst.angle))}
    return Finding(check, "warning", "T_odom_cam.tum", what, fix, evidence)
