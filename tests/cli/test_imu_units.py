"""Fusing an IMU in other units is refused where that is certain, and told where it only seems so."""

from __future__ import annotations

import numpy as np
import pytest
from test_main import one_line

from poet_loc.cli.main import main
from poet_loc.core.records import ImuSamples
from poet_loc.io.imu_csv import read_imu, write_imu


def spoil(log, gyroscope: float, accelerometer: float) -> None:
    imu = read_imu(log / "imu.csv")
    write_imu(
        log / "imu.csv",
        ImuSamples(imu.stamps_ns, imu.angular_velocity * gyroscope, imu.specific_force * accelerometer),
    )


@pytest.mark.parametrize(("factor", "unit"), [(1 / 9.81, "g"), (1000.0, "mm/s^2")])
def test_a_specific_force_in_another_unit_is_refused(log, tmp_path, capsys, factor, unit):
    spoil(log, 1.0, factor)
    assert main(["fuse", str(log), "--out", str(tmp_path / "run")]) == 1
    line = one_line(capsys)
    assert f"{log / 'imu.csv'}: the accelerometer is in {unit}" in line
    assert "multiply by" in line
    assert not (tmp_path / "run").exists()


def test_turn_rates_in_degrees_are_refused(log, tmp_path, capsys):
    spoil(log, float(np.degrees(1.0)), 1.0)
    assert main(["fuse", str(log), "--out", str(tmp_path / "run")]) == 1
    line = one_line(capsys)
    assert f"{log / 'imu.csv'}: the gyroscope turns 57 times as fast as the poses: degrees" in line
    assert "multiply by pi/180" in line
    assert not (tmp_path / "run").exists()


def test_turn_rates_in_degrees_are_told_where_no_poses_tell_them(log, tmp_path, capsys):
    """A camera that hardly turns beside a gyroscope with a bias of a few degrees per second."""
    imu = read_imu(log / "imu.csv")
    still = np.random.default_rng(0).normal(0.0, 0.05, (len(imu), 3)) + [1.2, -0.8, 0.4]
    write_imu(log / "imu.csv", ImuSamples(imu.stamps_ns, still, imu.specific_force))
    main(["fuse", str(log), "--out", str(tmp_path / "run"), "--no-pictures"])
    assert "degrees, it seems; multiply by pi/180" in capsys.readouterr().err


def test_without_the_imu_its_units_do_not_matter(log, tmp_path, capsys):
    spoil(log, 1.0, 1 / 9.81)
    motion = ["--motion", "constant-velocity", "--no-pictures"]
    assert main(["fuse", str(log), "--out", str(tmp_path / "run"), *motion]) == 0
    assert "accelerometer" not in capsys.readouterr().err
