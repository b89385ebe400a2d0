"""Commands tell, in one line, an option that nothing reads with what was chosen."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))
from tiny_data import save_tiny, write_bop_split

from fusion.simulate import SimulationOptions, simulate
from poet_loc.cli.main import main
from poet_loc.io.log_folder import write_log


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("unread") / "log"
    folder.mkdir()
    world = SimulationOptions(duration_s=2.0, imu_rate_hz=50.0, camera_rate_hz=5.0, objects=3, symmetric_objects=0)
    write_log(folder, simulate(world))
    return folder


@pytest.fixture(scope="module")
def without_truth(log, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("blind") / "log"
    folder.mkdir()
    for name in ("imu.csv", "calibration.yaml", "landmarks.json", "object_poses.csv"):
        (folder / name).write_bytes((log / name).read_bytes())
    return folder


def told(capsys, *arguments: object) -> str:
    assert main([str(argument) for argument in arguments]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    ("mode", "option", "by"),
    [
        ("robust", ("--tie-rule", "order"), "the modes out and prev"),
        ("all", ("--memory.hold-s", "1"), "the mode robust"),
        ("out", ("--gate-probability", "0.9"), "the mode robust"),
        ("best", ("--vote-weights", "score"), "the modes all, out and prev"),
        ("robust", ("--trust-instances",), "several objects of one class"),
        ("all", ("--distance", "0.2"), "objects that are symmetric"),
        ("out", ("--noise.no-use-detections",), "detections with covariances"),
    ],
)
def test_localize_takes_the_options_of_its_mode(log, mode, option, by, capsys, tmp_path):
    line = told(capsys, "localize", log, "--out", tmp_path / "run", "--mode", mode, *option)
    name = option[0].removeprefix("--").replace("no-use", "use")
    assert line.startswith(f"poet-loc: {name} changes nothing here; it goes with ")
    assert by in line
    assert not (tmp_path / "run").exists()


def test_localize_goes_on_with_options_that_are_read(log, tmp_path):
    arguments = ["--mode", "out", "--tie-rule", "order", "--distance", "0.2", "--noise.across", "0.01"]
    assert main(["localize", str(log), "--out", str(tmp_path / "run"), *arguments, "--no-pictures"]) == 0


def test_the_solvers_options_count_where_its_mode_is_shown_or_fused(log, without_truth, capsys):
    robust = ("--solver.memory.hold-s", "1")
    line = told(capsys, "table", log, "--modes", "all", "out", *robust)
    assert "memory.hold-s changes nothing here; it goes with the mode robust" in line
    line = told(capsys, "table", log, "--modes", "all", "--with-fusion", "--fusions", "eskf/objects", *robust)
    assert "it goes with the mode robust" in line
    assert main(["table", str(log), "--modes", "all", *robust, "--with-fusion", "--fusions", "eskf/camera"]) == 0
    capsys.readouterr()
    line = told(capsys, "run", without_truth, "--out", without_truth / "run", "--evaluation.max-gap-s", "0.1")
    assert "max-gap-s changes nothing: there is no ground truth" in line


def test_simulate_takes_the_options_of_its_noise(capsys, tmp_path):
    line = told(capsys, "simulate", "--out", tmp_path / "log", "--noise", "white", "--network.gross-share", "0.2")
    assert "network.gross-share changes nothing here; it goes with noise network" in line
    line = told(capsys, "simulate", "--out", tmp_path / "log", "--odometry-position-drift", "0.1")
    assert "it goes with odometry" in line
    assert not (tmp_path / "log").exists()


def test_train_takes_the_options_of_its_start_and_preset(capsys, tmp_path):
    split = write_bop_split(tmp_path / "train", 2)
    given = ["train", "--out", tmp_path / "run", "--data.train", split]
    assert "uncertainty changes nothing here; it goes with --start" in told(capsys, *given, "--uncertainty", "full")
    start = save_tiny(tmp_path / "start.safetensors")
    line = told(capsys, *given, "--start", start, "--network.queries", "5")
    assert "network.queries changes nothing here; it goes with a training without --start" in line
    assert "the detector and the data" in told(capsys, *given, "--network.class-count", "5")
    assert "it goes with loss.symmetry-aware" in told(capsys, *given, "--models-info", tmp_path / "i.json")
    assert "it goes with data.validation" in told(capsys, *given, "--validate-every", "2")
    line = told(capsys, *given, "--preset", "embedded", "--recipe.epochs", "3")
    assert "recipe.epochs changes nothing with the preset embedded" in line
    assert not (tmp_path / "run").exists()


def test_detect_takes_the_options_of_its_source(log, capsys, tmp_path):
    split, out = write_bop_split(tmp_path / "test", 2), tmp_path / "found"
    images, weights = split / "000001" / "rgb", save_tiny(tmp_path / "net.safetensors")
    given = ["--out", out, "--weights", weights]
    assert "it goes with a BOP scene or split" in told(capsys, "detect", images, *given, "--true-boxes")
    assert "it goes with images that are no BOP scene" in told(capsys, "detect", split, *given, "--scene", "3")
    assert "it goes with a log with landmarks.json" in told(capsys, "detect", images, *given, "--unknown-objects")
    line = told(capsys, "detect", split, *given, "--true-boxes", "--score", "0.5")
    assert "it goes with detections, not true boxes" in line
    single = images / "000001.png"
    assert "it goes with a folder of images" in told(capsys, "detect", single, *given, "--stamps", tmp_path / "f.csv")
    (images / "frames.csv").write_text("timestamp_ns,frame,image\n5,1,000001.png\n")
    assert "it goes with images without stamps" in told(capsys, "detect", images, *given, "--rate", "10")
    assert not out.exists()


def test_further_commands(log, capsys, tmp_path):
    split = write_bop_split(tmp_path / "test", 2)
    (tmp_path / "frames.csv").write_text("timestamp_ns,frame,image\n")
    given = ["convert", "bop", split, tmp_path / "logs", "--stamps", tmp_path / "frames.csv", "--frame-rate", "15"]
    assert "frame-rate changes nothing here; it goes with images without --stamps" in told(capsys, *given)
    given = ["convert", "annotation", tmp_path / "a.json", tmp_path / "logs", "--stamps", tmp_path / "frames.csv"]
    assert "it goes with images without --stamps" in told(capsys, *given, "--frame-rate", "15")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "recording.rrd").write_bytes(b"")
    assert "--overwrite changes nothing without --save" in told(capsys, "view", tmp_path / "run", "--overwrite")
    assert "--overwrite changes nothing without --out" in told(capsys, "table", log, "--overwrite")
    assert "--overwrite changes nothing without --fix" in told(capsys, "check", log, "--overwrite")
    line = told(capsys, "view", tmp_path / "run", tmp_path / "run", "--web", "--save", tmp_path / "c.rrd")
    assert "--save opens nothing" in line
    given = ["evaluate-poses", tmp_path / "r.csv", "--truth", split, "--models", split]
    assert "--scene changes nothing" in told(capsys, *given, "--scene", "1")
