"""Known-bad logs are named, good ones pass silently, and what --fix writes is good."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))

from spoiled_logs import SPOILED_FILES, SPOILED_LOGS, imu, inverse_extrinsics, late_camera, stated, write_spoiled

from fusion.odometry import expected_of
from fusion.options import FuseOptions
from fusion.simulate import SimulationOptions, simulate
from poet_loc.check.covariances import check_covariances
from poet_loc.check.doctor import diagnose, write_repaired
from poet_loc.check.odometry import EXPECTED, breaks_of
from poet_loc.cli.main import main
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import LandmarkMap, Symmetry
from poet_loc.io.log_folder import read_log, write_log


def names(findings) -> set[str]:
    return {finding.check for finding in findings}


@pytest.mark.parametrize("name", [*SPOILED_LOGS, *SPOILED_FILES])
def test_a_known_bad_log_is_named_and_repaired(name, good_log, tmp_path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    expected, repairable = write_spoiled(name, good_log, folder)
    diagnosis = diagnose(folder)
    assert names(diagnosis.findings) == expected
    assert all(finding.fix and finding.what for finding in diagnosis.findings)
    json.dumps([finding.as_json() for finding in diagnosis.findings])
    if repairable:
        assert all(finding.repairable for finding in diagnosis.findings)
        write_repaired(diagnosis, tmp_path / "fixed")
        assert not diagnose(tmp_path / "fixed").findings
        read_log(tmp_path / "fixed")


@pytest.mark.parametrize(
    "options",
    [
        SimulationOptions(duration_s=8.0, seed=1),
        SimulationOptions(duration_s=12.0, seed=2, noise="white"),
        SimulationOptions(duration_s=8.0, seed=3, noise="none", imu_errors=False),
        SimulationOptions(duration_s=12.0, seed=4, camera_poses=True, odometry=True, timeshift_cam_imu_s=0.05),
    ],
)
def test_a_good_simulated_log_passes(options, tmp_path) -> None:
    write_log(tmp_path, simulate(options))
    assert not diagnose(tmp_path).findings


@pytest.mark.parametrize("name", ["euroc_v101", "ycbv_dope/0029", "ycbv_dope/0051", "ycbv_dope/0059"])
def test_a_good_shared_log_passes(name, shared_data) -> None:
    assert not diagnose(shared_data / name).findings


def test_several_faults_are_all_told_and_repaired(good_log, tmp_path) -> None:
    (tmp_path / "log").mkdir()
    spoiled = imu(180.0 / np.pi, 1.0 / 9.81)(inverse_extrinsics(late_camera(good_log)))
    write_log(tmp_path / "log", spoiled)
    diagnosis = diagnose(tmp_path / "log")
    expected = {"gyroscope-degrees", "accelerometer-unit", "extrinsics-inverted", "time-offset"}
    assert names(diagnosis.findings) == expected
    write_repaired(diagnosis, tmp_path / "fixed")
    assert not diagnose(tmp_path / "fixed").findings
    fixed = read_log(tmp_path / "fixed")
    np.testing.assert_allclose(fixed.imu.angular_velocity, good_log.imu.angular_velocity, rtol=1e-12)
    np.testing.assert_allclose(fixed.calibration.T_cam_imu.as_matrix(), good_log.calibration.T_cam_imu.as_matrix())
    assert fixed.calibration.timeshift_cam_imu_s == pytest.approx(-0.08, abs=0.005)


def test_the_time_offset_has_kalibrs_sign(tmp_path) -> None:
    """A camera whose stamps are late by the offset: t_imu = t_cam - offset."""
    log = simulate(SimulationOptions(duration_s=10.0, seed=5, timeshift_cam_imu_s=0.06))
    forgotten = replace(log, calibration=replace(log.calibration, timeshift_cam_imu_s=0.0))
    write_log(tmp_path, forgotten)
    (finding,) = diagnose(tmp_path).findings
    assert finding.check == "time-offset"
    assert finding.evidence["measured_t_imu_minus_t_pose_s"] == pytest.approx(0.06, abs=0.005)


@pytest.mark.parametrize("late_s", [-0.5, 0.7])
def test_a_time_offset_is_told_of_detections_that_turn_little_like_the_gyroscope(late_s, shared_data, tmp_path) -> None:
    log = read_log(shared_data / "ycbv_dope" / "0055")
    poses = log.object_poses["supervised"]
    poses = replace(poses, stamps_ns=poses.stamps_ns + round(late_s * 1e9))
    alone = replace(log, object_poses={"": poses}, T_odom_cam=None, T_world_cam=None, T_world_imu=None, frames=None)
    write_log(tmp_path, alone)
    (finding,) = diagnose(tmp_path).findings
    assert finding.check == "time-offset"
    assert finding.evidence["measured_t_imu_minus_t_pose_s"] == pytest.approx(-late_s, abs=0.03)
    assert "set timeshift_cam_imu" in finding.fix


def test_one_camera_has_one_time_offset(shared_data, tmp_path) -> None:
    """Its odometry tells 80 ms; the detections, which alone would not, do not speak against it."""
    log = read_log(shared_data / "ycbv_dope" / "0055")
    late = 80_000_000
    poses, odometry = log.object_poses["supervised"], log.T_odom_cam
    detections = {"": replace(poses, stamps_ns=poses.stamps_ns + late)}
    odometry = replace(odometry, stamps_ns=odometry.stamps_ns + late)
    log = replace(log, object_poses=detections, T_odom_cam=odometry, T_world_cam=None, T_world_imu=None, frames=None)
    write_log(tmp_path, log)
    (finding,) = diagnose(tmp_path).findings
    assert (finding.check, finding.file) == ("time-offset", "T_odom_cam.tum")
    assert "set timeshift_cam_imu: -0.07" in finding.fix


def test_a_detector_that_barely_turns_with_the_gyroscope_is_not_called_late(good_log, tmp_path) -> None:
    """Where rotations err for tenths of a second, the best of many offsets is one by chance: here 85 ms."""
    poses = good_log.object_poses[""]
    fade = np.exp(-1.0 / (0.3 * 30.0))
    white = np.random.default_rng(2).standard_normal((poses.frames.max() + 1, 3))
    lasting = lfilter([np.sqrt(1.0 - fade**2)], [1.0, -fade], white, axis=0)
    turn = Rotation.from_rotvec(0.06 * lasting[poses.frames])
    T = make_pose(turn * poses.T_cam_obj.rotation, poses.T_cam_obj.translation)
    write_log(tmp_path, replace(good_log, object_poses={"": replace(poses, T_cam_obj=T)}))
    assert "time-offset" not in names(diagnose(tmp_path).findings)


def test_a_calibration_that_cannot_be_read_states_no_time_offset(tmp_path) -> None:
    """The camera is not called early by what the unreadable file says of it."""
    write_log(tmp_path, simulate(SimulationOptions(duration_s=12.0, noise="white", timeshift_cam_imu_s=0.2)))
    file = tmp_path / "calibration.yaml"
    text = file.read_text()
    file.write_text(text.replace("gyroscope_noise_density: ", "gyroscope_noise_density: -"))
    assert names(diagnose(tmp_path).findings) == {"unreadable"}
    file.unlink()
    findings = {finding.check: finding for finding in diagnose(tmp_path).findings}
    assert findings.keys() == {"missing", "time-offset"}
    assert "set timeshift_cam_imu: 0.2" in findings["time-offset"].fix


def test_one_symmetric_object_does_not_put_the_ground_truth_elsewhere(tmp_path) -> None:
    """Its detections leave the camera's place on a circle open: they say nothing against the truth."""
    log = simulate(SimulationOptions(duration_s=12.0, objects=1, symmetric_objects=0, noise="white"))
    poses, (can,) = log.object_poses[""], log.landmark_map
    turns = np.random.default_rng(0).uniform(-np.pi, np.pi, len(poses))
    spun = poses.T_cam_obj.rotation * Rotation.from_rotvec(np.outer(turns, [0.0, 0.0, 1.0]))
    seen = replace(poses, T_cam_obj=make_pose(spun, poses.T_cam_obj.translation))
    can = replace(can, symmetry=Symmetry((0.0, 0.0, 1.0), "continuous"))
    write_log(tmp_path, replace(log, object_poses={"": seen}, landmark_map=LandmarkMap((can,))))
    assert not diagnose(tmp_path).findings


@pytest.mark.parametrize(
    "options",
    [
        SimulationOptions(duration_s=15.0, seed=101, odometry=True, camera_poses=True),
        SimulationOptions(duration_s=15.0, seed=102, odometry=True, camera_poses=True),
        SimulationOptions(duration_s=6.0, seed=9, camera_rate_hz=15.0, imu_rate_hz=100.0),
    ],
)
@pytest.mark.parametrize("axes", [np.diag([1.0, 1.0, -1.0]), np.eye(3)[[0, 2, 1]]])
def test_a_gyroscope_that_is_left_handed_is_told_and_nothing_else_is_turned(options, axes, tmp_path) -> None:
    log = simulate(options)
    write_log(tmp_path, replace(log, imu=replace(log.imu, angular_velocity=log.imu.angular_velocity @ axes.T)))
    assert names(diagnose(tmp_path).findings) == {"axes-mirrored"}


@pytest.mark.parametrize("seed", [101, 102, 103])
def test_ground_truth_of_another_body_is_neither_inverted_nor_blamed_on_the_calibration(seed, tmp_path) -> None:
    log = simulate(SimulationOptions(duration_s=15.0, seed=seed, odometry=True))
    write_log(tmp_path, replace(log, T_world_cam=log.T_world_imu))
    findings = diagnose(tmp_path).findings
    assert {finding.file for finding in findings} == {"T_world_cam.tum"}
    assert "ground-truth-apart" in names(findings)
    assert not any(finding.repairable for finding in findings)


def test_the_command(good_log, tmp_path, capsys) -> None:
    write_log(tmp_path, good_log)
    assert main(["check", str(tmp_path)]) == 0
    assert capsys.readouterr().out.strip() == "nothing found"
    bad = tmp_path / "bad"
    bad.mkdir()
    write_log(bad, inverse_extrinsics(good_log))
    assert main(["check", str(bad), "--json", "--fix", str(tmp_path / "fixed")]) == 1
    (finding,) = json.loads(capsys.readouterr().out)
    assert finding["check"] == "extrinsics-inverted"
    assert finding["evidence"]["correlation_inverted"] > 0.9
    assert main(["check", str(tmp_path / "fixed")]) == 0
    assert main(["check", str(tmp_path / "nowhere")]) == 1
    assert "does not exist" in capsys.readouterr().err


def test_a_trajectory_in_nanoseconds_is_told_with_line_and_remedy(good_log, tmp_path) -> None:
    write_log(tmp_path, good_log)
    path = tmp_path / "T_world_imu.tum"
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("".join(" ".join([first.replace(".", ""), *rest]) + "\n" for first, *rest in rows))
    (finding,) = diagnose(tmp_path).findings
    assert (finding.check, finding.file, finding.evidence["line"]) == ("unreadable", "T_world_imu.tum", 1)
    assert "is no time in seconds" in finding.what
    assert "TUM wants seconds" in finding.fix


@pytest.mark.parametrize("every", [1, 10, 30])
def test_odometry_that_is_slow_has_no_breaks(every) -> None:
    """Nor where its first pose comes within an interval of the first detection, and its last likewise."""
    log = simulate(SimulationOptions(duration_s=12.0, seed=4, odometry=True))
    assert breaks_of(replace(log, T_odom_cam=log.T_odom_cam[every - 1 :: every]), EXPECTED) == []


def test_odometry_is_expected_to_be_as_fusion_expects_it():
    assert expected_of(FuseOptions()) == EXPECTED


def test_stamps_of_whole_seconds_end_in_findings_and_not_in_a_traceback(good_log, tmp_path) -> None:
    """So few samples are left that they fill no twentieth of a second."""
    write_log(tmp_path, replace(good_log, T_world_imu=None, T_world_cam=None))
    for name in ("imu.csv", "object_poses.csv"):
        header, *rows = (tmp_path / name).read_text().splitlines()
        cells = [row.split(",", 1) for row in rows]
        rows = [f"{int(stamp) // 10**9},{rest}" for stamp, rest in cells]
        (tmp_path / name).write_text("\n".join([header, *rows]) + "\n")
    assert {"stamps-duplicate", "stamp-unit"} <= names(diagnose(tmp_path).findings)


@pytest.mark.parametrize(("reading", "finding"), [("wxyz", "quaternion-order"), ("inverse", "poses-inverted")])
def test_each_set_of_detections_is_looked_at(reading, finding, good_log, tmp_path) -> None:
    """A set that fits the map says nothing of another one that is written otherwise."""
    poses = good_log.object_poses[""]
    T = poses.T_cam_obj
    if reading == "wxyz":
        q_wxyz = np.roll(T.rotation.as_quat(), 1, axis=1)
        other = make_pose(Rotation.from_quat(q_wxyz), T.translation)
    else:
        other = T.inv()
    sets = {"right": poses, "wrong": replace(poses, T_cam_obj=other)}
    write_log(tmp_path, replace(good_log, object_poses=sets, imu=None))
    diagnosis = diagnose(tmp_path)
    found = [(each.check, each.file) for each in diagnosis.findings]
    assert (finding, "object_poses_wrong.csv") in found
    assert all(file == "object_poses_wrong.csv" for _, file in found)
    write_repaired(diagnosis, tmp_path.parent / f"fixed_{reading}")
    assert not diagnose(tmp_path.parent / f"fixed_{reading}").findings


@pytest.mark.parametrize("times", [2.5, 6.0])
def test_covariances_that_are_too_small_are_told_by_how_much(times, good_log):
    (finding,) = check_covariances(stated(times)(good_log))
    assert finding.evidence["times_too_small"] == pytest.approx(times, rel=0.1)
    for right in (1.0, 0.3):
        assert not list(check_covariances(stated(right)(good_log)))
