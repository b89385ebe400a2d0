from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from io_strategies import random_poses, same_poses
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import local, make_pose, retract
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Symmetry
from poet_loc.io.bop import BopAnnotations, BopScene, write_bop_scene
from poet_loc.io.bop_models import BopModel, write_models_info
from poet_loc.io.bop_results_csv import BopResults, write_bop_results
from poet_loc.io.convert_bop import ConvertBopOptions, convert_bop
from poet_loc.io.frames_csv import Frames, write_frames
from poet_loc.io.log_folder import read_log

OBJECTS = ((2, 0), (13, 0), (13, 1))
T_WORLD_OBJ = random_poses(3, 100)
OFFSET = make_pose(Rotation.from_quat([0.00075, -0.00287, -0.01066, 0.99994]), [0.02627, -0.00017, 0.00028])
IDS = np.arange(1, 31)


def trajectory(seed: int, count: int = 30) -> RigidTransform:
    rng = np.random.default_rng(seed)
    rotations = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.5)
    return make_pose(rotations, rng.normal(size=(count, 3)) + [0, 0, 5])


def write_scene(folder: Path, seed: int, offset: RigidTransform | None = None, **changes) -> RigidTransform:
    """Write a scene whose annotations are exact; return the true T_world_cam."""
    folder.mkdir(parents=True)
    T_world_cam = trajectory(seed)
    published = T_world_cam if offset is None else T_world_cam * offset.inv()
    rows = np.repeat(np.arange(30), 3)
    T_cam_obj = T_world_cam.inv()[rows] * T_WORLD_OBJ[np.tile(np.arange(3), 30)]
    annotations = {
        "image_ids": IDS[rows],
        "object_ids": np.tile([2, 13, 13], 30),
        "T_cam_obj": T_cam_obj,
        "visible_fractions": np.where(np.arange(90) < 4, 0.05, 1.0),
        "boxes_object_px": np.ones((90, 4)),
        "boxes_visible_px": np.ones((90, 4)),
    } | changes
    matrices = np.tile([[600.0, 0, 320], [0, 610, 240], [0, 0, 1]], (30, 1, 1))
    write_bop_scene(folder, BopScene(IDS, matrices, published.inv(), BopAnnotations(**annotations)))
    return T_world_cam


@pytest.fixture
def dataset(tmp_path) -> Path:
    root = tmp_path / "ycbv"
    write_scene(root / "test" / "000048", 0)
    write_scene(root / "test" / "000049", 1)
    return root


@pytest.mark.parametrize("below", ["", "test", "test/000048"])
def test_one_log_per_scene(dataset, tmp_path, below):
    conversion = convert_bop(dataset / below, tmp_path / "logs")
    names = ["000048"] if "000048" in below else ["000048", "000049"]
    assert [scene.log for scene in conversion.scenes] == [tmp_path / "logs" / name for name in names]
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == names
    log = read_log(tmp_path / "logs" / "000048")
    assert log.detections()[0] == "gt"
    assert same_poses(log.T_world_cam.T_world_body, trajectory(0))
    np.testing.assert_array_equal(log.T_world_cam.stamps_ns, np.rint(IDS * 1e9 / 30))
    assert [landmark.key for landmark in log.landmark_map] == list(OBJECTS)
    np.testing.assert_allclose(log.landmark_map.T_world_obj.as_matrix(), T_WORLD_OBJ.as_matrix(), atol=1e-9)
    assert log.calibration.camera.intrinsics == (600, 610, 320, 240)
    assert log.frames.frames.tolist() == IDS.tolist()
    placements = conversion.scenes[0].placements
    assert [place.key for place in placements] == list(OBJECTS)
    assert max(place.distance_p90_m for place in placements) < 1e-9


def test_ground_truth_becomes_detections_where_it_is_visible(dataset, tmp_path):
    scene = convert_bop(dataset, tmp_path / "logs").scenes[0]
    _, poses = read_log(scene.log).detections()
    assert scene.detections == len(poses) == 86
    all_poses = convert_bop(dataset, tmp_path / "all", ConvertBopOptions(min_visible=0.0)).scenes[0]
    log = read_log(all_poses.log)
    _, poses = log.detections()
    assert len(poses) == 90
    votes = log.landmark_map.T_world_obj[np.tile(np.arange(3), 30)] * poses.T_cam_obj.inv()
    np.testing.assert_allclose(votes.as_matrix(), trajectory(0)[np.repeat(np.arange(30), 3)].as_matrix(), atol=1e-8)


def test_images_give_resolution_and_paths(dataset, tmp_path):
    (dataset / "test" / "000048" / "rgb").mkdir()
    Image.new("RGB", (64, 48)).save(dataset / "test" / "000048" / "rgb" / "000001.png")
    log = read_log(convert_bop(dataset, tmp_path / "logs").scenes[0].log)
    assert log.calibration.camera.resolution == (64, 48)
    assert (log.path / log.frames.images[0]).resolve() == dataset / "test" / "000048" / "rgb" / "000001.png"
    assert log.frames.images[1] == ""


def test_stamps_from_a_file_are_exact(dataset, tmp_path):
    stamps = 1600059000000000001 + IDS * 33333333
    write_frames(tmp_path / "000048.csv", Frames(stamps, IDS, ("",) * 30))
    write_frames(tmp_path / "000049.csv", Frames(stamps[::1], IDS, ("",) * 30))
    logs = convert_bop(dataset, tmp_path / "logs", ConvertBopOptions(stamps=tmp_path)).scenes
    assert read_log(logs[1].log).T_world_cam.stamps_ns.tolist() == stamps.tolist()
    write_frames(tmp_path / "000048.csv", Frames(stamps[:-1], IDS[:-1], ("",) * 29))
    with pytest.raises(InputError, match=r"000048\.csv: has no stamp for image 30 of scene 000048"):
        convert_bop(dataset, tmp_path / "more", ConvertBopOptions(stamps=tmp_path))
    assert not (tmp_path / "more").exists()


def test_symmetries_come_from_the_models(dataset, tmp_path):
    (dataset / "models").mkdir()
    box = ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    models = {
        13: BopModel(0.1, box, symmetries_continuous=(((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),)),
        2: BopModel(0.1, box),
    }
    write_models_info(dataset / "models" / "models_info.json", models)
    landmarks = read_log(convert_bop(dataset / "test", tmp_path / "logs").scenes[0].log).landmark_map
    assert [landmark.symmetry for landmark in landmarks] == [None, *[Symmetry((0, 0, 1), "continuous")] * 2]


def test_up_becomes_z(dataset, tmp_path):
    log = read_log(convert_bop(dataset, tmp_path / "logs", ConvertBopOptions(up=(0, -2, 0))).scenes[0].log)
    turn = (log.T_world_cam.T_world_body * trajectory(0).inv()).rotation.as_matrix()
    np.testing.assert_allclose(turn @ [0, -1, 0], np.tile([0, 0, 1], (30, 1)), atol=1e-9)
    np.testing.assert_allclose(
        (turn[0] @ T_WORLD_OBJ.translation.T).T, log.landmark_map.T_world_obj.translation, atol=1e-9
    )


def test_estimates_from_a_results_file(dataset, tmp_path):
    images, objects = [1, 1, 1, 5, 5, 1], [13, 13, 2, 2, 99, 2]
    scores = np.array([0.3, 0.9, 0.5, 0.5, 0.9, 0.7])
    poses = random_poses(6, 3)
    scenes = np.array([48, 48, 48, 48, 48, 49])
    results = BopResults(scenes, np.array(images), np.array(objects), scores, poses, np.ones(6))
    write_bop_results(tmp_path / "results.csv", results)
    conversion = convert_bop(dataset, tmp_path / "logs", ConvertBopOptions(results=tmp_path / "results.csv"))
    assert [(scene.detections, scene.dropped) for scene in conversion.scenes] == [(4, 1), (1, 0)]
    name, detections = read_log(conversion.scenes[0].log).detections()
    assert name == ""
    assert detections.object_ids.tolist() == [2, 13, 13, 2]
    assert detections.instances.tolist() == [0, 0, 1, 0]
    assert detections.scores.tolist() == [0.5, 0.9, 0.3, 0.5]
    assert detections.stamps_ns.tolist() == [33333333, 33333333, 33333333, 166666667]
    assert same_poses(detections.T_cam_obj, poses[np.array([2, 1, 0, 3])])
    write_bop_results(tmp_path / "results.csv", replace(results, scene_ids=0 * scenes + 48))
    with pytest.raises(InputError, match="has no estimates of scene 000049"):
        convert_bop(dataset, tmp_path / "more", ConvertBopOptions(results=tmp_path / "results.csv"))


def test_a_trajectory_of_another_camera_is_told_and_fitted(tmp_path):
    root = tmp_path / "ycbv"
    truths = [write_scene(root / f"00004{seed}", seed, OFFSET) for seed in (8, 9)]
    with pytest.raises(InputError) as caught:
        convert_bop(root, tmp_path / "logs")
    assert "spreads by" in str(caught.value)
    assert "(26.3, -0.2, 0.3) mm and 1.27 deg away; pass --fit-camera-offset" in str(caught.value)
    assert not (tmp_path / "logs").exists()
    conversion = convert_bop(root, tmp_path / "logs", ConvertBopOptions(fit_camera_offset=True))
    np.testing.assert_allclose(local(OFFSET, conversion.T_trajectory_annotation), 0, atol=1e-9)
    for scene, truth in zip(conversion.scenes, truths, strict=True):
        log = read_log(scene.log)
        np.testing.assert_allclose(log.T_world_cam.T_world_body.as_matrix(), truth.as_matrix(), atol=1e-8)
        np.testing.assert_allclose(log.landmark_map.T_world_obj.as_matrix(), T_WORLD_OBJ.as_matrix(), atol=1e-8)


def test_frames_that_do_not_agree_are_refused(tmp_path):
    exact = trajectory(0).inv()[np.repeat(np.arange(30), 3)] * T_WORLD_OBJ[np.tile(np.arange(3), 30)]
    shifts = np.random.default_rng(0).normal(size=(90, 6)) * 0.02
    write_scene(tmp_path / "000001", 0, T_cam_obj=retract(exact, shifts))
    with pytest.raises(InputError, match=r"object \d+ spreads by .* over 30 frames; raise --max-spread-mm"):
        convert_bop(tmp_path, tmp_path / "logs")
    loose = ConvertBopOptions(max_spread_mm=100, max_spread_deg=10)
    landmarks = read_log(convert_bop(tmp_path, tmp_path / "logs", loose).scenes[0].log).landmark_map
    errors = local(T_WORLD_OBJ, landmarks.T_world_obj)
    assert np.abs(errors).max() < 0.02
    with pytest.raises(InputError, match="fit groups of scenes apart"):
        convert_bop(tmp_path / "000001", tmp_path / "more", ConvertBopOptions(fit_camera_offset=True))


def test_scenes_are_chosen(dataset, tmp_path):
    conversion = convert_bop(dataset, tmp_path / "logs", ConvertBopOptions(scenes=(49,)))
    assert [scene.log.name for scene in conversion.scenes] == ["000049"]
    with pytest.raises(InputError, match="has no scene 50"):
        convert_bop(dataset, tmp_path / "more", ConvertBopOptions(scenes=(50,)))


def test_results_are_not_overwritten_and_nothing_is_half_written(dataset, tmp_path):
    convert_bop(dataset, tmp_path / "logs")
    with pytest.raises(InputError, match="has results"):
        convert_bop(dataset, tmp_path / "logs")
    (dataset / "test" / "000049" / "scene_gt.json").write_text("{")
    with pytest.raises(InputError, match="is no JSON"):
        convert_bop(dataset, tmp_path / "logs", ConvertBopOptions(overwrite=True))
    assert len(read_log(tmp_path / "logs" / "000049").T_world_cam) == 30
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logs", "ycbv"]


def test_what_is_no_scene(dataset, tmp_path):
    folder = dataset / "test" / "000048"

    def refused(what: str, options: ConvertBopOptions | None = None) -> None:
        with pytest.raises(InputError, match=what):
            convert_bop(folder, tmp_path / "logs", options)

    refused("--up is zero", ConvertBopOptions(up=(0, 0, 0)))
    refused("--frame-rate is 0", ConvertBopOptions(frame_rate=0))
    cameras = json.loads((folder / "scene_camera.json").read_text())
    (folder / "scene_camera.json").write_text(json.dumps({key: cameras[key] for key in list(cameras)[:-1]}))
    refused(r"scene_gt\.json: image 30 is not in scene_camera\.json")
    del cameras["3"]["cam_R_w2c"]
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    refused("images without cam_R_w2c")
    (folder / "scene_gt.json").unlink()
    (folder / "scene_camera.json").unlink()
    refused("has no scene_camera.json")
    with pytest.raises(InputError, match="is no folder"):
        convert_bop(tmp_path / "nowhere", tmp_path / "logs")


def test_real_trajectories_with_the_depth_cameras_offset(shared_data, tmp_path):
    """The shared logs turned back into what YCB-V publishes: found, fitted, and equal to the corrected logs."""
    for name in ("0050", "0059"):
        log = read_log(shared_data / "ycbv_dope" / name, "supervised")
        T_world_cam, ids = log.T_world_cam.T_world_body[::5], np.arange(len(log.T_world_cam))[::5]
        folder = tmp_path / "ycbv" / f"00{name}"
        folder.mkdir(parents=True)
        keys, count = [landmark.object_id for landmark in log.landmark_map], len(ids)
        rows = np.repeat(np.arange(count), len(keys))
        objects = log.landmark_map.T_world_obj[np.tile(np.arange(len(keys)), count)]
        seen = BopAnnotations(ids[rows], np.tile(keys, count), T_world_cam.inv()[rows] * objects)
        matrices = np.tile(np.eye(3), (count, 1, 1))
        write_bop_scene(folder, BopScene(ids, matrices, (T_world_cam * OFFSET.inv()).inv(), seen))
    with pytest.raises(InputError, match="pass --fit-camera-offset"):
        convert_bop(tmp_path / "ycbv", tmp_path / "logs")
    conversion = convert_bop(tmp_path / "ycbv", tmp_path / "logs", ConvertBopOptions(fit_camera_offset=True))
    error = local(OFFSET, conversion.T_trajectory_annotation)
    assert np.abs(error).max() < 1e-6
