"""Checks of odometry: jumps and holes of its tracking, and its scale beside the detections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from poet_loc.check.finding import Evidence, Finding
from poet_loc.core.odometry_breaks import Break, Expected, hole_between, odometry_breaks
from poet_loc.core.odometry_scale import odometry_scale
from poet_loc.io.log_folder import Log

EXPECTED = Expected((float(np.radians(0.25)), 0.005), 0.1, (0.5, 0.3))
"""What fusion expects by default, whose options a check knows nothing of; a test holds the two together."""


def check_odometry(log: Log) -> Iterator[Finding]:
    """Yield jumps and holes of T_odom_cam.tum, each kind once with where its worst is, and another scale."""
    breaks = breaks_of(log, EXPECTED)
    jumps, holes = [each for each in breaks if not each.hole], [each for each in breaks if each.hole]
    if jumps:
        what = "the odometry jumps: it relocalised or closed a loop"
        fix = "write the odometry as it was tracked, not as it was corrected; fusion takes such jumps off"
        yield _finding("odometry-jump", what, fix, jumps, max(jumps, key=_size))
    if holes:
        what = "the odometry has holes, begins late or ends early: its tracking was lost"
        fix = "see whether the camera was covered, blurred or too fast; fusion does not know how it moved meanwhile"
        yield _finding("odometry-hole", what, fix, holes, max(holes, key=lambda each: each.seconds))
    yield from check_odometry_scale(log)


def check_odometry_scale(log: Log) -> Iterator[Finding]:
    """Yield odometry whose ways are not as long as the ones by which the detected objects pass."""
    scale = odometry_scale(log.T_odom_cam, log.object_poses.values())
    if scale is None or not scale.contradicts:
        return
    evidence: Evidence = {"factor": scale.factor, "sigma_of_its_logarithm": scale.error, "ways": scale.ways}
    what = f"the odometry's ways are {scale.factor:.3g} times as long as those by which the objects pass"
    fix = f"divide its positions by {scale.factor:.3g} (metres? monocular?); or is it the detections' distances?"
    yield Finding("odometry-scale", "error", "T_odom_cam.tum", what, fix, evidence)


def breaks_of(log: Log, expected: Expected) -> list[Break]:
    """Return the breaks of a log's odometry, with what poses there are before and behind it: it is not known either."""
    odometry, poses = log.T_odom_cam, [*log.object_poses.values(), log.camera_poses]
    if odometry is None or not len(odometry):
        return []
    begin, end = int(odometry.stamps_ns[0]), int(odometry.stamps_ns[-1])
    usual_s = float(np.median(np.diff(odometry.stamps_ns))) * 1e-9 if len(odometry) > 1 else 0.0
    first = min([begin, *(int(each.stamps_ns.min()) for each in poses if each)])
    last = max([end, *(int(each.stamps_ns.max()) for each in poses if each)])
    before, behind = hole_between(first, begin, usual_s), hole_between(end, last, usual_s)
    return [*before, *odometry_breaks(odometry, expected), *behind]


def _size(jump: Break) -> float:
    return jump.distance + jump.angle  # at arm's length


def _finding(check: str, what: str, fix: str, breaks: Sequence[Break], worst: Break) -> Finding:
    evidence: Evidence = {"number": len(breaks), "after_stamp_ns": worst.after_ns, "interval_s": worst.seconds}
    evidence |= {"jump_m": worst.distance, "jump_deg": float(np.degrees(worst.angle))}
    return Finding(check, "warning", "T_odom_cam.tum", what, fix, evidence)
