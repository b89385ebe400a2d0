"""The doctor: reads a log as far as it can be read, runs every check, and writes a corrected copy."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from poet_loc.check.covariances import check_covariances
from poet_loc.check.finding import Finding
from poet_loc.check.gravity import check_gravity
from poet_loc.check.noise import check_noise
from poet_loc.check.objects import (
    check_ground_truth,
    check_in_front,
    check_landmarks,
    check_rotations_against_map,
    check_unknown_objects,
)
from poet_loc.check.odometry import check_odometry
from poet_loc.check.reading import read_what_there_is
from poet_loc.check.stamps import check_imu_covers, check_rate, check_spans, check_stamps
from poet_loc.check.turns import check_turns, unreadable_calibration
from poet_loc.check.units import check_accelerometer, check_gyroscope, check_lengths
from poet_loc.core.records import Calibration
from poet_loc.io.log_folder import Log, object_poses_file, write_log
from poet_loc.io.whole_folder import whole_folder

Check = Callable[[Log], Iterator[Finding]]

CHECKS: tuple[Check, ...] = (
    check_stamps,
    check_rate,
    check_spans,
    check_imu_covers,
    check_unknown_objects,
    check_rotations_against_map,
    check_in_front,
    check_lengths,
    check_accelerometer,
    check_gyroscope,
    check_turns,
    check_ground_truth,
    check_gravity,
    check_landmarks,
    check_covariances,
    check_noise,
    check_odometry,
)
"""In this order: each sees the log as the repairs of those before it leave it."""


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a log, and the log without what could safely be repaired."""

    findings: tuple[Finding, ...]
    repaired: Log

    @property
    def healthy(self) -> bool:
        """Whether nothing was found."""
        return not self.findings


def diagnose(path: str | Path) -> Diagnosis:
    """Return everything that looks wrong in a log folder.  Raises InputError where the path is no folder."""
    log, found = read_what_there_is(Path(path))
    found += _missing(log)
    for check in CHECKS:
        for finding in check(log):
            found.append(finding)
            if finding.repair is not None:
                log = finding.repair(log)
    return Diagnosis(tuple(found), log)


def write_repaired(diagnosis: Diagnosis, out: str | Path, overwrite: bool = False) -> None:
    """Write a corrected copy of a log folder; files that are not the log's own are copied as they are."""
    log = diagnosis.repaired
    with whole_folder(out, overwrite, [log.path]) as folder:
        shutil.copytree(log.path, folder, dirs_exist_ok=True)
        write_log(folder, replace(log, path=folder))


def _missing(log: Log) -> list[Finding]:
    return [*_nothing_seen(log), *_uncalibrated(log)]


def _nothing_seen(log: Log) -> Iterator[Finding]:
    if (log.path / "camera_poses.csv").exists() or (log.object_poses and log.landmark_map is not None):
        return
    file = "landmarks.json" if log.object_poses else object_poses_file("")
    if not (log.path / file).exists():  # one that cannot be read is told already
        fix = "a log holds object_poses.csv with landmarks.json, or camera_poses.csv"
        fix += "; fuse --estimate.map unknown makes a map" if log.object_poses else ""
        yield Finding("missing", "error", file, "is not there: nothing can be localised", fix)


def _uncalibrated(log: Log) -> Iterator[Finding]:
    if log.imu is None or unreadable_calibration(log):
        return
    known = log.calibration or Calibration()
    keys = {"cam0: T_cam_imu": known.T_cam_imu, "imu0: its noise densities": known.imu}
    lacking = ", ".join(key for key, value in keys.items() if value is None)
    if lacking:
        fix = "add them as Kalibr's camchain and imu.yaml have them (docs/formats.md)"
        yield Finding("missing", "error", "calibration.yaml", f"the IMU cannot be fused without {lacking}", fix)
