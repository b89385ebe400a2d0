"""What was made of a log, as the files of a run folder."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from fusion.health import as_plain
from fusion.result import FuseResult
from landmarks.localize import LocalizeResult
from poet_loc.cli.estimates import Estimates
from poet_loc.cli.found import found_lines
from poet_loc.cli.terminal import Report
from poet_loc.core.records import Calibration
from poet_loc.io.calibration_yaml import write_calibration
from poet_loc.io.camera_poses_csv import write_camera_poses
from poet_loc.io.landmarks_json import write_landmarks
from poet_loc.io.tum import write_tum
from poet_loc.io.whole_folder import write_whole_file
from poet_loc.report.error_tables import Block, consistency_table, error_table, table_text
from poet_loc.report.evaluate import Evaluation
from poet_loc.report.html_report import write_report
from poet_loc.report.run_folder import write_states
from poet_loc.report.summary import to_summary, write_errors_csv, write_summary
from poet_loc.report.tables import Table

WRITING_STEPS = 3

_AT_THE_TOP = ("localize/robust", "fuse/eskf/objects")
"""Whose trajectories stand at the top of the folder, where they are among the estimates."""

_PACKAGES = ("poet-loc", "numpy", "scipy", "numba", "gtsam", "rerun-sdk", "matplotlib")


def write_run(
    folder: Path, estimates: Estimates, asked: Any, report: Report, pictures: bool = True, paper: bool = False
) -> None:
    """Write a run into an existing folder: trajectories, states, errors, tables, options, and pictures if asked for.

    asked is the dataclass of the command's arguments; options.yaml tells it with the versions. For a paper, figures
    are written as vector PDF, too.
    """
    report.step("write trajectories")
    for localized in estimates.localized:
        for place in _places(folder, localized.name, len(estimates.localized)):
            write_localized(place, localized)
    for fused in estimates.fused:
        for place in _places(folder, fused.name, len(estimates.fused)):
            write_fused(place, fused)
            write_calibrated(place, fused, estimates.log.calibration)
    if estimates.evaluation is not None:
        summary = to_summary(estimates.evaluation)
        write_summary(folder / "summary.json", summary)
        write_errors_csv(folder / "errors.csv", estimates.evaluation)
        write_whole_file(folder / "table.md", [table_text([Block(summary)], "md")])
        write_whole_file(folder / "table.tex", [table_text([Block(summary)], "latex")])
    write_whole_file(folder / "options.yaml", [options_text(asked)])
    if pictures or paper:
        _write_pictures(folder, estimates, asked, report, paper)


def error_tables(evaluation: Evaluation) -> list[Table]:
    """Return the tables of a run: errors, and consistency where something knows its own errors."""
    blocks = [Block(to_summary(evaluation))]
    return [table for table in (error_table(blocks), consistency_table(blocks)) if table.rows]


def write_localized(folder: Path, result: LocalizeResult) -> None:
    """Write camera_poses.csv, with who voted, and T_world_cam.tum."""
    write_camera_poses(folder / "camera_poses.csv", result.estimates.camera_poses, result.voter_columns)
    write_tum(folder / "T_world_cam.tum", result.trajectory)


def write_fused(folder: Path, result: FuseResult) -> None:
    """Write states.csv, health.json and T_world_imu.tum; where the log knows no IMU, T_world_cam.tum, if not there."""
    path = folder / f"T_world_{result.body}.tum"
    if not path.exists():
        write_tum(path, result.trajectory)
    write_states(folder / "states.csv", result)
    if result.health is not None:
        write_whole_file(folder / "health.json", [json.dumps(as_plain(result.health), indent=1) + "\n"])


def write_calibrated(folder: Path, result: FuseResult, calibration: Calibration | None) -> None:
    """Write what was estimated beside the trajectory: calibration.yaml and landmarks.json, and how sure it is."""
    found = result.calibrated
    if found is None:
        return
    if values := found.as_plain():
        write_whole_file(folder / "calibrated.json", [json.dumps(values, indent=1) + "\n"])
    if found.T_imu_cam is not None or found.timeshift_cam_imu_s is not None:
        write_calibration(folder / "calibration.yaml", found.applied_to(calibration or Calibration()))
    if found.landmark_map is not None:
        write_landmarks(folder / "landmarks.json", found.landmark_map)


def options_text(asked: Any) -> str:
    """Return options.yaml: what was asked, and the versions that did it."""
    content = {"command": type(asked).__module__.rpartition(".")[2], "asked": _plain(asked), "versions": _versions()}
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def named_files(out: Path) -> list[str]:
    """Return the files at the top of a run folder, and its folders with the number of files in them."""
    lines = [str(path) for path in sorted(out.iterdir()) if path.is_file()]
    for path in sorted(out.iterdir()):
        if path.is_dir():
            lines.append(f"{path}/ ({sum(each.is_file() for each in path.rglob('*'))} files)")
    return lines


def _places(folder: Path, name: str, rivals: int) -> Iterator[Path]:
    """Yield the folders that an estimate is written to; one estimate alone stands at the top only."""
    if rivals == 1 or name in _AT_THE_TOP:
        yield folder
    if rivals > 1:
        place = folder / name
        place.mkdir(parents=True)
        yield place


def _write_pictures(folder: Path, estimates: Estimates, asked: Any, report: Report, paper: bool) -> None:
    record = estimates.record
    report.step("draw figures")
    from poet_loc.report.figures import write_figures

    figures = write_figures(record, folder / "figures", paper)
    tables = [] if estimates.evaluation is None else error_tables(estimates.evaluation)
    title = f"poet-loc on {estimates.log.path.resolve().name}"
    write_report(folder / "report.html", title, tables, figures, options_text(asked), found_lines(estimates))
    report.step("record for rerun")
    from poet_loc.report.rerun_log import write_recording

    write_recording(record, folder / "recording.rrd")


def _plain(value: Any) -> Any:
    """Return options as what YAML knows."""
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: _plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, Path) else value


def _versions() -> dict[str, str]:
    found = {"python": sys.version.split()[0]}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
