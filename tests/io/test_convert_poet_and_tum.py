from __future__ import annotations

import json

import numpy as np
import pytest
from io_strategies import random_poses, same_poses

from poet_loc.core.input_error import InputError
from poet_loc.core.records import ImuSamples, Landmark, LandmarkMap
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.convert_poet import ConvertPoetOptions, convert_poet
from poet_loc.io.convert_tum import ConvertTumOptions, convert_tum
from poet_loc.io.frames_csv import Frames, write_frames
from poet_loc.io.log_folder import Log, read_log, read_log_files, write_log
from poet_loc.io.poet_results import PoetResults, write_poet_results
from poet_loc.io.tum import write_tum

STAMPS = 1600059000000000001 + np.arange(4) * 33333333
POSES = random_poses(4, 0)


@pytest.fixture
def like(tmp_path):
    """A folder with a map and an IMU."""
    folder = tmp_path / "like"
    folder.mkdir()
    landmarks = LandmarkMap(tuple(Landmark(key, POSES[0]) for key in (1, 5)))
    imu = ImuSamples(STAMPS, np.ones((4, 3)), np.ones((4, 3)))
    write_log(folder, Log(folder, landmark_map=landmarks, imu=imu))
    return folder


@pytest.fixture
def results(tmp_path):
    boxes = np.full((4, 4), 0.5)
    found = PoetResults(("1", "2", "3"), np.array([0, 0, 1, 2]), np.array([2, 2, 1, 2]), POSES, boxes)
    write_poet_results(tmp_path / "results.json", found)
    write_frames(tmp_path / "frames.csv", Frames(STAMPS[:3], np.arange(3), ("a_3.png", "a_2.png", "a_1.png")))
    (tmp_path / "classes.json").write_text('{"1": "ape", "5": "can", "6": "cat"}')
    return tmp_path / "results.json"


def test_poet_results_become_a_log(results, like, tmp_path):
    options = ConvertPoetOptions(tmp_path / "frames.csv", classes=tmp_path / "classes.json", like=like)
    log = convert_poet(results, tmp_path / "log", options)
    again = read_log(tmp_path / "log")
    name, poses = again.detections()
    assert name == "poet"
    assert poses.stamps_ns.tolist() == [STAMPS[0], STAMPS[1], STAMPS[2], STAMPS[2]]
    assert poses.object_ids.tolist() == [5, 1, 5, 5]
    assert poses.instances.tolist() == [0, 0, 0, 1]
    assert same_poses(poses.T_cam_obj, POSES[np.array([3, 2, 0, 1])])
    assert again.imu is not None
    assert again.frames.images == log.frames.images == ("a_3.png", "a_2.png", "a_1.png")


def test_poet_log_waits_for_its_map(results, tmp_path):
    convert_poet(results, tmp_path / "log", ConvertPoetOptions(tmp_path / "frames.csv"))
    assert read_log_files(tmp_path / "log").object_poses["poet"].object_ids.tolist() == [2, 1, 2, 2]
    with pytest.raises(InputError, match=r"has no landmarks\.json"):
        read_log(tmp_path / "log")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"classes": None}, r"results\.json: has objects 2; the map of .*like has 1, 5; give .* --classes"),
        ({"classes": "short.json"}, "class 2 has no object id"),
        ({"classes": "words.json"}, "is no classes file"),
        ({"stamps": "late.csv"}, "no common time span"),
        ({"stamps": "few.csv"}, "no stamp for image 1"),
        ({"out": "like"}, "has results"),
        ({"out": "like", "overwrite": True}, "holds the input"),
    ],
)
def test_poet_log_that_cannot_be(results, like, tmp_path, change, what):
    (tmp_path / "short.json").write_text('{"1": "ape"}')
    (tmp_path / "words.json").write_text('{"ape": 1}')
    images = ("a_3.png", "a_2.png", "a_1.png")
    write_frames(tmp_path / "late.csv", Frames(STAMPS[:3] + 10**12, np.arange(3), images))
    write_frames(tmp_path / "few.csv", Frames(STAMPS[:2], np.arange(2), images[:2]))
    names = {"stamps": "frames.csv", "classes": "classes.json", "out": "log", "overwrite": False} | change
    classes = None if names["classes"] is None else tmp_path / names["classes"]
    options = ConvertPoetOptions(tmp_path / names["stamps"], classes, like, overwrite=names["overwrite"])
    with pytest.raises(InputError, match=what):
        convert_poet(results, tmp_path / names["out"], options)
    assert not (tmp_path / "log").exists()
    assert len(read_log_files(like).imu) == 4


def test_official_results(shared_fixtures, tmp_path):
    official = shared_fixtures / "poet_official" / "eval" / "inference_results.json"
    names = tuple(f"frame_{image}.png" for image in json.loads(official.read_text()))
    write_frames(tmp_path / "frames.csv", Frames(STAMPS[: len(names)], np.arange(len(names)), names))
    log = convert_poet(official, tmp_path / "log", ConvertPoetOptions(tmp_path / "frames.csv"))
    assert len(log.object_poses["poet"]) == 6


def test_tum_trajectory_becomes_camera_poses(like, tmp_path):
    write_tum(tmp_path / "slam.tum", Trajectory(STAMPS, POSES))
    options = ConvertTumOptions(position_sigma_m=0.01, attitude_sigma_deg=180 / np.pi * 0.02, like=like)
    convert_tum(tmp_path / "slam.tum", tmp_path / "log", options)
    log = read_log(tmp_path / "log")
    np.testing.assert_array_equal(log.camera_poses.stamps_ns, STAMPS)
    assert same_poses(log.camera_poses.T_world_cam, POSES)
    np.testing.assert_allclose(log.camera_poses.covariances[2], np.diag([4e-4] * 3 + [1e-4] * 3), rtol=1e-12)
    assert log.imu is not None


def test_tum_poses_the_other_way_round(tmp_path):
    write_tum(tmp_path / "slam.tum", Trajectory(STAMPS, POSES.inv()))
    convert_tum(tmp_path / "slam.tum", tmp_path / "log", ConvertTumOptions(holds="T_cam_world"))
    log = read_log(tmp_path / "log")
    np.testing.assert_allclose(log.camera_poses.T_world_cam.as_matrix(), POSES.as_matrix(), atol=1e-13)
    assert log.camera_poses.covariances is None


def test_quaternions_with_the_scalar_first(tmp_path):
    x, y, z, w = POSES[0].rotation.as_quat()
    t = " ".join(map(str, POSES[0].translation))
    (tmp_path / "slam.tum").write_text(f"1600059000.5 {t} {w} {x} {y} {z}\n")
    convert_tum(tmp_path / "slam.tum", tmp_path / "log", ConvertTumOptions(quaternion="wxyz"))
    log = read_log(tmp_path / "log")
    np.testing.assert_allclose(log.camera_poses.T_world_cam.as_matrix()[0], POSES[0].as_matrix(), atol=1e-13)


@pytest.mark.parametrize("sigmas", [{"position_sigma_m": 0.01}, {"position_sigma_m": 0.01, "attitude_sigma_deg": 0.0}])
def test_incomplete_sigmas(tmp_path, sigmas):
    write_tum(tmp_path / "slam.tum", Trajectory(STAMPS, POSES))
    with pytest.raises(InputError, match="sigmas"):
        convert_tum(tmp_path / "slam.tum", tmp_path / "log", ConvertTumOptions(**sigmas))
    assert not (tmp_path / "log").exists()
