from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from io_strategies import random_covariances, random_poses, same_poses

from poet_loc.core.input_error import InputError
from poet_loc.core.records import (
    Calibration,
    Camera,
    CameraPoses,
    ImuNoise,
    ImuSamples,
    Landmark,
    LandmarkMap,
    ObjectPoses,
)
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.frames_csv import Frames
from poet_loc.io.log_folder import Log, read_log, read_log_files, write_log

START = 1600059000033333333


def object_poses(object_ids: list[int], start: int = START) -> ObjectPoses:
    count = len(object_ids)
    stamps = start + np.arange(count) * 33333333
    ids = np.array(object_ids, np.int64)
    return ObjectPoses(stamps, np.arange(count), ids, 0 * ids, np.ones(count), random_poses(count, 0))


def full_log(path: Path) -> Log:
    stamps = START + np.arange(4) * 50000000
    return Log(
        path=path,
        object_poses={"near": object_poses([2, 9, 2]), "far_away": object_poses([9])},
        landmark_map=LandmarkMap((Landmark(2, random_poses(1, 1)[0]), Landmark(9, random_poses(1, 2)[0]))),
        camera_poses=CameraPoses(stamps, np.arange(4), random_poses(4, 3), random_covariances(4, 4)),
        imu=ImuSamples(stamps, np.ones((4, 3)), np.full((4, 3), 9.81)),
        calibration=Calibration(
            random_poses(1, 5)[0], 0.01, Camera((600.0, 600.0, 320.0, 240.0)), ImuNoise(1e-3, 1e-3, 1e-5, 1e-5, 200.0)
        ),
        T_world_cam=Trajectory(stamps, random_poses(4, 6)),
        T_world_imu=Trajectory(stamps, random_poses(4, 7)),
        T_odom_cam=Trajectory(stamps, random_poses(4, 8)),
        frames=Frames(stamps, np.arange(4), ("a.png", "b.png", "c.png", "d.png")),
    )


@pytest.fixture
def folder(tmp_path) -> Path:
    write_log(tmp_path, full_log(tmp_path))
    return tmp_path


def test_round_trip(folder):
    log, again = full_log(folder), read_log(folder)
    assert sorted(path.name for path in folder.iterdir()) == [
        "T_odom_cam.tum",
        "T_world_cam.tum",
        "T_world_imu.tum",
        "calibration.yaml",
        "camera_poses.csv",
        "frames.csv",
        "imu.csv",
        "landmarks.json",
        "object_poses_far_away.csv",
        "object_poses_near.csv",
    ]
    assert set(again.object_poses) == {"near", "far_away"}
    for name in ("camera_poses", "imu", "T_world_cam", "T_world_imu", "T_odom_cam", "frames"):
        np.testing.assert_array_equal(getattr(again, name).stamps_ns, getattr(log, name).stamps_ns)
    np.testing.assert_array_equal(again.object_poses["near"].stamps_ns, log.object_poses["near"].stamps_ns)
    assert same_poses(again.T_odom_cam.T_world_body, log.T_odom_cam.T_world_body)
    assert same_poses(again.landmark_map.T_world_obj, log.landmark_map.T_world_obj)
    assert same_poses(again.calibration.T_cam_imu, log.calibration.T_cam_imu)
    assert replace(again.calibration, T_cam_imu=None) == replace(log.calibration, T_cam_imu=None)
    assert again.frames.images == log.frames.images


def test_choice_of_detections(folder, refusal):
    log = read_log(folder)
    assert log.detections("near")[0] == "near"
    with pytest.raises(InputError, match="several sets of detections: far_away, near; choose one with --detections"):
        log.detections(None)
    with pytest.raises(InputError, match=r"has no object_poses_nearest\.csv; choose among object_poses_far_away\.csv"):
        log.detections("nearest")
    assert "choose among" in str(refusal(read_log, folder, "nearest"))
    (folder / "object_poses_near.csv").rename(folder / "object_poses.csv")
    name, poses = read_log(folder).detections()
    assert (name, len(poses)) == ("", 3)
    (folder / "object_poses.csv").unlink()
    assert read_log(folder).detections()[0] == "far_away"
    (folder / "object_poses_far_away.csv").unlink()
    with pytest.raises(InputError, match=r"has no object_poses\.csv"):
        read_log(folder).detections()


def test_only_the_named_detections_are_read(folder):
    (folder / "object_poses_far_away.csv").write_text("broken")
    assert set(read_log(folder, "near").object_poses) == {"near"}
    with pytest.raises(InputError, match="is missing"):
        read_log(folder)


def test_what_a_log_needs(folder, refusal, tmp_path_factory):
    assert "does not exist" in str(refusal(read_log, folder / "nowhere"))
    assert "no log folder" in str(refusal(read_log, folder / "imu.csv"))
    empty = tmp_path_factory.mktemp("empty")
    assert "has no object_poses.csv" in str(refusal(read_log, empty))
    shutil.copy(folder / "object_poses_near.csv", empty)
    assert "has no landmarks.json" in str(refusal(read_log, empty))
    assert set(read_log_files(empty).object_poses) == {"near"}
    shutil.copy(folder / "camera_poses.csv", empty)
    assert read_log(empty).landmark_map is None
    (empty / "object_poses_near.csv").unlink()
    assert not read_log(empty).object_poses


def test_an_object_that_is_not_in_the_map(folder, refusal):
    write_log(folder, Log(folder, {"near": object_poses([2, 9, 7, 2])}))
    error = refusal(read_log, folder)
    assert error.path == folder / "object_poses_near.csv"
    assert error.line == 4
    assert "object 7 is not in the map (it has 2, 9)" in str(error)
    assert "landmarks.json" in error.fix
    write_log(folder, Log(folder, {"near": object_poses([2, 9, 7, 11, 7])}))
    assert "object 7 is not in the map (it has 2, 9); not in it: 7 (2 rows), 11 (1 rows)" in str(
        refusal(read_log, folder)
    )


@pytest.mark.parametrize("name", ["imu", "camera_poses", "T_world_cam", "T_world_imu", "T_odom_cam", "frames"])
def test_no_common_time_span(folder, refusal, name):
    record = getattr(full_log(folder), name)
    write_log(folder, Log(folder, **{name: replace(record, stamps_ns=record.stamps_ns + 3_600_000_000_000)}))
    error = refusal(read_log, folder)
    assert "no common time span" in str(error)
    assert name in str(error)


def test_the_time_shift_counts_for_the_common_time_span(folder):
    """Clocks 100 s apart are one clock after t_imu = t_cam + timeshift_cam_imu."""
    log = full_log(folder)
    imu = replace(log.imu, stamps_ns=log.imu.stamps_ns + 100 * 10**9)
    truth = replace(log.T_world_imu, stamps_ns=log.T_world_imu.stamps_ns + 100 * 10**9)
    calibration = replace(log.calibration, timeshift_cam_imu_s=100.0)
    write_log(folder, Log(folder, imu=imu, T_world_imu=truth, calibration=calibration))
    assert read_log(folder).calibration.timeshift_cam_imu_s == 100
    write_log(folder, Log(folder, calibration=replace(calibration, timeshift_cam_imu_s=-100.0)))
    with pytest.raises(InputError, match=r"no common time span.*timeshift_cam_imu = -100 s"):
        read_log(folder)


def test_shared_logs(shared_data, tmp_path):
    folders = sorted(path.parent for path in shared_data.glob("**/imu.csv"))
    assert len(folders) == 13
    for folder in folders:
        log = read_log(folder)
        assert log.landmark_map is not None
        assert log.T_world_imu is not None
        assert log.calibration.T_cam_imu is not None
        if folder.name not in {"0029", "0053", "euroc_v101"}:
            continue
        (tmp_path / folder.name).mkdir()
        write_log(tmp_path / folder.name, log)
        again = read_log(tmp_path / folder.name)
        assert set(again.object_poses) == set(log.object_poses)
        np.testing.assert_array_equal(again.T_world_imu.stamps_ns, log.T_world_imu.stamps_ns)
        np.testing.assert_array_equal(again.imu.angular_velocity, log.imu.angular_velocity)
