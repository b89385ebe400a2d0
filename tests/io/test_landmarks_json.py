from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from io_strategies import INT64, SEEDS, random_covariances, random_poses, same_poses

from poet_loc.core.records import Landmark, LandmarkMap, Symmetry
from poet_loc.io.landmarks_json import read_landmarks, write_landmarks

GOLDEN = """{
 "landmarks": [
  {"object_id": 3, "instance": 0, "name": "004_sugar_box", "t": [-0.0859065, 0.098122, 0.105638],
   "q_xyzw": [0.6, 0, 0, 0.8], "covariance": null, "symmetry": null},
  {"object_id": 13, "instance": 2, "name": "024_bowl", "t": [1, 2, 3], "q_xyzw": [0, 0, 0, 1],
   "covariance": [[4,0,0,0,0,1],[0,4,0,0,0,0],[0,0,4,0,0,0],[0,0,0,1,0,0],[0,0,0,0,1,0],[1,0,0,0,0,1]],
   "symmetry": {"axis": [0, 0, 2], "order": "continuous"}},
  {"object_id": 21,
   "t": [0.5, 0, 0], "q_xyzw": [0, 0, 0, 1.004], "symmetry": {"axis": [1, 0, 0], "order": 2}}
 ]
}
"""


def test_golden_file(write):
    box, bowl, brick = read_landmarks(write(GOLDEN))
    assert (box.key, box.name, box.covariance, box.symmetry) == ((3, 0), "004_sugar_box", None, None)
    np.testing.assert_array_equal(box.T_world_obj.translation, [-0.0859065, 0.098122, 0.105638])
    np.testing.assert_allclose(box.T_world_obj.rotation.as_rotvec(), [2 * np.arccos(0.8), 0, 0], atol=1e-12)
    assert bowl.key == (13, 2)
    assert bowl.covariance[0, 5] == bowl.covariance[5, 0] == 1
    assert bowl.symmetry == Symmetry((0, 0, 1), "continuous")
    assert (brick.key, brick.name, brick.symmetry) == ((21, 0), "", Symmetry((1, 0, 0), 2))
    np.testing.assert_allclose(brick.T_world_obj.as_matrix()[:3, :3], np.eye(3), atol=1e-15)


@given(
    keys=st.lists(st.tuples(INT64, INT64), min_size=1, max_size=5, unique=True),
    name=st.text(),
    order=st.one_of(st.just("continuous"), st.integers(2, 12)),
    seed=SEEDS,
)
@settings(max_examples=50, deadline=None)
def test_round_trip(tmp_path_factory, keys, name, order, seed):
    path = tmp_path_factory.mktemp("map") / "landmarks.json"
    poses, covariances = random_poses(len(keys), seed), random_covariances(len(keys), seed)
    landmarks = LandmarkMap(
        tuple(
            Landmark(
                object_id,
                poses[row],
                instance,
                name,
                covariances[row] if row % 2 else None,
                Symmetry((0.6, 0, 0.8), order) if row % 2 else None,
            )
            for row, (object_id, instance) in enumerate(keys)
        )
    )
    write_landmarks(path, landmarks)
    again = read_landmarks(path)
    assert [each.key for each in again] == keys
    assert same_poses(again.T_world_obj, poses)
    for one, other in zip(landmarks, again, strict=True):
        assert (one.name, one.symmetry) == (other.name, other.symmetry)
        assert (one.covariance is None) == (other.covariance is None)
        if one.covariance is not None:
            np.testing.assert_array_equal(one.covariance, other.covariance)


def changed(**fields: object) -> str:
    landmarks = json.loads(GOLDEN)["landmarks"]
    landmarks[1] |= fields
    return json.dumps(
        {"landmarks": [{k: v for k, v in each.items() if v != "left out"} for each in landmarks]}, indent=1
    )


NOT_SYMMETRIC = np.eye(6)
NOT_SYMMETRIC[0, 1] = 0.5

BAD = {
    "empty": ("", "empty"),
    "no json": ('{"landmarks": [\n{"object_id": }]}', "is no JSON"),
    "no list": ('{"objects": []}', 'no list "landmarks"'),
    "a list": ("[]", 'no list "landmarks"'),
    "no landmarks": ('{"landmarks": []}', "no landmarks"),
    "no mapping": ('{"landmarks": [3]}', "no mapping"),
    "one id twice": (changed(object_id=3, instance=0), "object 3, instance 0 is there twice"),
    "missing": (changed(q_xyzw="left out"), "q_xyzw is missing"),
    "unknown": (changed(q_wxyz=[1, 0, 0, 0]), "unknown field 'q_wxyz'"),
    "id no number": (changed(object_id="bowl"), "object_id is 'bowl'"),
    "id beyond int64": (changed(object_id=2**63), "no whole number of 64 bits"),
    "id a fraction": (changed(object_id=1.5), "object_id is 1.5"),
    "t too short": (changed(t=[1, 2]), "t has the shape (2,)"),
    "t of text": (changed(t=["a", 1, 2]), "t holds something that is no number"),
    "t nan": (changed(t=[float("nan"), 1, 2]), "t is NaN or infinite"),
    "millimetres": (changed(t=[1200, 300, 500]), "millimetres"),
    "zero quaternion": (changed(q_xyzw=[0, 0, 0, 0]), "q_xyzw is zero"),
    "unnormalised": (changed(q_xyzw=[0, 0, 0, 1.1]), "q_xyzw has norm 1.1 instead of 1"),
    "three numbers": (changed(q_xyzw=[0, 0, 1]), "q_xyzw has the shape (3,)"),
    "name no text": (changed(name=3), "name is 3"),
    "covariance shape": (changed(covariance=[1, 2]), "covariance has the shape"),
    "covariance not symmetric": (changed(covariance=NOT_SYMMETRIC.tolist()), "not symmetric"),
    "covariance negative": (changed(covariance=(-np.eye(6)).tolist()), "not positive semidefinite"),
    "symmetry without order": (changed(symmetry={"axis": [0, 0, 1]}), "symmetry is null or"),
    "symmetry axis zero": (changed(symmetry={"axis": [0, 0, 0], "order": 2}), "axis is zero"),
    "symmetry order 1": (changed(symmetry={"axis": [0, 0, 1], "order": 1}), "order is 1"),
    "symmetry order word": (changed(symmetry={"axis": [0, 0, 1], "order": "many"}), "order is 'many'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(write, refusal, case):
    text, what = BAD[case]
    path = write(text)
    error = refusal(read_landmarks, path)
    assert what in str(error)
    if "q_xyzw" in text:  # everything wrong here is in the second landmark
        assert "landmark 2" in str(error)
        assert '"object_id"' in path.read_text().splitlines()[error.line - 1]
        assert sum('"object_id"' in line for line in path.read_text().splitlines()[: error.line]) == 2


def test_line_of_broken_json(write, refusal):
    assert refusal(read_landmarks, write(BAD["no json"][0])).line == 2


def test_shared_logs(shared_data):
    files = sorted(shared_data.glob("**/landmarks.json"))
    assert len(files) == 13
    for file in files:
        landmarks = read_landmarks(file)
        assert [each.object_id for each in landmarks] == [
            each["object_id"] for each in json.loads(file.read_text())["landmarks"]
        ]
