"""How fusion fares beside the oracle `best` on pieces of real logs: any window, all objects or one, every frame or few.

    python benchmarks/random_windows.py [--windows 400] [--seed 0] [--motion auto imu odometry constant-velocity]

Windows of 8 to 45 s of YCB-V's videos, with every, every 3rd, 10th or 15th frame; pooled over the frames that all rows
share. The worst windows are listed: a filter that gross errors led astray shows there.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.options import FuseOptions
from poet_loc.cli.estimates import Fusion, StageOptions, estimate_log
from poet_loc.cli.terminal import Silent, print_tables
from poet_loc.io.log_folder import Log, read_log
from poet_loc.report.summary import to_summary
from poet_loc.report.tables import Column, Table

LOGS = ("0001", "0014", "0017", "0029", "0049", "0050", "0051", "0053", "0054", "0055", "0058", "0059")
FUSIONS: tuple[Fusion, ...] = ("eskf/objects", "graph/objects")
FEWEST_DETECTIONS, WORST = 20, 5

Errors = dict[str, tuple[int, float, float]]
"""Of each estimate: frames, position RMSE (mm), attitude RMSE (deg)."""


@dataclass(frozen=True)
class Window:
    """A piece of a log."""

    log: str
    detections: str
    objects: tuple[int, ...]
    every: int
    start_s: float
    length_s: float


def windows(logs: dict[str, Log], count: int, seed: int) -> Iterator[tuple[Window, Log]]:
    """Yield random pieces that hold detections enough to start from."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        name = str(rng.choice(LOGS))
        detections = str(rng.choice(sorted(logs[name].object_poses)))
        stamps, ids = logs[name].object_poses[detections].stamps_ns, logs[name].object_poses[detections].object_ids
        whole_s = (stamps[-1] - stamps[0]) * 1e-9
        length_s = min(rng.uniform(8.0, 45.0), float(whole_s))
        start_s, every = rng.uniform(0.0, whole_s - length_s), int(rng.choice([1, 1, 3, 10, 15]))
        known = np.unique(ids)
        objects = known if rng.random() < 0.5 else rng.choice(known, 1)
        window = Window(name, detections, tuple(objects.tolist()), every, start_s, length_s)
        piece = cut(logs[name], window)
        if len(piece.object_poses[detections]) >= FEWEST_DETECTIONS:
            yield window, piece


def cut(log: Log, window: Window) -> Log:
    """Return the piece of a log."""
    poses, imu = log.object_poses[window.detections], log.imu
    assert imu is not None
    first = int(poses.stamps_ns[0] + window.start_s * 1e9)
    last = int(first + window.length_s * 1e9)

    def inside(stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray((stamps >= first) & (stamps <= last))

    kept = inside(poses.stamps_ns) & np.isin(poses.object_ids, window.objects) & (poses.frames % window.every == 0)
    paths = {name: getattr(log, name).between(first, last) for name in ("T_world_cam", "T_world_imu", "T_odom_cam")}
    return replace(log, object_poses={window.detections: poses[kept]}, imu=imu[inside(imu.stamps_ns)], **paths)


def evaluated(piece: Log, detections: str, options: FuseOptions) -> Errors | None:
    """Return the errors of every estimate; None where one never started."""
    estimates = estimate_log(piece, detections, StageOptions(fusion=options), Silent(), ("best",), FUSIONS)
    if estimates.evaluation is None:
        return None
    found = {}
    for name, one in to_summary(estimates.evaluation).items():
        shared = one["on_common_frames"]
        position, attitude = shared["position_error_mm"]["norm"]["rmse"], shared["attitude_error_deg"]["angle"]["rmse"]
        if position is not None and attitude is not None:
            found[name] = (shared["frames"], position, attitude)
    return found if len(found) == 1 + len(FUSIONS) else None


def main() -> None:
    """Print, for each motion, every estimate pooled per set of detections, and its worst windows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"))
    parser.add_argument("--windows", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--motion", nargs="+", default=["auto", "imu"])
    asked = parser.parse_args()
    logs = {name: read_log(asked.shared / "ycbv_dope" / name) for name in LOGS}
    for motion in asked.motion:
        rows: list[tuple[Window, Errors]] = []
        unstarted = 0
        for window, piece in windows(logs, asked.windows, asked.seed):
            found = evaluated(piece, window.detections, FuseOptions(motion=motion))
            unstarted += found is None
            rows += [] if found is None else [(window, found)]
        print(f"motion {motion}: {len(rows)} windows, {unstarted} in which an estimate never started")
        print_tables([pooled(rows)])
        print_worst(rows)


def pooled(rows: list[tuple[Window, Errors]]) -> Table:
    """Return the RMSE over the frames of all windows, and the share of windows in which `best` was better."""
    table = []
    for detections in sorted({window.detections for window, _ in rows}):
        own = [found for window, found in rows if window.detections == detections]
        for name in own[0]:
            frames, position, attitude = np.array([found[name] for found in own]).T
            better = np.mean([found["localize/best"][1] < found[name][1] for found in own])
            errors = (np.sqrt(frames @ each**2 / frames.sum()) for each in (position, attitude))
            table.append((detections, name, str(len(own)), *(f"{each:.1f}" for each in errors), f"{100 * better:.0f}"))
    columns = (
        Column("detections"),
        Column("estimate"),
        Column("windows"),
        Column("position", "RMSE", "mm"),
        Column("attitude", "RMSE", "deg"),
        Column("best was better", unit="%"),
    )
    return Table("Pooled over windows", columns, tuple(table))


def print_worst(rows: list[tuple[Window, Errors]]) -> None:
    """Print where each estimate is the furthest off beside `best`."""
    for name in (f"fuse/{fusion}" for fusion in FUSIONS):
        rows.sort(key=lambda row: row[1]["localize/best"][1] - row[1][name][1])
        for window, found in rows[:WORST]:
            print(f"{name} {found[name][1]:.0f} mm, best {found['localize/best'][1]:.0f} mm: {window}")


if __name__ == "__main__":
    main()
