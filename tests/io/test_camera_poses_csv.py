from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from io_strategies import SEEDS, STAMPS, random_covariances, random_poses, same_poses

from poet_loc.core.records import CameraPoses
from poet_loc.io.camera_poses_csv import read_camera_poses, write_camera_poses

HEADER = "timestamp_ns,frame,tx,ty,tz,qx,qy,qz,qw\n"
ROW = "1600059000033333333,1,0.1,0.2,1.5,0,0,0.6,0.8\n"
LATER = "1600059000066666667,2,0.1,0.2,1.5,0,0,0.6,0.8\n"
GOLDEN = HEADER.replace("\n", ",voted,note\n") + ROW.replace("\n", ",2:0;9:0,all's well\n")


def test_golden_file_with_further_columns(write):
    poses = read_camera_poses(write(GOLDEN))
    assert poses.stamps_ns.tolist() == [1600059000033333333]
    assert poses.frames.tolist() == [1]
    np.testing.assert_array_equal(poses.T_world_cam.translation, [[0.1, 0.2, 1.5]])
    np.testing.assert_allclose(poses.T_world_cam.rotation.as_rotvec(), [[0, 0, 2 * np.arccos(0.8)]], atol=1e-12)
    assert poses.covariances is None


@given(stamps=STAMPS, seed=SEEDS)
@settings(max_examples=40, deadline=None)
def test_round_trip(tmp_path_factory, stamps, seed):
    path = tmp_path_factory.mktemp("poses") / "camera_poses.csv"
    count = len(stamps)
    covariances = random_covariances(count, seed) if seed % 2 else None
    poses = CameraPoses(stamps, np.arange(count) - 3, random_poses(count, seed), covariances)
    write_camera_poses(path, poses, {"landmarks": ["2:0;3:1"] * count, "votes": np.arange(count)})
    again = read_camera_poses(path)
    np.testing.assert_array_equal(again.stamps_ns, stamps)
    np.testing.assert_array_equal(again.frames, poses.frames)
    assert same_poses(again.T_world_cam, poses.T_world_cam)
    if covariances is None:
        assert again.covariances is None
    else:
        np.testing.assert_allclose(again.covariances, covariances, rtol=1e-12)
    assert path.read_text().splitlines()[0].endswith(",landmarks,votes")
    assert path.read_text().splitlines()[1].endswith(",2:0;3:1,0")


def test_a_comma_in_a_further_column_is_refused(tmp_path):
    poses = CameraPoses(np.array([1]), np.array([1]), random_poses(1, 0))
    with pytest.raises(ValueError, match="comma"):
        write_camera_poses(tmp_path / "camera_poses.csv", poses, {"landmarks": ["2,3"]})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("", None, "empty"),
        (HEADER, None, "no rows"),
        (HEADER.replace("frame,", "") + ROW, 1, "column frame is missing"),
        (HEADER + LATER + ROW, 3, "goes backwards"),
        (HEADER + ROW + ROW, 3, "there twice"),
        (HEADER + ROW.replace("0.6,0.8", "0,0"), 2, "quaternion is zero"),
        (HEADER + ROW.replace("0.6,0.8", "6,8"), 2, "norm 10"),
        (HEADER + ROW + LATER.replace("1.5", "NaN"), 3, "tz is NaN or infinite"),
        (GOLDEN + LATER, 3, "9 values where 11 belong"),
        (GOLDEN + LATER.replace("\n", ",a,b,c\n"), 3, "12 values where 11 belong"),
        (GOLDEN + LATER.replace("\n", ",a,b\n").replace("1.5", "x"), 3, "tz holds 'x'"),
    ],
)
def test_bad_input(write, refusal, text, line, what):
    error = refusal(read_camera_poses, write(text))
    assert what in str(error)
    assert error.line == line
