"""Every mistake of the user is one line on stderr that names the place, exit status 1, and nothing is half-written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from test_main import one_line

from poet_loc.cli.main import main


def edit_line(number: int, change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    """Change the cells of one line (from 1) of a comma-separated file."""

    def spoil(path: Path) -> None:
        lines = path.read_text().splitlines()
        lines[number - 1] = ",".join(change(lines[number - 1].split(",")))
        path.write_text("\n".join(lines) + "\n")

    return spoil


def cell(number: int, column: int, value: str) -> Callable[[Path], None]:
    return edit_line(number, lambda cells: [*cells[:column], value, *cells[column + 1 :]])


def cells(number: int, first: int, values: list[str]) -> Callable[[Path], None]:
    return edit_line(number, lambda old: [*old[:first], *values, *old[first + len(values) :]])


def text(content: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(content)


def swap_lines(first: int, second: int) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        lines = path.read_text().splitlines()
        lines[first - 1], lines[second - 1] = lines[second - 1], lines[first - 1]
        path.write_text("\n".join(lines) + "\n")

    return spoil


def repeat_line(number: int) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines[:number], *lines[number - 1 :]]) + "\n")

    return spoil


def swap_separator(separator: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(path.read_text().replace(",", separator)) and None


def later_by_an_hour(path: Path) -> None:
    header, *rows = path.read_text().splitlines()
    moved = [f"{int(row.partition(',')[0]) + 3600 * 10**9},{row.partition(',')[2]}" for row in rows]
    path.write_text("\n".join([header, *moved]) + "\n")


def add_column(path: Path) -> None:
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{header},colour", *(f"{row},3" for row in rows)]) + "\n")


def in_millimetres(path: Path) -> None:
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    first = header.index("tx")
    rows = [[*row[:first], *(str(1e3 * float(t)) for t in row[first : first + 3]), *row[first + 3 :]] for row in rows]
    path.write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")


def change_landmarks(change: Callable[[list[dict]], None]) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content["landmarks"])
        path.write_text(json.dumps(content, indent=1))

    return spoil


OBJECTS, IMU, MAP, CALIBRATION, TRUTH = (
    "object_poses.csv",
    "imu.csv",
    "landmarks.json",
    "calibration.yaml",
    "T_world_cam.tum",
)

SPOILT = {
    "missing map": (MAP, Path.unlink, ["has no landmarks.json"]),
    "missing object poses": (OBJECTS, Path.unlink, ["has no object_poses.csv"]),
    "empty imu": (IMU, text(""), ["imu.csv", "empty"]),
    "empty object poses": (OBJECTS, text(""), ["object_poses.csv", "empty"]),
    "empty truth": (TRUTH, text("\n"), ["T_world_cam.tum", "empty"]),
    "map that is no json": (MAP, text("{landmarks: 3"), ["landmarks.json:1", "JSON"]),
    "calibration that is no yaml": (CALIBRATION, text("cam0: [1, 2"), ["calibration.yaml"]),
    "calibration without its keys": (CALIBRATION, text("cam0: {T_cam_imus: 3}\n"), ["calibration.yaml"]),
    "a word where a number belongs": (OBJECTS, cell(5, 6, "far"), ["object_poses.csv:5", "far"]),
    "a missing cell": (IMU, edit_line(4, lambda cells: cells[:-1]), ["imu.csv:4"]),
    "a missing column": (OBJECTS, cell(1, 4, "skore"), ["object_poses.csv:1", "score is missing"]),
    "an unknown column": (OBJECTS, add_column, ["object_poses.csv:1", "colour"]),
    "nan": (OBJECTS, cell(9, 6, "nan"), ["object_poses.csv:9"]),
    "nan in imu": (IMU, cell(12, 3, "NaN"), ["imu.csv:12"]),
    "zero quaternion": (OBJECTS, cells(7, 8, ["0"] * 4), ["object_poses.csv:7", "quaternion"]),
    "unnormalised quaternion": (OBJECTS, cells(7, 8, ["1", "1", "0", "0.5"]), ["object_poses.csv:7", "quaternion"]),
    "stamps going backwards": (IMU, swap_lines(20, 40), ["imu.csv:21", "backwards"]),
    "a stamp twice": (IMU, repeat_line(30), ["imu.csv:31", "twice"]),
    "a detection twice": (OBJECTS, repeat_line(30), ["object_poses.csv:31", "twice"]),
    "truth going backwards": (TRUTH, swap_lines(3, 9), ["T_world_cam.tum:4", "backwards"]),
    "no common time span": (IMU, later_by_an_hour, ["imu.csv", "no common time span"]),
    "an object that is not in the map": (OBJECTS, cell(11, 2, "77"), ["object_poses.csv:11", "77", "landmarks.json"]),
    "two landmarks with one id": (MAP, change_landmarks(lambda marks: marks.append(marks[0])), ["landmarks.json"]),
    "a landmark without a place": (MAP, change_landmarks(lambda marks: marks[1].pop("t")), ["landmarks.json", "t"]),
    "a misspelt key in the map": (MAP, change_landmarks(lambda marks: marks[1].update(covar=None)), ["covar"]),
    "stamps in seconds": (
        OBJECTS,
        cell(5, 0, "1700000000.100"),
        ["object_poses.csv:5", "1700000000.100", "nanoseconds"],
    ),
    "imu stamps in seconds": (IMU, cell(5, 0, "1.7e9"), ["imu.csv:5", "1.7e9", "nanoseconds"]),
    "semicolons": (OBJECTS, swap_separator(";"), ["object_poses.csv:1", "semicolons", "commas"]),
    "tabs": (IMU, swap_separator("\t"), ["imu.csv:1", "tabs", "commas"]),
    "millimetres": (OBJECTS, in_millimetres, ["object_poses.csv", "millimet"]),
}


@pytest.mark.parametrize("mistake", SPOILT)
def test_a_spoilt_log_is_one_line(mistake, log, tmp_path, capsys):
    file, spoil, said = SPOILT[mistake]
    spoil(log / file)
    before = sorted(path.name for path in tmp_path.iterdir())
    assert main(["run", str(log), "--out", str(tmp_path / "run")]) == 1
    line = one_line(capsys)
    assert all(part in line for part in said), line
    assert "Traceback" not in line
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "nowhere", "--out", "RUN"], ["nowhere", "does not exist"]),
        (["run", "LOG/imu.csv", "--out", "RUN"], ["imu.csv", "is a file"]),
        (["run", "LOG"], ["--out"]),
        (["run", "LOG", "--out", "RUN", "--detections", "other"], ["other"]),
        (["run", "LOG", "--out", "RUN", "--bogus"], ["--bogus"]),
        (["localize", "LOG", "--out", "RUN", "--mode", "sideways"], ["sideways", "robust"]),
        (["fuse", "LOG", "--out", "RUN", "--estimator", "ukf"], ["ukf", "eskf"]),
        (["fuse", "LOG", "--out", "RUN", "--measurements", "sonar"], ["sonar", "objects"]),
        (["evaluate", "LOG/T_world_cam.tum", "nowhere.tum"], ["nowhere.tum", "does not exist"]),
        (["evaluate", "LOG/imu.csv", "LOG/T_world_cam.tum"], ["imu.csv:"]),
        (["table", "nowhere"], ["nowhere", "does not exist"]),
        (["table"], ["log"]),
        (["table", "LOG", "--format", "html"], ["html", "latex"]),
        (["convert", "floppy", "IN", "OUT"], ["floppy", "bop"]),
        (["convert", "bop", "nowhere", "RUN"], ["nowhere"]),
        (["convert", "tum", "nowhere.tum", "RUN"], ["nowhere.tum"]),
        (["view", "LOG"], ["has no recording"]),
        (["view"], ["RUN"]),
    ],
)
def test_a_wrong_command_line_is_one_line(arguments, said, log, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    replaced = [word.replace("LOG", log.name).replace("RUN", "run") for word in arguments]
    assert main(replaced) == 1
    line = one_line(capsys)
    assert all(part.lower() in line.lower() for part in said), line
    assert [path.name for path in tmp_path.iterdir()] == [log.name]


@pytest.mark.parametrize("command", ["run", "localize", "fuse"])
def test_a_folder_with_results_is_kept(command, log, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    assert main([command, str(log), "--out", str(out)]) == 1
    assert "has results" in one_line(capsys)
    assert [path.name for path in out.iterdir()] == ["precious.txt"]


@pytest.mark.parametrize("out", ["log", "."])
def test_a_log_is_never_overwritten_by_its_run(out, log, tmp_path, capsys):
    before = sorted(path.name for path in log.iterdir())
    assert main(["run", str(log), "--out", str(tmp_path / out), "--overwrite"]) == 1
    assert "holds the" in one_line(capsys)
    assert sorted(path.name for path in log.iterdir()) == before


def test_several_sets_of_detections_need_a_name(log, tmp_path, capsys):
    (log / "object_poses_a.csv").write_bytes((log / OBJECTS).read_bytes())
    (log / OBJECTS).rename(log / "object_poses_b.csv")
    assert main(["run", str(log), "--out", str(tmp_path / "run")]) == 1
    assert "a, b" in one_line(capsys)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("fuse LOG --out RUN --graph.gnc", ["graph.gnc", "the estimator", "graph"]),
        ("fuse LOG --out RUN --estimator graph --graph.gnc", ["graph.gnc", "the estimator batch"]),
        ("fuse LOG --out RUN --estimator batch --graph.lag-s 1", ["graph.lag-s", "the estimator graph"]),
        ("fuse LOG --out RUN --estimator graph --moved.then re-estimate", ["moved.then", "the estimator eskf"]),
        ("fuse LOG --out RUN --odometry.step-s 1", ["odometry.step-s", "odometry"]),
        ("fuse LOG --out RUN --measurements camera --noise.across 0.1", ["noise.across", "measurements objects"]),
        ("fuse LOG --out RUN --measurements camera --noise-from n.yaml", ["--noise-from", "no object poses"]),
        (
            "fuse LOG --out RUN --camera-noise.solver-correlation-s 3",
            ["camera-noise.solver-correlation-s", "measurements camera"],
        ),
        ("fuse LOG --out RUN --prior.map-position 1", ["prior.map-position", "approximate"]),
        ("fuse LOG --out RUN --mode prev", ["mode prev", "no camera poses"]),
        ("run LOG --out RUN --fusions graph/objects --fusion.moved.then re-estimate", ["moved.then", "eskf"]),
        ("run LOG --out RUN --fusion.graph.rounds 1", ["graph.rounds", "the estimator batch"]),
        ("run LOG --out RUN --fusions eskf/objects --solver.mode out", ["mode out", "no camera poses"]),
        ("table LOG --fusion.gate.probability 0.9", ["gate.probability", "nothing is fused"]),
        ("table LOG --fusions batch/objects", ["--fusions", "--with-fusion"]),
        ("table LOG --sensitivity --solver.distance 0.2", ["--sensitivity", "options"]),
        ("demo --simulated --duration-s 3 --out RUN --options.fusion.graph.gnc", ["graph.gnc", "batch"]),
        ("simulate --out RUN --fusions eskf/camera", ["--fusions", "--runs"]),
        ("simulate --runs 1 --options.fusion.graph.gnc", ["graph.gnc", "batch"]),
    ],
)
def test_an_option_that_changes_nothing_is_one_line(arguments, said, log, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "n.yaml").write_text("noise: {}\n")
    assert main([word.replace("LOG", log.name).replace("RUN", "out") for word in arguments.split()]) == 1
    line = one_line(capsys)
    assert all(part in line for part in said), line
    assert sorted(path.name for path in tmp_path.iterdir()) == [log.name, "n.yaml"]
