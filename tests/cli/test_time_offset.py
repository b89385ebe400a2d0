"""Stamps of camera and IMU that are tenths of a second apart are told."""

from __future__ import annotations

import pytest

from fusion.simulate import SimulationOptions, simulate
from poet_loc.cli.main import main
from poet_loc.io.calibration_yaml import read_calibration
from poet_loc.io.log_folder import write_log


def write(folder, delay_s: float) -> str:
    folder.mkdir()
    write_log(folder, simulate(SimulationOptions(duration_s=12.0, objects=4, seed=2, stamp_delay_s=delay_s)))
    return str(folder)


@pytest.mark.parametrize("command", ["fuse", "run"])
def test_late_stamps_are_told(tmp_path, capsys, command):
    log, out = write(tmp_path / "log", 0.5), str(tmp_path / "out")
    fusions = ["--fusions", "eskf/objects"] if command == "run" else []
    assert main([command, log, "--out", out, "--no-pictures", *fusions]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "timeshift_cam_imu" in line]
    assert len(told) == 1
    assert "timeshift_cam_imu: -0.5" in told[0] or "timeshift_cam_imu: -0.49" in told[0]
    assert "--estimate.time-offset" in told[0]


def test_late_stamps_are_told_by_the_table(tmp_path, capsys):
    log = write(tmp_path / "log", -0.4)
    assert main(["table", log, "--with-fusion", "--fusions", "eskf/objects"]) == 0
    assert "timeshift_cam_imu: 0.4" in capsys.readouterr().err.replace("0.39", "0.4")


def test_they_are_estimated_from_there(tmp_path, capsys):
    log, out = write(tmp_path / "log", 0.5), tmp_path / "out"
    assert main(["fuse", log, "--out", str(out), "--no-pictures", "--estimate.time-offset"]) == 0
    assert "the estimate begins there" in capsys.readouterr().err
    (written,) = out.rglob("calibration.yaml")
    assert read_calibration(written).timeshift_cam_imu_s == pytest.approx(-0.5, abs=0.004)


def test_nothing_is_told_of_stamps_in_time(tmp_path, capsys):
    log = write(tmp_path / "log", 0.0)
    assert main(["fuse", log, "--out", str(tmp_path / "out"), "--no-pictures"]) == 0
    assert "timeshift" not in capsys.readouterr().err
