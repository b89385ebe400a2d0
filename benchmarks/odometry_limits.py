"""What real detections hold where odometry alone carries the camera: the filter beside oracles that know the truth.

    python benchmarks/odometry_limits.py [--shared DATA]

YCB-V's test videos, pooled at the stamps of the ground truth from the first estimate on. The last two rows are no
filter: they have exact motion, so nothing but detections between them and the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.fit_noise import FitNoiseOptions, is_good, object_errors
from fusion.fuse import fuse
from fusion.options import FuseOptions, Odometry
from poet_loc.cli.terminal import print_tables
from poet_loc.io.log_folder import Log, read_log
from poet_loc.report.tables import Column, Table

Array = NDArray[np.float64]
TEST_LOGS = ("0049", "0050", "0051", "0053", "0054", "0055", "0058", "0059")
BY_ODOMETRY = FuseOptions(motion="odometry")
MIN_DETECTIONS = 10


def good_errors(log: Log, detections: str) -> Iterator[tuple[int, NDArray[np.int64], Array]]:
    """Yield id, stamps and errors (N, 6) of each object where they are no gross ones."""
    for object_id, stamps, error in object_errors(log, log.detections(detections)[1]):
        keep = is_good(error, FitNoiseOptions())
        if np.count_nonzero(keep) >= MIN_DETECTIONS:
            yield object_id, stamps[keep], error[keep]


def filtered(log: Log, detections: str, options: FuseOptions = BY_ODOMETRY) -> tuple[Array, Array]:
    """Return the filter's errors at the true stamps: distances (m) and angles (rad)."""
    assert log.T_world_imu is not None
    result = fuse(log, options, object_poses=log.object_poses[detections])
    found, valid = result.trajectory.interpolate(log.T_world_imu.stamps_ns)
    true = log.T_world_imu.T_world_body[valid]
    gap = np.linalg.norm(found[valid].translation - true.translation, axis=1)
    return gap, (true.rotation.inv() * found[valid].rotation).magnitude()


def exact_odometry(log: Log, detections: str) -> tuple[Array, Array]:
    """Return them with the truth in the place of the odometry, and a filter that is told so."""
    told = replace(BY_ODOMETRY, odometry=Odometry(rotation_walk_deg=0.01, translation_walk=0.0002))
    return filtered(replace(log, T_odom_cam=log.T_world_cam), detections, told)


def without_means(log: Log, detections: str) -> tuple[Array, Array]:
    """Return them with each object's mean error in this very video taken off."""
    means = []
    for object_id, _, errors in good_errors(log, detections):
        mean = errors.mean(axis=0)
        means.append((object_id, *np.degrees(mean[:3]).tolist(), *mean[3:].tolist()))
    bias = replace(BY_ODOMETRY.bias, means=tuple(means))
    return filtered(log, detections, replace(BY_ODOMETRY, bias=bias))


def smoothed(log: Log, detections: str) -> tuple[Array, Array]:
    """Return them of the smoother, which knows the whole video."""
    return filtered(log, detections, replace(BY_ODOMETRY, smooth=True))


def only_means(log: Log, detections: str) -> tuple[Array, Array]:
    """Return the angles of an estimate with no other error than the mean one of the objects in view."""
    seen: dict[int, list[Array]] = {}
    for _, stamps, errors in good_errors(log, detections):
        for stamp in stamps.tolist():
            seen.setdefault(stamp, []).append(errors[:, :3].mean(axis=0))
    return np.empty(0), np.array([np.linalg.norm(np.mean(each, axis=0)) for each in seen.values()])


def running_mean(log: Log, detections: str) -> tuple[Array, Array]:
    """Return the angles of the mean of all good detections so far, of the object with which it is better at the end."""
    assert log.T_world_cam is not None
    stamps, of_objects = log.T_world_cam.stamps_ns, []
    for _, seen, errors in good_errors(log, detections):
        here = log.T_world_cam.T_world_body.rotation[np.searchsorted(stamps, seen).clip(max=len(stamps) - 1)]
        in_world = here.apply(errors[:, :3])
        so_far = np.cumsum(in_world, axis=0) / np.arange(1, len(seen) + 1)[:, None]
        last = np.searchsorted(seen, stamps, side="right") - 1
        of_objects.append(np.linalg.norm(so_far[last[last >= 0]], axis=1))
    return np.empty(0), min(of_objects, key=lambda angles: float(np.mean(angles**2)))


ROWS: dict[str, Callable[[Log, str], tuple[Array, Array]]] = {
    "filter": filtered,
    "smoothed": smoothed,
    "filter, odometry without drift": exact_odometry,
    "filter, objects' mean errors off": without_means,
    "exact motion, mean errors of the objects in view": only_means,
    "exact motion, running mean of the better object": running_mean,
}


def rms(errors: list[Array], scale: float) -> str:
    pooled = np.concatenate(errors)
    return f"{scale * np.sqrt(np.mean(pooled**2)):.2f}" if len(pooled) else "–"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"))
    shared = parser.parse_args().shared
    logs, rows = [read_log(shared / "ycbv_dope" / name) for name in TEST_LOGS], []
    for detections in ("selftrained", "supervised"):
        for name, errors_of in ROWS.items():
            gaps, angles = zip(*(errors_of(log, detections) for log in logs), strict=True)
            rows.append((detections, name, rms(list(gaps), 1e3), rms(list(angles), 180.0 / np.pi)))
    columns = (
        Column("detections"),
        Column("estimate"),
        Column("position", "RMSE", "mm"),
        Column("attitude", "RMSE", "deg"),
    )
    print_tables([Table("Odometry alone", columns, tuple(rows))])


if __name__ == "__main__":
    main()
