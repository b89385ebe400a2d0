from __future__ import annotations

import json

import numpy as np
import pytest
from io_strategies import random_poses, same_poses
from scipy.spatial.transform import Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.io.bop import BopAnnotations, BopScene, read_bop_scene, write_bop_scene

CAMERA = """{
 "1": {"cam_K": [1066.8, 0.0, 312.9, 0.0, 1067.5, 241.3, 0.0, 0.0, 1.0], "depth_scale": 0.1,
       "cam_R_w2c": [0, -1, 0, 1, 0, 0, 0, 0, 1], "cam_t_w2c": [100.0, 200.0, 1500.0]},
 "36": {"cam_K": [1066.8, 0.0, 312.9, 0.0, 1067.5, 241.3, 0.0, 0.0, 1.0], "depth_scale": 0.1,
        "cam_R_w2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_w2c": [0.0, 0.0, 1000.0]}
}
"""
GROUND_TRUTH = """{
 "1": [{"cam_R_m2c": [1, 0, 0, 0, 0, -1, 0, 1, 0], "cam_t_m2c": [-10.5, 20.25, 900.0], "obj_id": 5},
       {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0.0, 0.0, 800.0], "obj_id": 5}],
 "36": [{"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0.0, 0.0, 700.0], "obj_id": 2}]
}
"""
INFO = """{
 "1": [{"bbox_obj": [10, 20, 30, 40], "bbox_visib": [12, 20, 28, 40], "visib_fract": 0.75},
       {"bbox_obj": [1, 2, 3, 4], "bbox_visib": [-1, -1, -1, -1], "visib_fract": 0.0}],
 "36": [{"bbox_obj": [5, 6, 7, 8], "bbox_visib": [5, 6, 7, 8], "visib_fract": 1.0}]
}
"""


@pytest.fixture
def scene_folder(tmp_path):
    (tmp_path / "scene_camera.json").write_text(CAMERA)
    (tmp_path / "scene_gt.json").write_text(GROUND_TRUTH)
    (tmp_path / "scene_gt_info.json").write_text(INFO)
    return tmp_path


def test_golden_files(scene_folder):
    scene = read_bop_scene(scene_folder)
    assert scene.image_ids.tolist() == [1, 36]
    np.testing.assert_array_equal(scene.camera_matrices[1], [[1066.8, 0, 312.9], [0, 1067.5, 241.3], [0, 0, 1]])
    np.testing.assert_array_equal(scene.depth_scales, [0.1, 0.1])
    # T_cam_world, row-major, millimetres: the world's x axis points along the camera's y
    np.testing.assert_allclose(scene.T_cam_world[0].apply([1, 0, 0]), [0.1, 1.2, 1.5], atol=1e-15)
    truth = scene.annotations
    assert truth.image_ids.tolist() == [1, 1, 36]
    assert truth.object_ids.tolist() == [5, 5, 2]
    np.testing.assert_allclose(truth.T_cam_obj[0].apply([0, 1, 0]), [-0.0105, 0.02025, 1.9], atol=1e-15)
    assert truth.visible_fractions.tolist() == [0.75, 0, 1]
    assert truth.boxes_object_px.tolist()[0] == [10, 20, 30, 40]
    assert truth.boxes_visible_px.tolist()[1] == [-1, -1, -1, -1]


def test_what_may_be_missing(scene_folder):
    (scene_folder / "scene_gt_info.json").unlink()
    assert read_bop_scene(scene_folder).annotations.visible_fractions is None
    (scene_folder / "scene_gt.json").unlink()
    assert read_bop_scene(scene_folder).annotations is None
    (scene_folder / "scene_camera.json").write_text('{"3": {"cam_K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}')
    scene = read_bop_scene(scene_folder)
    assert (scene.image_ids.tolist(), scene.T_cam_world, scene.depth_scales) == ([3], None, None)


@pytest.mark.parametrize("full", [True, False])
def test_round_trip(tmp_path, full):
    rng = np.random.default_rng(0)
    ids = np.array([1, 7, 12])
    annotations = BopAnnotations(
        image_ids=np.array([1, 1, 12]),
        object_ids=np.array([3, 21, 3]),
        T_cam_obj=random_poses(3, 1),
        visible_fractions=rng.uniform(size=3) if full else None,
        boxes_object_px=rng.uniform(0, 640, (3, 4)) if full else None,
        boxes_visible_px=rng.uniform(0, 640, (3, 4)) if full else None,
    )
    matrices = rng.uniform(0, 1000, (3, 3, 3))
    scene = BopScene(ids, matrices, random_poses(3, 2) if full else None, annotations, np.ones(3) if full else None)
    write_bop_scene(tmp_path, scene)
    again = read_bop_scene(tmp_path)
    np.testing.assert_array_equal(again.image_ids, ids)
    np.testing.assert_array_equal(again.camera_matrices, matrices)
    assert same_poses(again.annotations.T_cam_obj, annotations.T_cam_obj)
    np.testing.assert_array_equal(again.annotations.image_ids, annotations.image_ids)
    np.testing.assert_array_equal(again.annotations.object_ids, annotations.object_ids)
    assert (again.T_cam_world is None) != full
    if full:
        assert same_poses(again.T_cam_world, scene.T_cam_world)
        for name in ("visible_fractions", "boxes_object_px", "boxes_visible_px"):
            np.testing.assert_array_equal(getattr(again.annotations, name), getattr(annotations, name))


def edited(text: str, image: str, **changes: object) -> str:
    content = json.loads(text)
    entry = content[image][0] if isinstance(content[image], list) else content[image]
    entry |= changes
    lines = (f'"{key}": {json.dumps(value)}' for key, value in content.items() if value is not None)
    return "{\n" + ",\n".join(lines) + "\n}"


BAD = {
    "camera": [
        ("", None, "empty"),
        ("{}", None, "no images"),
        ('{"one": {}}', None, "no image number"),
        ('{"99999999999999999999": {}}', None, "no image number"),
        ('{\n"1": []}', 2, "image 1: holds no camera"),
        (edited(CAMERA, "36", cam_K=[1, 2, 3]), 3, "image 36: cam_K has the shape (3,)"),
        (edited(CAMERA, "36", cam_t_w2c=[1, float("nan"), 3]), 3, "image 36: cam_t_w2c is NaN"),
        (edited(CAMERA, "36", cam_R_w2c=[2, 0, 0, 0, 1, 0, 0, 0, 1]), 3, "image 36: cam_R_w2c is no rotation"),
    ],
    "gt": [
        ('{"1": {}}', 1, "image 1: holds no list of objects"),
        ('{"1": []}', None, "no annotated object"),
        (edited(GROUND_TRUTH, "36", obj_id="cup"), 3, "image 36: obj_id is 'cup'"),
        (edited(GROUND_TRUTH, "36", cam_R_m2c=[1, 0, 0, 0, 1, 0, 0, 0, -1]), 3, "cam_R_m2c is no rotation"),
        (GROUND_TRUTH.replace("00.0]", "00e-3]").replace("-10.5, 20.25", "0, 0"), None, "looks like metres"),
    ],
    "gt_info": [
        (INFO.replace('"36"', '"37"'), None, "image 36: 0 entries, scene_gt.json has 1"),
        (edited(INFO, "1", bbox_obj=[1]), 2, "image 1: bbox_obj has the shape (1,)"),
    ],
}


@pytest.mark.parametrize(("file", "text", "line", "what"), [(file, *case) for file in BAD for case in BAD[file]])
def test_bad_input(scene_folder, file, text, line, what):
    from poet_loc.core.input_error import InputError

    path = scene_folder / f"scene_{file}.json"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_bop_scene(scene_folder)
    assert what in str(caught.value)
    assert (caught.value.path, caught.value.line) == (path, line)


def test_world_pose_is_the_inverse_of_the_camera_in_the_world(tmp_path):
    """A camera 1.5 m above the origin that looks down sees the origin 1.5 m ahead."""
    T_world_cam = make_pose(Rotation.from_euler("x", [180], degrees=True), [[0, 0, 1.5]])
    scene = BopScene(np.array([0]), np.eye(3)[None], T_world_cam.inv())
    write_bop_scene(tmp_path, scene)
    assert json.loads((tmp_path / "scene_camera.json").read_text())["0"]["cam_t_w2c"] == pytest.approx([0, 0, 1500])
