"""Whatever a file holds: it is read, or refused in one line; a traceback would be ours."""

from __future__ import annotations

import warnings

import pytest
import test_bop_models
import test_bop_results_csv
import test_bop_scene
import test_calibration_yaml
import test_camera_poses_csv
import test_frames_csv
import test_imu_csv
import test_landmarks_json
import test_object_poses_csv
import test_poet_results
import test_tum
from hypothesis import given, settings
from hypothesis import strategies as st

from poet_loc.core.input_error import InputError
from poet_loc.io.bop import read_bop_scene
from poet_loc.io.bop_models import read_models_info
from poet_loc.io.bop_results_csv import read_bop_results
from poet_loc.io.calibration_yaml import read_calibration
from poet_loc.io.camera_poses_csv import read_camera_poses
from poet_loc.io.frames_csv import read_frames
from poet_loc.io.imu_csv import read_imu
from poet_loc.io.landmarks_json import read_landmarks
from poet_loc.io.object_poses_csv import read_object_poses
from poet_loc.io.poet_results import read_poet_results
from poet_loc.io.tum import read_tum

READERS = {
    "object_poses": (read_object_poses, test_object_poses_csv.GOLDEN),
    "camera_poses": (read_camera_poses, test_camera_poses_csv.GOLDEN),
    "imu": (read_imu, test_imu_csv.GOLDEN),
    "tum": (read_tum, test_tum.GOLDEN),
    "frames": (read_frames, test_frames_csv.GOLDEN),
    "landmarks": (read_landmarks, test_landmarks_json.GOLDEN),
    "calibration": (read_calibration, test_calibration_yaml.GOLDEN),
    "opencv": (read_calibration, test_calibration_yaml.OPENCV),
    "models": (read_models_info, test_bop_models.GOLDEN),
    "bop_results": (read_bop_results, test_bop_results_csv.GOLDEN),
    "poet_results": (read_poet_results, test_poet_results.GOLDEN),
    "scene_camera": (lambda path: read_bop_scene(path.parent), test_bop_scene.CAMERA),
    "scene_gt": (lambda path: read_bop_scene(path.parent), test_bop_scene.GROUND_TRUTH),
    "scene_gt_info": (lambda path: read_bop_scene(path.parent), test_bop_scene.INFO),
}
SCENE = {
    "scene_camera": test_bop_scene.CAMERA,
    "scene_gt": test_bop_scene.GROUND_TRUTH,
    "scene_gt_info": test_bop_scene.INFO,
}
PIECES = [b"", b"\0", b"\xff", b"\r", b"\n", b",", b" ", b'"', b"#", b"[", b"]", b"{", b"}", b":", b"-", b"0", b"9e999"]
PIECES += [
    b"nan",
    b"null",
    b"true",
    b"1" * 30,
    b"0x10",
    b"1_0",
    b"\xc2\xb2",
    "٣".encode(),
    b"!!set",
    b"&a",
    b"*a",
    b"? ",
]
EDITS = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 40), st.sampled_from(PIECES)), min_size=1, max_size=3)


@pytest.mark.parametrize("name", READERS)
@given(edits=EDITS)
@settings(max_examples=80, deadline=None)
def test_a_damaged_file_is_read_or_refused(tmp_path_factory, name, edits):
    read, text = READERS[name]
    damaged = text.encode()
    for place, cut, piece in edits:
        start = round(place * len(damaged))
        damaged = damaged[:start] + piece + damaged[start + cut :]
    folder = tmp_path_factory.mktemp("damaged")
    for other, content in SCENE.items():
        (folder / f"{other}.json").write_text(content)
    path = folder / f"{name}.json"
    path.write_bytes(damaged)
    refused, record = "", None
    with warnings.catch_warnings(record=True):
        try:
            record = read(path)
        except InputError as error:
            refused = str(error)
    assert record is not None or len(refused.splitlines()) == 1
