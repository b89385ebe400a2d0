"""Rendered videos are logs: poses, map, IMU and images belong to one motion."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from poet_loc.core.input_error import InputError
from poet_loc.io.bop import read_bop_scene
from poet_loc.io.calibration_yaml import read_calibration
from poet_loc.io.frames_csv import read_frames
from poet_loc.io.imu_csv import read_imu
from poet_loc.io.landmarks_json import read_landmarks
from poet_loc.io.tum import read_tum
from poet_loc.videos import VideoOptions, log_from_pixels, render_videos


def options(out: Path, **changes) -> VideoOptions:
    settings = {
        "videos": 1,
        "duration_s": (2.0, 2.0),
        "size": (80, 60),
        "focal_px": 102.5,
        "jobs": 1,
        "progress": False,
    }
    return VideoOptions(out=out, **(settings | changes))


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    return render_videos(options(tmp_path_factory.mktemp("videos")))[0]


def test_landmarks_are_where_the_annotations_say(video):
    scene = read_bop_scene(video)
    landmarks = {landmark.object_id: landmark for landmark in read_landmarks(video / "landmarks.json")}
    assert 4 <= len(landmarks) <= 6
    T_world_cam = read_tum(video / "T_world_cam.tum").T_world_body
    found = scene.annotations
    for row in range(0, len(found), 17):
        expected = landmarks[int(found.object_ids[row])].T_world_obj
        T_world_obj = T_world_cam[int(found.image_ids[row])] * found.T_cam_obj[row]
        np.testing.assert_allclose(T_world_obj.as_matrix(), expected.as_matrix(), atol=2e-6)


def test_frames_images_and_ground_truth_share_their_stamps(video):
    frames, truth = read_frames(video / "frames.csv"), read_tum(video / "T_world_cam.tum")
    np.testing.assert_array_equal(frames.stamps_ns, truth.stamps_ns)
    assert np.median(np.diff(frames.stamps_ns)) == pytest.approx(1e9 / 30, abs=1)
    assert all((video / image).exists() for image in frames.images)


def test_the_imu_moved_with_the_camera(video):
    calibration, imu = read_calibration(video / "calibration.yaml"), read_imu(video / "imu.csv")
    T_world_imu, T_world_cam = read_tum(video / "T_world_imu.tum"), read_tum(video / "T_world_cam.tum")
    at_frames, valid = T_world_imu.interpolate(T_world_cam.stamps_ns)
    assert valid.all()
    gap = (T_world_cam.T_world_body * calibration.T_cam_imu).inv() * at_frames
    assert np.linalg.norm(gap.translation, axis=1).max() < 1e-4
    first = imu.specific_force[:40].mean(0)  # it starts at rest
    up_imu = T_world_imu.T_world_body[0].rotation.inv().apply([0, 0, 9.81])
    np.testing.assert_allclose(first, up_imu, atol=0.5)  # up to the bias


def test_images_change_only_as_the_camera_moves(video):
    def image(number: int) -> np.ndarray:
        return cv2.imread(str(video / f"rgb/{number:06d}.jpg")).astype(float)

    count = len(read_frames(video / "frames.csv"))
    near, far = np.abs(image(0) - image(1)).mean(), np.abs(image(0) - image(count - 1)).mean()
    assert near < 8
    assert far > near


def test_same_seed_same_bytes_other_number_other_video(video, tmp_path):
    (again,) = render_videos(options(tmp_path))
    for name in ("imu.csv", "landmarks.json", "scene_gt.json", "rgb/000009.jpg"):
        assert (again / name).read_bytes() == (video / name).read_bytes()
    (other,) = render_videos(options(tmp_path, first=1))
    assert json.loads((other / "landmarks.json").read_text()) != json.loads((video / "landmarks.json").read_text())


def test_senseless_options_are_refused(tmp_path):
    with pytest.raises(InputError):
        render_videos(options(tmp_path, objects=(4, 11)))
    with pytest.raises(InputError):
        render_videos(options(tmp_path, duration_s=(5.0, 3.0)))


def test_a_log_from_pixels_has_the_poses_that_the_network_gave(tmp_path):
    from poet_loc.detect.options import DetectOptions
    from poet_loc.model.checkpoint import ModelConfig, save_model
    from poet_loc.model.options import NetworkOptions
    from poet_loc.model.poet import PoET
    from poet_loc.model.small_detector import SmallDetector, SmallDetectorOptions

    small = SmallDetectorOptions(widths=(8, 8, 16, 16), blocks=(0, 0, 0, 0), pyramid_dim=12, score_threshold=0.001)
    network = NetworkOptions(
        32, 4, 1, 1, 32, levels=3, map_channels=(16, 16, 16), class_count=10, translation="ray", uncertainty="aleatoric"
    )
    torch.manual_seed(0)
    weights = tmp_path / "random.safetensors"
    save_model(weights, PoET(network, SmallDetector(small)), ModelConfig(network, small))
    log = log_from_pixels(options(tmp_path, objects=(10, 10)), detection=DetectOptions(weights))
    poses = log.detections()[1]
    assert len(poses) > 0
    assert set(poses.stamps_ns) <= set(log.frames.stamps_ns)
    assert np.all(poses.T_cam_obj.translation[:, 2] > 0)
    assert poses.covariances.shape == (len(poses), 6, 6)
