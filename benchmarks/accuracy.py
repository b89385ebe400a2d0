"""The accuracy tables of the documentation: each prints the commands that make it, then what they print.

    python benchmarks/accuracy.py [white network stated real odometry fitted euroc calibration map]
        [--runs 50] [--shared DATA]

Simulated tables need nothing else; `real`, `odometry`, `fitted`, `euroc`, half of `calibration` need reference logs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.calibrated import Calibrated
from fusion.fit_noise import fit_noise
from fusion.fuse import fuse
from fusion.options import DetectionBias, DetectionNoise, Estimate, FuseOptions, Gate
from fusion.result import FuseResult
from fusion.simulate import SimulationOptions, simulate
from poet_loc.cli.main import main as poet_loc
from poet_loc.cli.terminal import print_tables
from poet_loc.core.consistency import pose_nees
from poet_loc.core.records import Calibration
from poet_loc.io.log_folder import Log, read_log
from poet_loc.report.tables import Column, Table

TEST_LOGS = ("0049", "0050", "0051", "0053", "0054", "0055", "0058", "0059")
"""YCB-V's official test videos; the defaults were chosen on the training videos."""
TRAINING_LOGS = ("0001", "0014", "0017", "0029")
TWO_OBJECTS = ("0049", "0054", "0059")
FUSIONS = ("eskf/camera", "eskf/objects", "eskf-smoothed/objects", "graph/objects")
WRONG_OFFSET_S = 0.05
WRONG_EXTRINSICS = RigidTransform.from_components([0.03, 0.0, 0.0], Rotation.from_rotvec([0.0, 3.0, 0.0], degrees=True))


def white(asked: argparse.Namespace) -> None:
    """Camera poses with white noise: the default filter beside the optimal one, and the smoothers."""
    log = ["--noise", "white", "--camera-poses", "--duration-s", "120", "--runs", str(min(asked.runs, 10))]
    both = ["simulate", *log, "--modes", "best"]
    command(*both, "--fusions", "eskf/camera", "eskf-smoothed/camera", "batch/camera")
    print("The optimal filter: the true noise, no gate.")
    command(*both, "--fusions", "eskf/camera", "--options.fusion.gate.probability", "1")


def network(asked: argparse.Namespace) -> None:
    """Network-like noise over many seeds: loose and tight coupling, filter and graph, beside the solver."""
    command("simulate", "--runs", str(asked.runs), "--fusions", *FUSIONS)


def stated(asked: argparse.Namespace) -> None:
    """Poses that state less than their errors: believed as stated, and widened as their innovations say."""
    columns = [Column("poses"), Column("stated 1-sigma over the true"), Column("estimate")]
    for way in ("Believed", "Widened (default)"):
        columns += [Column("RMSE", way, "mm"), Column("NEES/dof", way)]
    rows = []
    for noise, poses in (("network", "objects"), ("white", "objects"), ("white", "camera")):
        for share in (0.25, 0.5, 1.0):
            for estimator in ("eskf", "graph"):
                told: list[str] = []
                for adaptation in (0.0, Gate().adaptation):
                    options = FuseOptions(estimator, measurements=poses, gate=Gate(adaptation=adaptation))
                    told += of_stated(noise, share, options, min(asked.runs, 10))
                rows.append((f"{poses}, {noise}", f"{share:g}", f"fuse/{estimator}/{poses}", *told))
    print_tables([Table("Overstated poses", tuple(columns), tuple(rows), notes=("10 simulated logs of 60 s a row.",))])


def of_stated(noise: Literal["network", "white"], share: float, options: FuseOptions, runs: int) -> tuple[str, str]:
    """Return RMSE, mm, and NEES/dof over logs whose poses state this share of their 1-sigma."""
    found = []
    for seed in range(runs):
        log = simulate(
            SimulationOptions(
                noise=noise,
                objects=4,
                symmetric_objects=0,
                covariances=True,
                camera_poses=options.measurements == "camera",
                stated_share=share,
                seed=seed,
            )
        )
        found.append(errors(fuse(log, options), log))
    squares, nees = np.mean(found, axis=0)
    return f"{1e3 * np.sqrt(squares):.1f}", f"{nees:.2f}"


def real(asked: argparse.Namespace) -> None:
    """YCB-V's test videos with real detections, each set pooled, then the videos with two objects alone."""
    for logs in (TEST_LOGS, TWO_OBJECTS):
        table_of(asked, logs, "--fusions", *FUSIONS)


def odometry(asked: argparse.Namespace) -> None:
    """The same with the real visual odometry as the source of motion."""
    table_of(asked, TEST_LOGS, "--fusions", "eskf/objects", "graph/objects", "--fusion.motion", "odometry")


def fitted(asked: argparse.Namespace) -> None:
    """Each network's own noise and mean errors, as fit-noise finds them on the training videos, on the test videos."""
    training = [str(asked.shared / "ycbv_dope" / log) for log in TRAINING_LOGS]
    with tempfile.TemporaryDirectory() as folder:
        for name in ("selftrained", "supervised", "synthetic"):
            file = str(Path(folder) / f"{name}.yaml")
            command("fit-noise", *training, "--detections", name, "--out", file)
            from_it = ("--detections", name, "--modes", "best", "--noise-from", file)
            for motion in ("imu+odometry", "odometry"):
                table_of(
                    asked, TEST_LOGS, *from_it, "--fusions", "eskf/objects", "graph/objects", "--fusion.motion", motion
                )


def euroc(asked: argparse.Namespace) -> None:
    """A real IMU, with the noise that its samples show in flight and with what its data sheet says."""
    log = str(asked.shared / "euroc_v101")
    for noise in ([], ["--fusion.imu.no-measured"]):
        command(
            "table", log, "--modes", "best", "robust", "--with-fusion", "--fusions", *FUSIONS, "batch/objects", *noise
        )


def calibration_(asked: argparse.Namespace) -> None:
    """A wrong time offset and wrong extrinsics: what is left of them at the end."""
    logs = {"simulated": simulate(SimulationOptions(noise="white"))}
    if (asked.shared / "euroc_v101").is_dir():
        logs["euroc"] = read_log(asked.shared / "euroc_v101")
    rows = [row for name, log in logs.items() for row in calibration_rows(name, log)]
    columns = [Column("log"), Column("wrong by"), Column("left"), Column("left after a second pass"), Column("1-sigma")]
    print_tables([Table("Self-calibration", tuple(columns), tuple(rows))])


def map_(asked: argparse.Namespace) -> None:
    """Unknown maps: the first object anchors the world, the others are found."""
    columns = [Column("estimator"), Column("noise"), Column("objects")]
    columns += [Column("RMSE", "Trajectory", "mm"), Column("NEES/dof", "Trajectory")]
    columns += [Column("position", "Map at the end", "mm"), Column("rotation", "Map at the end", "deg")]
    noises = ("white", "white, no biases", "network", "network, fitted")
    kinds = [(noise, objects) for noise in noises for objects in (1, 2, 4, 8)]
    rows = [unknown_map(estimator, *kind, asked.runs) for kind in kinds for estimator in ("eskf", "graph")]
    note = (
        f"{asked.runs} simulated logs of 60 s a row; RMSE of the map over its objects but the first. "
        "No biases: --bias.no-use. Fitted: the noise is what fit-noise finds in other such logs."
    )
    print_tables([Table("Unknown maps", tuple(columns), tuple(rows), notes=(note,))])


def unknown_map(estimator: Literal["eskf", "graph"], noise: str, objects: int, runs: int) -> tuple[str, ...]:
    options = FuseOptions(estimator, estimate=Estimate(map="unknown"))
    if noise == "white, no biases":
        options = replace(options, bias=replace(options.bias, use=False))
    elif noise == "network, fitted":
        white, bias = noise_of_other_logs()
        options = replace(options, noise=white, bias=bias)
    kind: Literal["white", "network"] = "white" if noise.startswith("white") else "network"
    squares, nees, places, turns = [], [], [], []
    for seed in range(runs):
        log = simulate(SimulationOptions(noise=kind, objects=objects, symmetric_objects=0, seed=seed))
        result = fuse(log, options)
        square, ratio = errors(result, log)
        squares.append(square)
        nees.append(ratio)
        for found, true in map_pairs(result, log):
            places.append(np.sum((found.translation - true.translation) ** 2))
            turns.append((found.rotation * true.rotation.inv()).magnitude() ** 2)
    rms = [
        f"{factor * np.sqrt(np.mean(v)):.{d}f}" if v else "–" for v, factor, d in ((places, 1e3, 1), (turns, 57.3, 2))
    ]
    return estimator, noise, str(objects), f"{1e3 * np.sqrt(np.mean(squares)):.1f}", f"{np.mean(nees):.2f}", *rms


@cache
def noise_of_other_logs() -> tuple[DetectionNoise, DetectionBias]:
    """Return what fit-noise finds in six logs that no table uses; their objects' mean errors are others."""
    logs = [
        simulate(SimulationOptions(noise="network", objects=4, symmetric_objects=0, seed=seed))
        for seed in range(1000, 1006)
    ]
    noise, bias = fit_noise(logs).options()
    return noise, replace(bias, means=())


def map_pairs(result: FuseResult, log: Log) -> Iterator[tuple[RigidTransform, RigidTransform]]:
    """Yield found and true poses of every object that had to be found."""
    assert result.calibrated is not None
    assert log.landmark_map is not None
    found = result.calibrated.landmark_map or ()
    true = {(mark.object_id, mark.instance): mark for mark in log.landmark_map}
    for mark in found:
        if mark.covariance is not None and np.max(np.abs(mark.covariance)) > 1e-12:
            yield mark.T_world_obj, true[mark.object_id, mark.instance].T_world_obj


def errors(result: FuseResult, log: Log) -> tuple[float, float]:
    """Return the mean squared position error (m^2) and the mean NEES per degree of freedom at the true stamps."""
    assert log.T_world_imu is not None
    truth = log.T_world_imu.between(int(result.stamps_ns[0]), int(result.stamps_ns[-1]))
    at = np.searchsorted(result.stamps_ns, truth.stamps_ns, side="right") - 1
    estimate, _ = result.trajectory.interpolate(truth.stamps_ns)
    nees = pose_nees(estimate, truth.T_world_body, result.pose_covariances[at])
    gap = estimate.translation - truth.T_world_body.translation
    return float(np.mean(np.sum(gap**2, axis=1))), float(np.mean(nees))


def calibration_rows(name: str, log: Log) -> Iterator[tuple[str, ...]]:
    """Yield what is left of a mistake after one pass, and after a second that starts from what the first found."""
    assert log.calibration is not None
    assert log.calibration.T_cam_imu is not None
    true = log.calibration
    late = replace(true, timeshift_cam_imu_s=true.timeshift_cam_imu_s + WRONG_OFFSET_S)
    left = []
    for _ in range(2):
        found = found_in(log, late, Estimate(time_offset=True))
        late = found.applied_to(late)
        left.append(f"{1e3 * (late.timeshift_cam_imu_s - true.timeshift_cam_imu_s):.1f} ms")
    assert found.timeshift_sigma_s is not None
    yield name, f"{1e3 * WRONG_OFFSET_S:.0f} ms", *left, f"{1e3 * found.timeshift_sigma_s:.1f} ms"
    moved = replace(true, T_cam_imu=log.calibration.T_cam_imu * WRONG_EXTRINSICS)
    left = []
    for _ in range(2):
        found = found_in(log, moved, Estimate(extrinsics=True))
        moved = found.applied_to(moved)
        assert moved.T_cam_imu is not None
        error = log.calibration.T_cam_imu.inv() * moved.T_cam_imu
        left.append(
            f"{1e3 * np.linalg.norm(error.translation):.1f} mm, {np.degrees(error.rotation.magnitude()):.2f} deg"
        )
    assert found.extrinsic_covariance is not None
    sigmas = np.sqrt(np.diag(found.extrinsic_covariance))
    sigma = f"{1e3 * np.linalg.norm(sigmas[3:]):.1f} mm, {np.degrees(np.linalg.norm(sigmas[:3])):.2f} deg"
    yield name, "30 mm, 3 deg", *left, sigma


def found_in(log: Log, calibration: Calibration, estimate: Estimate) -> Calibrated:
    """Return what a pass over the log with this calibration found."""
    found = fuse(replace(log, calibration=calibration), FuseOptions(estimate=estimate)).calibrated
    assert found is not None
    return found


def table_of(asked: argparse.Namespace, logs: tuple[str, ...], *options: str) -> None:
    paths = [str(asked.shared / "ycbv_dope" / log) for log in logs]
    command("table", *paths, "--pooled-only", "--with-fusion", *options)


def command(*words: str) -> None:
    print(f"\n$ poet-loc {' '.join(words)}\n", flush=True)
    if poet_loc(words):
        sys.exit(1)


TABLES: dict[str, Callable[[argparse.Namespace], None]] = {
    "white": white,
    "network": network,
    "stated": stated,
    "real": real,
    "odometry": odometry,
    "fitted": fitted,
    "euroc": euroc,
    "calibration": calibration_,
    "map": map_,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", choices=[*TABLES, []], help="default: all of them")
    parser.add_argument("--runs", type=int, default=50, help="seeds of a simulated table")
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"))
    asked = parser.parse_args()
    for name in asked.tables or TABLES:
        print(f"\n## {TABLES[name].__doc__}")
        TABLES[name](asked)


if __name__ == "__main__":
    main()
