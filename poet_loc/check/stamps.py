"""Checks of the clocks alone: rates, gaps, jitter, units of the stamps and the common span."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from poet_loc.check.finding import Evidence, Finding
from poet_loc.check.streams import Stream, streams_of, with_stamps
from poet_loc.core.stamp_unit import FASTEST_CAMERA_HZ, FASTEST_IMU_HZ
from poet_loc.io.log_folder import Log, object_poses_file

_SLOWEST_HZ = 0.02
_GAP_IMU_INTERVALS, _GAP_IMU_S, _GAP_CAMERA_S = 5.0, 0.04, 8.0
_JITTER_SHARE = 0.25  # of the median interval, typical deviation
_RATE_TOLERANCE = 0.1
_SHORT_OVERLAP = 0.2
_COVERED_BY_IMU = 0.9
_UNITS_NS = {"microseconds": 1_000, "milliseconds": 1_000_000, "seconds": 1_000_000_000}


def check_stamps(log: Log) -> Iterator[Finding]:
    """Yield what is wrong with the stamps of each stream."""
    for stream in streams_of(log):
        if len(stream.stamps_ns) >= 3:
            wrong_unit = list(_unit(stream))
            yield from wrong_unit
            if not wrong_unit:
                yield from _gaps(stream)
                yield from _jitter(stream)


def _unit(stream: Stream) -> Iterator[Finding]:
    rate = 1.0 / float(np.median(stream.intervals_s))
    fastest = FASTEST_IMU_HZ if stream.on_imu_clock else FASTEST_CAMERA_HZ
    if _SLOWEST_HZ <= rate <= fastest:
        return
    unit = next((name for name, ns in _UNITS_NS.items() if 1.0 <= rate / ns <= 1500.0), None)
    what = f"the stamps say {rate:.3g} Hz" + (f": they look like {unit}" if unit else "")
    evidence: Evidence = {"median_interval_s": float(np.median(stream.intervals_s)), "rate_hz": rate}
    fix = "write stamps in whole nanoseconds"
    repair = None
    if unit and stream.stamps_ns[-1] < np.iinfo(np.int64).max // _UNITS_NS[unit]:
        repair = partial(with_stamps, file=stream.file, change=lambda stamps: stamps * _UNITS_NS[unit])
    yield Finding("stamp-unit", "error", stream.file, what, fix, evidence, repair)


def _gaps(stream: Stream) -> Iterator[Finding]:
    median = float(np.median(stream.intervals_s))
    limit = max(_GAP_IMU_INTERVALS * median, _GAP_IMU_S) if stream.regular else max(_GAP_CAMERA_S, 20.0 * median)
    long = np.flatnonzero(stream.intervals_s > limit)
    if not long.size:
        return
    widest = int(long[np.argmax(stream.intervals_s[long])])
    evidence: Evidence = {
        "gaps": len(long),
        "longest_gap_s": float(stream.intervals_s[widest]),
        "after_stamp_ns": int(stream.stamps_ns[widest]),
        "missing_s": float(stream.intervals_s[long].sum()),
        "median_interval_s": median,
    }
    if stream.regular:
        fix = "record without drops (buffers, USB load); a filter drifts blindly over such a gap: cut the log there"
        yield Finding("gap", "error", stream.file, "samples are missing", fix, evidence)
    else:
        fix = "see whether the sensor saw nothing or frames were dropped; the estimate drifts meanwhile"
        yield Finding("gap", "warning", stream.file, "nothing was seen for a long time", fix, evidence)


def _jitter(stream: Stream) -> Iterator[Finding]:
    """Deviation from the median, of intervals that are no gaps; a camera that skips frames shows whole multiples."""
    intervals = stream.intervals_s
    median = float(np.median(intervals))
    multiples = np.maximum(np.round(intervals / median), 1.0)
    deviation = np.abs(intervals - multiples * median) / median
    share = float(np.percentile(deviation[multiples < 5], 90))
    if not stream.regular or share < _JITTER_SHARE:
        return
    evidence: Evidence = {"median_interval_s": median, "jitter_p90_s": share * median, "jitter_share_p90": share}
    what = "the intervals scatter: the stamps look like times of receipt, not of measurement"
    fix = "use the stamps of the sensor (header stamps of a bag), or a driver that stamps in hardware"
    yield Finding("jitter", "warning", stream.file, what, fix, evidence)


def check_rate(log: Log) -> Iterator[Finding]:
    """Yield an update_rate that is not the IMU's."""
    if log.imu is None or len(log.imu) < 3 or log.calibration is None or log.calibration.imu is None:
        return
    intervals = np.diff(log.imu.stamps_ns) / 1e9
    measured = 1.0 / float(intervals[intervals < 5.0 * np.median(intervals)].mean())
    stated = log.calibration.imu.update_rate
    if abs(measured / stated - 1.0) > _RATE_TOLERANCE:
        evidence: Evidence = {"measured_hz": measured, "stated_hz": stated}
        what = "update_rate in calibration.yaml is not the rate of imu.csv"
        fix = "correct update_rate; noise densities that were converted with the wrong rate are wrong too"
        yield Finding("rate", "warning", "calibration.yaml", what, fix, evidence)


def check_spans(log: Log) -> Iterator[Finding]:
    """Yield streams that have no time, or little of it, in common with the others."""
    shift_ns = log.timeshift_ns
    spans = []
    for stream in streams_of(log):
        shift = shift_ns if stream.on_imu_clock else 0
        spans.append((stream.file, int(stream.stamps_ns[0]) - shift, int(stream.stamps_ns[-1]) - shift))
    for index, (file, start, end) in enumerate(spans):
        for other, other_start, other_end in spans[:index]:
            common = min(end, other_end) - max(start, other_start)
            shorter = min(end - start, other_end - other_start)
            if common >= _SHORT_OVERLAP * shorter and (common > 0 or shorter == 0):
                continue
            evidence: Evidence = {
                "common_s": max(common, 0) / 1e9,
                "start_s": start / 1e9,
                "end_s": end / 1e9,
                "other": other,
                "other_start_s": other_start / 1e9,
                "other_end_s": other_end / 1e9,
            }
            how = "no time" if common < 0 else "little time"
            what, fix = f"has {how} in common with {other}", "bring all stamps to one clock, in nanoseconds"
            yield Finding("span", "error" if common < 0 else "warning", file, what, fix, evidence)


def check_imu_covers(log: Log) -> Iterator[Finding]:
    """Yield an IMU that was not there for a part of what the camera saw: nothing is fused of that."""
    if log.imu is None or not len(log.imu):
        return
    shift_ns = log.timeshift_ns
    begin, end = int(log.imu.stamps_ns[0]), int(log.imu.stamps_ns[-1])
    poses = {object_poses_file(name): each for name, each in log.object_poses.items()}
    for file, each in (poses | {"camera_poses.csv": log.camera_poses}).items():
        if each is None or not len(each):
            continue
        seen = each.stamps_ns + shift_ns
        covered = float(np.mean((seen >= begin) & (seen <= end)))
        if 0.0 < covered < _COVERED_BY_IMU:  # none at all: check_spans
            evidence: Evidence = {"covered_share": covered, "imu_span_s": (end - begin) * 1e-9}
            fix = (
                "record both for as long; what is outside is not fused (--fusion.motion constant-velocity needs no IMU)"
            )
            yield Finding("imu-span", "warning", "imu.csv", f"covers {covered:.0%} of {file}", fix, evidence)
