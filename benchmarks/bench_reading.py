"""Reading 200,000 rows: our readers beside the csv module row by row, as a ratio inside one run."""

from __future__ import annotations

import csv
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.records import ImuSamples, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.imu_csv import read_imu, write_imu
from poet_loc.io.object_poses_csv import read_object_poses, write_object_poses
from poet_loc.io.tum import read_tum, write_tum

ROWS = 200_000


def row_by_row(path: Path, delimiter: str = ",") -> list[list[float]]:
    """Parse each cell as a float: less than our readers do, and stamps lose their last digits."""
    with open(path) as file:
        reader = csv.reader(file, delimiter=delimiter)
        if delimiter == ",":
            next(reader)
        return [[float(cell) for cell in row] for row in reader]


def seconds(read: Callable[[Path], object], path: Path) -> float:
    times = []
    for _ in range(3):
        start = time.process_time()
        read(path)
        times.append(time.process_time() - start)
    return min(times)


def write_files(folder: Path) -> None:
    rng = np.random.default_rng(0)
    stamps = 1403715273262142977 + np.arange(ROWS) * 5_000_000
    q_xyzw = rng.normal(size=(ROWS, 4))
    T = pose_from_quaternion(rng.normal(size=(ROWS, 3)), q_xyzw / np.linalg.norm(q_xyzw, axis=1)[:, None])
    factors = rng.normal(size=(ROWS, 6, 6)) * 0.1
    covariances = factors @ factors.transpose(0, 2, 1) + 1e-3 * np.eye(6)
    frames, ids = np.arange(ROWS) // 5, np.arange(ROWS) % 5
    poses = ObjectPoses(stamps[frames], frames, ids, 0 * ids, np.ones(ROWS), T)
    write_imu(folder / "imu.csv", ImuSamples(stamps, rng.normal(size=(ROWS, 3)), rng.normal(size=(ROWS, 3))))
    write_object_poses(folder / "object_poses.csv", poses)
    with_covariances = ObjectPoses(*[*vars(poses).values()][:-1], covariances)
    write_object_poses(folder / "object_poses_with_covariances.csv", with_covariances)
    write_tum(folder / "T_world_imu.tum", Trajectory(stamps, T))


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files(folder)
        readers = {
            "imu.csv": read_imu,
            "object_poses.csv": read_object_poses,
            "object_poses_with_covariances.csv": read_object_poses,
            "T_world_imu.tum": read_tum,
        }
        print(f"{ROWS} rows, CPU time, best of three; how many times faster than the csv module with float() per cell")
        for file, read in readers.items():
            ours = seconds(read, folder / file)
            peer = seconds(lambda path: row_by_row(path, " " if path.suffix == ".tum" else ","), folder / file)
            print(f"{file:36} ours {ours:5.2f} s   row by row {peer:5.2f} s   {peer / ours:4.1f} x")


if __name__ == "__main__":
    main()
