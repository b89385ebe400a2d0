from __future__ import annotations

import json

import numpy as np
import pytest
from io_strategies import random_poses, same_poses

from poet_loc.core.input_error import InputError
from poet_loc.io.frames_csv import Frames
from poet_loc.io.poet_results import (
    PoetResults,
    poet_image_id,
    read_poet_results,
    stamp_poet_results,
    write_poet_results,
)

GOLDEN = """{"0002": {"0": {"t": [0.1, -0.2, 0.9], "rot": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
                "box": [0.25, 0.5, 0.125, 0.25], "class": 2},
          "1": {"t": [0, 0, 1], "rot": [0.8, 0.6, 0, 0], "box": [0.5, 0.5, 0.1, 0.1], "class": 2}},
 "0001": {},
 "b_3": {"0": {"t": [0, 0, 2], "rot": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "box": [0, 0, 1, 1], "class": 1}}}
"""


def test_golden_file(write):
    results = read_poet_results(write(GOLDEN))
    assert results.image_ids == ("0002", "0001", "b_3")
    assert results.image_indices.tolist() == [0, 0, 2]
    assert results.classes.tolist() == [2, 2, 1]
    np.testing.assert_array_equal(results.boxes[0], [0.25, 0.5, 0.125, 0.25])
    np.testing.assert_allclose(results.T_cam_obj[0].apply([0, 1, 0]), [0.1, -0.2, 1.9])
    # the quaternion is scalar first: a turn by 2 acos(0.8) about x
    np.testing.assert_allclose(results.T_cam_obj[1].rotation.as_rotvec(), [2 * np.arccos(0.8), 0, 0], atol=1e-12)


def test_official_file(shared_fixtures):
    path = shared_fixtures / "poet_official" / "eval" / "inference_results.json"
    results, content = read_poet_results(path), json.loads(path.read_text())
    assert results.image_ids == ("0002", "x7", "0010")
    flat = [entry for detections in content.values() for entry in detections.values()]
    np.testing.assert_allclose(results.T_cam_obj.translation, [entry["t"] for entry in flat])
    np.testing.assert_allclose(results.T_cam_obj.rotation.as_matrix(), [entry["rot"] for entry in flat], atol=1e-6)
    assert results.classes.tolist() == [entry["class"] for entry in flat]


def test_round_trip(tmp_path):
    boxes = np.random.default_rng(0).random((3, 4))
    results = PoetResults(("a", "b", "c"), np.array([0, 0, 2]), np.array([3, 3, 1]), random_poses(3, 0), boxes)
    write_poet_results(tmp_path / "results.json", results)
    again = read_poet_results(tmp_path / "results.json")
    assert again.image_ids == results.image_ids
    np.testing.assert_array_equal(again.image_indices, results.image_indices)
    np.testing.assert_array_equal(again.classes, results.classes)
    np.testing.assert_array_equal(again.boxes, results.boxes)
    assert same_poses(again.T_cam_obj, results.T_cam_obj)


@pytest.mark.parametrize(
    ("image", "name"),
    [
        ("frame_0010.png", "0010"),
        ("a_b_3.png", "b_3"),
        ("0010.png", "0010"),
        ("x/y_z/cam_7.v2.png", "7.v2"),
        ("7", "7"),
    ],
)
def test_image_id(image, name):
    assert poet_image_id(image) == name


FRAMES = Frames(
    np.array([10, 20, 1600059000033333333]), np.array([3, 4, 5]), ("rgb/a_b_3.png", "frame_0001.png", "frame_0002.png")
)


def test_stamps_come_from_the_table(write):
    poses = stamp_poet_results(read_poet_results(write(GOLDEN)), FRAMES)
    assert poses.stamps_ns.tolist() == [10, 1600059000033333333, 1600059000033333333]
    assert poses.frames.tolist() == [3, 5, 5]
    assert poses.object_ids.tolist() == [1, 2, 2]
    assert poses.instances.tolist() == [0, 0, 1]
    assert poses.scores.tolist() == [1, 1, 1]
    np.testing.assert_array_equal(poses.T_cam_obj.translation[:, 2], [2, 0.9, 1])


def test_classes_become_object_ids(write):
    poses = stamp_poet_results(read_poet_results(write(GOLDEN)), FRAMES, {1: 1, 2: 5})
    assert poses.object_ids.tolist() == [1, 5, 5]
    with pytest.raises(InputError, match="class 2 has no object id"):
        stamp_poet_results(read_poet_results(write(GOLDEN)), FRAMES, {1: 1})


def test_images_without_a_stamp_or_with_two(write):
    results = read_poet_results(write(GOLDEN))
    with pytest.raises(InputError, match=r"no stamp for image 0002 \(1 such images\)"):
        stamp_poet_results(results, Frames(np.array([1]), np.array([1]), ("a_b_3.png",)))
    twice = Frames(np.array([1, 2]), np.array([1, 2]), ("left_0002.png", "right_0002.png"))
    with pytest.raises(InputError, match="have one PoET id"):
        stamp_poet_results(results, twice)


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("", None, "empty"),
        ("{}", None, "no images"),
        ('{"1": {}}', None, "no detections"),
        ('{"1": [1]}', 1, "image 1: holds no detections by number"),
        (
            GOLDEN.replace("[0.8, 0.6, 0, 0]", "[[1, 0, 0], [0, 1], [0, 0, 1]]"),
            1,
            "rot holds something",
        ),
        (GOLDEN.replace('"class": 1', '"class": "cup"'), 5, "image b_3: class is 'cup'"),
        (GOLDEN.replace('"t": [0, 0, 2], ', ""), 5, "image b_3: t is missing"),
        (GOLDEN.replace("[0, 0, 2]", "[0, 0, NaN]"), 5, "image b_3: t is NaN"),
        (GOLDEN.replace("[0.8, 0.6, 0, 0]", "[0.8, 0.9, 0, 0]"), 1, "image 0002: rot has norm 1.204"),
        (GOLDEN.replace("[0, 0, -1]", "[0, 0, 1]"), 1, "image 0002: rot is no rotation"),
    ],
)
def test_bad_input(write, refusal, text, line, what):
    error = refusal(read_poet_results, write(text))
    assert what in str(error)
    assert error.line == line
