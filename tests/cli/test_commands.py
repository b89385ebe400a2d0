"""The commands on a small simulated log: what they write, what they say, what they leave out."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from test_main import one_line

from fusion.simulate import SimulationOptions, simulate
from poet_loc.cli import run as run_command
from poet_loc.cli import view as view_command
from poet_loc.cli.main import main
from poet_loc.core.geometry import make_pose
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.calibration_yaml import read_calibration
from poet_loc.io.camera_poses_csv import read_camera_poses, write_camera_poses
from poet_loc.io.landmarks_json import read_landmarks
from poet_loc.io.log_folder import read_log
from poet_loc.io.object_poses_csv import write_object_poses
from poet_loc.io.tum import read_tum, write_tum

MODES = ("all", "out", "prev", "best", "robust")
FILES = {
    "camera_poses.csv",
    "T_world_cam.tum",
    "T_world_imu.tum",
    "states.csv",
    "health.json",
    "errors.csv",
    "summary.json",
    "table.md",
    "table.tex",
    "figures",
    "recording.rrd",
    "report.html",
    "options.yaml",
    "localize",
    "fuse",
}


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def summary(run: Path) -> dict:
    return json.loads((run / "summary.json").read_text())


def rmse_mm(row: dict) -> float:
    return row["position_error_mm"]["norm"]["rmse"]


@pytest.fixture(scope="module")
def run(clean_log, tmp_path_factory) -> Path:
    """A whole run, with pictures."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["run", str(clean_log), "--out", str(out)]) == 0
    return out


def test_a_run_has_the_files_that_the_formats_name(run):
    assert files(run) == FILES
    assert {path.name for path in (run / "localize").iterdir()} == set(MODES)
    assert all(files(run / "localize" / mode) == {"camera_poses.csv", "T_world_cam.tum"} for mode in MODES)
    assert files(run / "fuse" / "eskf" / "objects") == {"T_world_imu.tum", "states.csv", "health.json"}
    assert list((run / "figures").glob("*.png"))
    assert files(run.parent) == {"run"}, "nothing temporary is left"


def test_the_top_of_a_run_is_robust_and_the_filter_on_objects(run):
    for name in ("camera_poses.csv", "T_world_cam.tum"):
        assert (run / name).read_bytes() == (run / "localize" / "robust" / name).read_bytes()
    for name in ("states.csv", "health.json", "T_world_imu.tum"):
        assert (run / name).read_bytes() == (run / "fuse" / "eskf" / "objects" / name).read_bytes()


def test_a_runs_summary_names_every_estimate_and_the_filter_is_good(run):
    rows = summary(run)
    fused = {"fuse/eskf/objects", "fuse/eskf/camera", "fuse/graph/objects"}
    assert {f"localize/{mode}" for mode in MODES} | fused <= rows.keys()
    assert all(rmse_mm(rows[name]) < rmse_mm(rows["localize/prev"]) for name in fused)
    assert rows["localize/best"]["oracle"]
    assert rows["fuse/eskf/objects"]["coverage"] > 0.9


def test_states_agree_with_the_trajectory_and_carry_positive_sigmas(run):
    lines = (run / "states.csv").read_text().splitlines()
    header, values = lines[0].split(","), np.array([line.split(",")[1:] for line in lines[1:]], dtype=float)
    trajectory = read_tum(run / "T_world_imu.tum")
    assert [int(line.split(",")[0]) for line in lines[1:]] == trajectory.stamps_ns.tolist()
    assert header[:4] == ["timestamp_ns", "px", "py", "pz"]
    np.testing.assert_allclose(values[:, :3], trajectory.T_world_body.translation, atol=1e-8)
    sigmas = [i - 1 for i, name in enumerate(header) if name.startswith("sigma_")]
    assert len(sigmas) == 15
    assert np.all(values[:, sigmas] > 0.0)


def test_options_tell_what_was_asked_and_the_versions(run, clean_log):
    told = yaml.safe_load((run / "options.yaml").read_text())
    assert told["command"] == "run"
    assert told["asked"]["log"] == str(clean_log)
    assert told["asked"]["options"]["solver"]["mode"] == "robust"
    assert told["versions"]["poet-loc"]


def test_evaluate_prints_the_same_error_as_the_run(run, clean_log, capsys):
    arguments = [str(run / "T_world_cam.tum"), str(clean_log / "T_world_cam.tum")]
    assert main(["evaluate", *arguments]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| norm"))
    assert float(line.split("|")[7]) == pytest.approx(rmse_mm(summary(run)["localize/robust"]), abs=0.06)


def test_a_run_is_replaced_only_when_told_to(clean_log, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["localize", str(clean_log), "--out", str(out), "--mode", "all", "--no-pictures"]) == 0
    before = (out / "camera_poses.csv").read_bytes()
    capsys.readouterr()
    assert main(["localize", str(clean_log), "--out", str(out), "--no-pictures"]) == 1
    assert "--overwrite" in one_line(capsys)
    assert (out / "camera_poses.csv").read_bytes() == before
    assert main(["localize", str(clean_log), "--out", str(out), "--no-pictures", "--overwrite"]) == 0
    assert (out / "camera_poses.csv").read_bytes() != before
    assert summary(out).keys() == {"localize/robust"}


@pytest.mark.parametrize("had_results", [False, True])
def test_an_interrupted_run_leaves_the_old_folder_or_none(had_results, clean_log, tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    if had_results:
        out.mkdir()
        (out / "summary.json").write_text("old")

    def interrupted(folder, *_):
        (folder / "half.csv").write_text("1,2,")
        raise KeyboardInterrupt

    monkeypatch.setattr(run_command, "write_run", interrupted)
    assert main(["run", str(clean_log), "--out", str(out), "--overwrite"]) == 130
    assert one_line(capsys) == "poet-loc: interrupted\n"
    assert {path.name for path in tmp_path.rglob("*")} == ({"run", "summary.json"} if had_results else set())


def test_localize_and_fuse_give_the_rows_of_the_run(run, clean_log, tmp_path):
    whole = summary(run)
    for mode in ("prev", "best"):
        assert main(["localize", str(clean_log), "--out", str(tmp_path / mode), "--mode", mode, "--no-pictures"]) == 0
        assert rmse_mm(summary(tmp_path / mode)[f"localize/{mode}"]) == pytest.approx(
            rmse_mm(whole[f"localize/{mode}"])
        )
    for measurements in ("objects", "camera"):
        out = tmp_path / measurements
        assert main(["fuse", str(clean_log), "--out", str(out), "--measurements", measurements, "--no-pictures"]) == 0
        name = f"fuse/eskf/{measurements}"
        assert rmse_mm(summary(out)[name]) == pytest.approx(rmse_mm(whole[name]))
        assert "T_world_imu.tum" in files(out)


def found_place(calibration):
    return calibration.T_cam_imu.inv().translation


def test_fuse_writes_what_it_estimated_beside_the_trajectory(clean_log, tmp_path, capsys):
    asked = ["fuse", str(clean_log), "--out", str(tmp_path / "run"), "--no-pictures"]
    assert main([*asked, "--estimate.extrinsics", "--estimate.time-offset", "--estimate.map", "unknown"]) == 0
    before, after = (
        read_calibration(clean_log / "calibration.yaml"),
        read_calibration(tmp_path / "run/calibration.yaml"),
    )
    turned = (before.T_cam_imu.rotation.inv() * after.T_cam_imu.rotation).magnitude()
    assert 0.0 < turned < np.radians(5.0)
    assert after.timeshift_cam_imu_s != before.timeshift_cam_imu_s
    assert after.camera == before.camera
    told = json.loads((tmp_path / "run" / "calibrated.json").read_text())
    assert told["timeshift_cam_imu_s"] == pytest.approx(after.timeshift_cam_imu_s)
    said = capsys.readouterr().out
    assert f"fuse/eskf/objects found timeshift_cam_imu {1e3 * after.timeshift_cam_imu_s:.1f} ms, 1-sigma" in said
    assert f"{1e3 * np.linalg.norm(found_place(after) - found_place(before)):.1f} mm and" in said
    assert 0.0 < told["timeshift_sigma_s"] < 0.02
    found = read_landmarks(tmp_path / "run" / "landmarks.json")
    assert {each.key for each in found} <= {each.key for each in read_landmarks(clean_log / "landmarks.json")}
    assert sum(each.covariance is not None for each in found) == len(found) > 3


def test_fuse_takes_camera_poses_from_the_mode_or_from_the_log(log, tmp_path):
    asked = ["fuse", str(log), "--measurements", "camera", "--no-pictures", "--out"]
    assert main([*asked, str(tmp_path / "robust")]) == 0
    assert main([*asked, str(tmp_path / "prev"), "--mode", "prev"]) == 0
    assert summary(tmp_path / "prev").keys() == {"localize/prev", "fuse/eskf/camera"}
    shutil.copy(tmp_path / "prev" / "camera_poses.csv", log / "camera_poses.csv")
    assert main([*asked, str(tmp_path / "given")]) == 0
    robust, prev, given = (summary(tmp_path / name) for name in ("robust", "prev", "given"))
    assert given.keys() == {"localize/given", "fuse/eskf/camera"}
    assert rmse_mm(given["localize/given"]) == pytest.approx(rmse_mm(prev["localize/prev"]))
    assert rmse_mm(robust["fuse/eskf/camera"]) != pytest.approx(rmse_mm(prev["fuse/eskf/camera"]), rel=1e-3)


@pytest.mark.parametrize(
    ("missing", "said", "gone", "kept"),
    [
        (["imu.csv"], "fused on constant velocity", set(), {"T_world_cam.tum", "T_world_imu.tum", "summary.json"}),
        (
            ["calibration.yaml"],
            "calibration.yaml",
            {"states.csv", "fuse", "T_world_imu.tum"},
            {"T_world_cam.tum", "summary.json"},
        ),
        (
            ["T_world_cam.tum", "T_world_imu.tum"],
            "ground truth",
            {"summary.json", "errors.csv", "table.md", "table.tex"},
            {"T_world_cam.tum", "T_world_imu.tum", "states.csv"},
        ),
    ],
)
def test_what_a_log_lacks_is_said_and_left_out(missing, said, gone, kept, log, tmp_path, capsys):
    for name in missing:
        (log / name).unlink()
    assert main(["run", str(log), "--out", str(tmp_path / "run"), "--no-pictures"]) == 0
    notes = capsys.readouterr().err.splitlines()
    assert any(said in note for note in notes)
    assert len(notes) <= 2
    there = files(tmp_path / "run")
    assert kept <= there
    assert not gone & there


@pytest.mark.parametrize("command", ["fuse", "localize"])
def test_a_log_without_ground_truth_is_drawn(command, log, tmp_path):
    for name in ("T_world_cam.tum", "T_world_imu.tum"):
        (log / name).unlink()
    out = tmp_path / "run"
    assert main([command, str(log), "--out", str(out)]) == 0
    assert {"report.html", "recording.rrd", "options.yaml"} <= files(out)
    assert (out / "figures" / "top_view.png").is_file()
    assert "top_view" in (out / "report.html").read_text()
    assert "No ground truth: no errors." in (out / "report.html").read_text()


def test_fuse_without_the_imu_that_was_asked_for_is_one_line(log, tmp_path, capsys):
    (log / "imu.csv").unlink()
    assert main(["fuse", str(log), "--motion", "imu", "--out", str(tmp_path / "run")]) == 1
    assert "no imu.csv" in one_line(capsys)
    assert files(tmp_path) == {"log"}


def test_a_log_of_camera_poses_alone_runs(log, tmp_path):
    write_camera_poses(
        log / "camera_poses.csv", simulate(SimulationOptions(8.0, seed=3, camera_poses=True)).camera_poses
    )
    (log / "object_poses.csv").unlink()
    (log / "landmarks.json").unlink()
    assert main(["run", str(log), "--out", str(tmp_path / "run"), "--no-pictures"]) == 0
    rows = summary(tmp_path / "run")
    assert rows.keys() >= {"localize/given", "fuse/eskf/camera"}
    assert rmse_mm(rows["fuse/eskf/camera"]) < rmse_mm(rows["localize/given"])


def test_table_over_logs_and_detections_in_every_format(clean_log, log, tmp_path, capsys):
    shutil.copy(log / "object_poses.csv", log / "object_poses_other.csv")
    asked = ["table", str(clean_log), str(log), "--modes", "all", "prev"]
    assert main(asked) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("**Errors on the common frames**")
    assert shown.count("| localize/prev") + shown.count(" localize/prev ") >= 2
    assert "all 2 logs" in shown
    for suffix, mark in ((".tex", r"\begin{tabular}"), (".csv", "log,detections,name"), (".json", "["), (".md", "**")):
        out = tmp_path / f"table{suffix}"
        assert main([*asked, "--out", str(out)]) == 0
        assert out.read_text().startswith(mark) or mark in out.read_text()
    records = json.loads((tmp_path / "table.json").read_text())
    groups = {(record["log"], record["detections"]) for record in records}
    assert len(groups) == 2 + 3, "two sets pooled, three sets in two logs"
    assert main([*asked, "--with-fusion", "--pooled-only", "--format", "json"]) == 0
    capsys.readouterr()
    assert main([*asked, "--out", str(tmp_path / "table.md")]) == 1
    assert "--overwrite" in one_line(capsys)
    assert main([*asked, "--out", str(tmp_path / "table.docx")]) == 1
    assert "--format" in one_line(capsys)


def test_a_table_counts_no_log_twice(clean_log, capsys):
    assert main(["table", str(clean_log), str(clean_log / ".." / clean_log.name), "--modes", "prev"]) == 1
    assert "is named twice" in one_line(capsys)


@pytest.mark.parametrize("command", ["table", "fit-noise"])
def test_a_file_where_no_folder_is_and_a_command_without_logs_are_told_before_the_work(
    command, clean_log, tmp_path, capsys
):
    (tmp_path / "log").mkdir()
    out = tmp_path / "none" / "out.md"
    assert main([command, str(tmp_path / "log"), "--out", str(out)]) == 1
    assert f"{out}: lies in no folder that is there" in one_line(capsys)
    assert main([command]) == 1
    assert "no log was named" in one_line(capsys)


def test_table_fuses_when_asked(clean_log, capsys):
    assert main(["table", str(clean_log), "--modes", "best", "--with-fusion", "--format", "csv"]) == 0
    names = [line.split(",")[2] for line in capsys.readouterr().out.splitlines()[1:]]
    assert {"localize/best", "fuse/eskf/objects"} <= set(names)


def test_what_fuses_the_oracles_camera_poses_is_an_oracle_too(clean_log, capsys):
    asked = ["table", str(clean_log), "--modes", "prev", "--with-fusion", "--solver.mode", "best", "--format", "json"]
    assert main([*asked, "--fusions", "eskf/camera", "eskf/objects"]) == 0
    rows = {row["name"]: row["oracle"] for row in json.loads(capsys.readouterr().out)}
    assert rows == {"localize/prev": False, "fuse/eskf/camera": True, "fuse/eskf/objects": False}


def test_sensitivity_lists_each_option_with_its_default(clean_log, capsys):
    assert main(["table", str(clean_log), "--sensitivity", "--format", "json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    options = {(row["mode"], row["option"]) for row in rows}
    defaults = [(row["mode"], row["option"]) for row in rows if row["default"]]
    assert ("out", "distance") in options
    assert sorted(defaults) == sorted(options), "each option's default stands among its values, once"


def test_convert_tum_makes_a_log_that_fuses(clean_log, tmp_path, capsys):
    out = tmp_path / "log"
    sigmas = ["--position-sigma-m", "0.01", "--attitude-sigma-deg", "0.5"]
    trajectory = str(clean_log / "T_world_cam.tum")
    assert main(["convert", "tum", trajectory, str(out), "--like", str(clean_log), *sigmas]) == 0
    assert str(out) in capsys.readouterr().out
    assert len(read_camera_poses(out / "camera_poses.csv")) == len(read_tum(clean_log / "T_world_cam.tum"))
    run = ["--measurements", "camera", "--no-pictures", "--out", str(tmp_path / "run")]
    assert main(["fuse", str(out), *run]) == 0
    assert rmse_mm(summary(tmp_path / "run")["fuse/eskf/camera"]) < 5.0


def test_simulate_writes_a_log_and_runs_many(tmp_path, capsys):
    short = ["--duration-s", "5", "--objects", "3", "--symmetric-objects", "0"]
    assert main(["simulate", "--out", str(tmp_path / "log"), "--seed", "4", *short]) == 0
    log = read_log(tmp_path / "log")
    assert log.landmark_map is not None
    assert len(log.landmark_map) == 3
    expected = simulate(SimulationOptions(duration_s=5.0, seed=4, objects=3, symmetric_objects=0))
    np.testing.assert_array_equal(log.imu.specific_force, expected.imu.specific_force)
    capsys.readouterr()
    assert main(["simulate", "--runs", "2", "--workers", "1", *short]) == 0
    shown = capsys.readouterr().out
    assert "| fuse/eskf/objects" in shown
    assert main(["simulate"]) == 1
    assert "--runs" in one_line(capsys)


def test_demo_shows_what_the_network_sees(tmp_path, capsys):
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out), "--duration-s", "2", "--no-pictures"]) == 0
    log = read_log(out / "log")
    poses = log.detections()[1]
    assert 50 < len(np.unique(poses.frames)) <= len(log.frames) == len(list((out / "log" / "rgb").iterdir()))
    assert poses.covariances is not None
    assert (out / "log" / "boxes.csv").exists()
    assert {"camera_poses.csv", "errors.csv", "summary.json", "table.md", "localize"} <= files(out / "run")
    assert rmse_mm(summary(out / "run")["localize/robust"]) < 300.0
    assert str(out / "run" / "summary.json") in capsys.readouterr().out
    assert main(["demo", "--out", str(out), "--duration-s", "2"]) == 1
    assert "--overwrite" in one_line(capsys)


def test_the_simulated_demo_writes_a_log_and_a_run(tmp_path, capsys):
    assert main(["demo", "--simulated", "--out", str(tmp_path / "demo"), "--seed", "2", "--duration-s", "6"]) == 0
    shown = capsys.readouterr().out
    assert files(tmp_path / "demo" / "run") == FILES
    assert str(tmp_path / "demo" / "run" / "recording.rrd") in shown
    assert read_log(tmp_path / "demo" / "log").imu is not None
    assert yaml.safe_load((tmp_path / "demo" / "run" / "options.yaml").read_text())["asked"]["seed"] == 2


def test_view_opens_recordings_and_serves_on_this_machine_only(run, tmp_path, monkeypatch):
    calls = []

    def call(words: list[str]) -> int:
        assert Path(words[-1]).is_file()
        calls.append(words)
        return 0

    monkeypatch.setattr(view_command.subprocess, "call", call)
    other = shutil.copytree(run, tmp_path / "other")
    assert main(["view", str(run)]) == 0
    assert main(["view", str(run), str(other), "--web"]) == 0
    here = ["--bind", "127.0.0.1"]
    assert calls[0][1:] == [*here, str(run / "recording.rrd")]
    assert calls[1][1:-1] == [*here, "--web-viewer"]
    assert Path(calls[1][-1]).name == "comparison.rrd"
    assert not Path(calls[1][-1]).exists()  # it was temporary


def test_the_program_itself_in_a_pipe(clean_log, tmp_path):
    program = "import sys; from poet_loc.cli.main import main; sys.exit(main())"
    words = ["localize", str(clean_log), "--out", str(tmp_path / "run"), "--no-pictures"]
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""
    assert done.stdout.startswith("**Errors on the common frames**")
    assert str(tmp_path / "run" / "summary.json") in done.stdout


def test_fusions_are_chosen_by_name(clean_log, tmp_path, capsys):
    asked = ["table", str(clean_log), "--modes", "best", "--with-fusion", "--format", "json"]
    assert main([*asked, "--fusions", "eskf-smoothed/objects", "eskf/camera"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in rows} == {"localize/best", "fuse/eskf-smoothed/objects", "fuse/eskf/camera"}


@pytest.mark.parametrize("command", [["run", "LOG", "--out", "RUN"], ["table", "LOG"]])
def test_one_estimator_is_refused_where_several_run(command, clean_log, tmp_path, capsys):
    paths = {"LOG": str(clean_log), "RUN": str(tmp_path / "run")}
    assert main([*(paths.get(word, word) for word in command), "--fusion.estimator", "graph"]) == 1
    assert "--fusions" in capsys.readouterr().err


def test_fuse_names_where_the_odometry_jumps(tmp_path, capsys):
    log, out = tmp_path / "log", tmp_path / "run"
    world = ["--odometry", "--duration-s", "8", "--objects", "4", "--symmetric-objects", "0", "--noise", "white"]
    assert main(["simulate", "--out", str(log), *world]) == 0
    lines = (log / "T_odom_cam.tum").read_text().splitlines()
    half = len(lines) // 2
    begin, at = (float(next(line for line in part if line[0] != "#").split()[0]) for part in (lines, lines[half - 1 :]))
    cells = [line.split() for line in lines[half:]]
    moved = [" ".join([c[0], repr(float(c[1]) + 0.4), *c[2:]]) for c in cells]
    (log / "T_odom_cam.tum").write_text("\n".join([*lines[:half], *moved]) + "\n")
    capsys.readouterr()
    assert main(["fuse", str(log), "--out", str(out), "--motion", "odometry", "--no-pictures"]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert re.search(rf"T_odom_cam.tum has a jump of 0\.(39|40) m and 0 deg at {at - begin:.1f} s: not taken for", told)
    (log / "T_odom_cam.tum").write_text("\n".join(lines[half - 60 : half]) + "\n")
    assert main(["fuse", str(log), "--out", str(out), "--motion", "odometry", "--no-pictures", "--overwrite"]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert re.search(r"tum has a hole of [12]\.\d s at 0\.0 s, a hole of [34]\.\d s at [34]\.\d s: not", told)


def test_fuse_names_an_object_that_was_moved_and_takes_odometry_beside_the_imu(tmp_path, capsys):
    log, out = tmp_path / "log", tmp_path / "run"
    world = ["--odometry", "--duration-s", "24", "--objects", "4", "--symmetric-objects", "0", "--imu-rate-hz", "100"]
    moved = ["--moved.object", "1", "--moved.after-s", "10", "--camera-rate-hz", "15"]
    assert main(["simulate", "--out", str(log), *world, *moved]) == 0
    capsys.readouterr()
    assert main(["fuse", str(log), "--out", str(out), "--motion", "imu+odometry", "--no-pictures"]) == 0
    told = capsys.readouterr()
    assert "was moved: left out from 1" in told.out + told.err
    health = json.loads((out / "health.json").read_text())
    assert [each["object_id"] for each in health["released"]] == [2]
    assert [each["released"] for each in health["objects"]] == [False, True, False, False]
    assert health["share_of_time"]["tracking"] > 0.9


def test_what_cannot_be_compared_is_told_in_one_line(log, tmp_path, capsys):
    truth = read_tum(log / "T_world_cam.tum")
    stamps_ns = np.arange(truth.stamps_ns[0] + 3_700_000, truth.stamps_ns[-1], 130_000_000)
    write_tum(log / "T_world_cam.tum", Trajectory(stamps_ns, truth.interpolate(stamps_ns)[0]))
    (log / "T_world_imu.tum").unlink()
    assert main(["run", str(log), "--out", str(tmp_path / "run"), "--no-pictures"]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "no errors of" in line]
    assert len(told) == 1
    assert "localize/all, localize/out" in told[0]
    assert "to 0.5 ms and are too sparse to interpolate (0.033 s > 0.025 s)" in told[0]
    rows = summary(tmp_path / "run")
    assert rows["fuse/eskf/objects"]["coverage"] > 0.9
    assert rows["fuse/eskf/objects"]["on_common_frames"]["frames"] > 50


@pytest.mark.parametrize(("scale", "told"), [(1.2, True), (1.0, False)])
def test_odometry_of_another_scale_is_noted(scale, told, log, tmp_path, capsys):
    whole = read_log(log)
    truth = whole.T_world_cam
    poses = make_pose(truth.T_world_body.rotation, scale * truth.T_world_body.translation)
    write_tum(log / "T_odom_cam.tum", Trajectory(truth.stamps_ns, poses))
    assert main(["fuse", str(log), "--out", str(tmp_path / "run"), "--no-pictures"]) == 0
    assert ("times as long as those by which the objects pass" in capsys.readouterr().err) == told


@pytest.mark.parametrize("command", ["localize", "fuse"])
def test_quaternions_in_another_order_are_noted(command, log, tmp_path, capsys):
    poses = read_log(log).object_poses[""]
    rotation = Rotation.from_quat(np.roll(poses.T_cam_obj.rotation.as_quat(), 1, axis=1))
    otherwise = replace(poses, T_cam_obj=make_pose(rotation, poses.T_cam_obj.translation))
    write_object_poses(log / "object_poses.csv", otherwise)
    main([command, str(log), "--out", str(tmp_path / "run"), *(["--no-pictures"] if command == "fuse" else [])])
    assert "quaternions are written w, x, y, z" in capsys.readouterr().err


def test_detections_behind_the_camera_are_noted(log, tmp_path, capsys):
    poses = read_log(log).object_poses[""]
    turned = make_pose(Rotation.from_rotvec([np.pi, 0.0, 0.0]), np.zeros(3))
    write_object_poses(log / "object_poses.csv", replace(poses, T_cam_obj=turned * poses.T_cam_obj))
    assert main(["localize", str(log), "--out", str(tmp_path / "run")]) == 0
    assert "behind the camera" in capsys.readouterr().err
