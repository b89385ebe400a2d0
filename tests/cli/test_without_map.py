"""Commands on a log whose objects stand nobody knows where, and on a map that says how unsure it is."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import poet_loc
from fusion.options import Estimate, FuseOptions
from fusion.simulate import SimulationOptions, simulate
from poet_loc.cli.main import main
from poet_loc.io.landmarks_json import read_landmarks
from poet_loc.io.log_folder import write_log

UNKNOWN = "--estimate.map", "unknown"


@pytest.fixture
def bare(tmp_path):
    folder = tmp_path / "bare"
    folder.mkdir()
    write_log(folder, simulate(SimulationOptions(duration_s=8.0, imu_rate_hz=100.0, objects=4, symmetric_objects=0)))
    (folder / "landmarks.json").unlink()
    return folder


def test_fuse_makes_the_map_and_says_that_ground_truth_is_of_another_world(bare, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["fuse", str(bare), "--out", str(out), *UNKNOWN]) == 0
    said = capsys.readouterr()
    assert "no landmarks.json: the world is that of the object that anchors it" in said.err
    assert "no ground truth" not in said.err
    made = read_landmarks(out / "landmarks.json")
    assert [each.object_id for each in made] == [1, 2, 3, 4]
    assert "found 4 of 4 landmarks, 1-sigma" in said.out
    assert "anchors the world" in said.out
    assert "gravity_m_s2" in json.loads((out / "calibrated.json").read_text())
    assert not (out / "errors.csv").exists()
    assert "<li>fuse/eskf/objects found 4 of 4 landmarks" in (out / "report.html").read_text()
    (bare / "landmarks.json").write_text((out / "landmarks.json").read_text())
    assert main(["run", str(bare), "--out", str(tmp_path / "next"), "--no-pictures"]) == 0
    noted = capsys.readouterr().err
    assert "landmarks.json states 1-sigmas of up to" in noted
    assert "--estimate.map approximate" in noted


def test_run_leaves_out_what_needs_a_map(bare, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["run", str(bare), "--out", str(out), "--fusion.estimate.map", "unknown", "--no-pictures"]) == 0
    noted = capsys.readouterr().err
    assert "no localize/all, localize/out, localize/prev, localize/best, localize/robust\n" in noted
    assert (out / "fuse" / "graph" / "objects" / "states.csv").is_file()


@pytest.mark.parametrize("command", ["localize", "run", "fuse"])
def test_without_a_map_the_fix_names_the_unknown_one(command, bare, tmp_path, capsys):
    assert main([command, str(bare), "--out", str(tmp_path / "run")]) == 1
    assert "has no landmarks.json" in (said := capsys.readouterr().err)
    assert "--estimate.map unknown" in said


def test_from_python(bare):
    fused = poet_loc.fuse(bare, FuseOptions(estimate=Estimate(map="unknown")))
    assert fused.evaluation is None
    assert "no ground truth" in repr(fused)
    assert len(fused.calibrated.landmark_map) == 4


def test_a_map_without_sigmas_is_not_noted(tmp_path, capsys):
    log = simulate(SimulationOptions(duration_s=6.0, imu_rate_hz=100.0, objects=3))
    sigma = np.diag(np.repeat([0.01, 0.02], 3) ** 2)
    unsure = [replace(each, covariance=sigma) for each in log.landmark_map]
    for name, landmarks in (("exact", list(log.landmark_map)), ("unsure", unsure)):
        folder = tmp_path / name
        folder.mkdir()
        write_log(folder, replace(log, landmark_map=replace(log.landmark_map, landmarks=tuple(landmarks))))
        assert main(["fuse", str(folder), "--out", str(tmp_path / f"run_{name}"), "--no-pictures"]) == 0
        assert ("up to 20.0 mm" in capsys.readouterr().err) == (name == "unsure")
    asked = ["fuse", str(tmp_path / "unsure"), "--out", str(tmp_path / "approximate"), "--no-pictures"]
    assert main([*asked, "--estimate.map", "approximate"]) == 0
    assert "1-sigmas" not in capsys.readouterr().err
