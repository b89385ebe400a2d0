from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from io_strategies import object_poses, random_covariances, random_poses, same_poses

from poet_loc.core.records import ObjectPoses
from poet_loc.io.object_poses_csv import count_instances, line_of_object, read_object_poses, write_object_poses

HEADER = "timestamp_ns,frame,object_id,instance,score,tx,ty,tz,qx,qy,qz,qw\n"
GOLDEN = (
    HEADER + "1600059000033333333,1,2,0,0.75,-0.08138,-0.05179,1.01914,0.6,0,0,0.8\n"
    "1600059000033333333,1,2,1,1,0.1,0.2,0.5,0,0,0,1\n"
    "1600059000066666667,2,9,0,1,-0.1,0.25,0.75,0,0.70710678,0,-0.70710678\n"
)
ROW = "1600059000033333333,1,2,0,1,0.1,0.2,0.9,0,0,0,1\n"
LATER = "1600059000066666667,2,2,0,1,0.1,0.2,0.9,0,0,0,1\n"


def test_golden_file(write):
    poses = read_object_poses(write(GOLDEN))
    assert poses.stamps_ns.tolist() == [1600059000033333333, 1600059000033333333, 1600059000066666667]
    assert poses.frames.tolist() == [1, 1, 2]
    assert poses.object_ids.tolist() == [2, 2, 9]
    assert poses.instances.tolist() == [0, 1, 0]
    assert poses.scores.tolist() == [0.75, 1, 1]
    assert poses.covariances is None
    np.testing.assert_array_equal(poses.T_cam_obj.translation[0], [-0.08138, -0.05179, 1.01914])
    # a turn by 2 acos(0.8) about x, and the quaternion's fourth number is the scalar
    np.testing.assert_allclose(poses.T_cam_obj.rotation.as_rotvec()[0], [2 * np.arccos(0.8), 0, 0], atol=1e-12)
    np.testing.assert_allclose(poses.T_cam_obj.rotation.as_matrix()[2], [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-8)


@given(poses=object_poses())
@settings(max_examples=60, deadline=None)
def test_round_trip(tmp_path_factory, poses):
    path = tmp_path_factory.mktemp("poses") / "object_poses.csv"
    write_object_poses(path, poses)
    again = read_object_poses(path)
    for name in ("stamps_ns", "frames", "object_ids", "instances", "scores"):
        np.testing.assert_array_equal(getattr(again, name), getattr(poses, name))
        assert getattr(again, name).dtype == getattr(poses, name).dtype
    np.testing.assert_array_equal(again.T_cam_obj.translation, poses.T_cam_obj.translation)
    assert same_poses(again.T_cam_obj, poses.T_cam_obj)
    if poses.covariances is None:
        assert again.covariances is None
    else:
        np.testing.assert_array_equal(np.triu(again.covariances[0]), np.triu(poses.covariances[0]))
        np.testing.assert_array_equal(again.covariances, again.covariances.transpose(0, 2, 1))


def test_covariance_columns_are_the_upper_triangle_by_rows(write):
    names = [f"cov_{i}{j}" for i in range(6) for j in range(i, 6)]
    values = dict.fromkeys(names, 0.0) | {f"cov_{i}{i}": 1.0 + i for i in range(6)} | {"cov_03": 0.25}
    text = HEADER.strip() + "," + ",".join(names) + "\n" + ROW.strip() + "," + ",".join(map(str, values.values()))
    expected = np.diag(np.arange(1.0, 7.0))
    expected[0, 3] = expected[3, 0] = 0.25
    np.testing.assert_array_equal(read_object_poses(write(text)).covariances, [expected])


def test_a_detection_without_covariance_keeps_nan(tmp_path):
    covariances = random_covariances(3, 1)
    covariances[1] = np.nan
    ones = np.ones(3, np.int64)
    poses = ObjectPoses(np.arange(3), np.arange(3), ones, 0 * ones, np.ones(3), random_poses(3, 0), covariances)
    write_object_poses(tmp_path / "p.csv", poses)
    again = read_object_poses(tmp_path / "p.csv")
    assert np.isnan(again.covariances[1]).all()
    np.testing.assert_allclose(again.covariances[[0, 2]], covariances[[0, 2]], rtol=1e-15)


def test_order_of_columns_windows_newlines_blank_lines_and_byte_order_mark_do_not_matter(write):
    lines = [line.split(",") for line in GOLDEN.split()]
    turned = "\r\n".join(",".join(reversed(line)) for line in lines)
    again = read_object_poses(write(b"\xef\xbb\xbf" + turned.encode() + b"\r\n\r\n"))
    assert again.stamps_ns.tolist() == read_object_poses(write(GOLDEN, "golden.csv")).stamps_ns.tolist()
    assert again.object_ids.tolist() == [2, 2, 9]


def test_a_file_ordered_object_after_object_is_sorted_by_stamp(write):
    poses = read_object_poses(write(HEADER + ROW + LATER + ROW.replace(",1,2,0,", ",1,9,0,")))
    assert poses.object_ids.tolist() == [2, 9, 2]
    assert poses.frames.tolist() == [1, 1, 2]


def test_small_deviations_of_the_quaternion_are_normalised(write):
    poses = read_object_poses(write(HEADER + ROW.replace("0,0,0,1\n", "0,0,0.004,1.005\n")))
    np.testing.assert_allclose(poses.T_cam_obj.rotation.as_rotvec()[0, 2], 2 * np.arctan2(0.004, 1.005), rtol=1e-12)


BAD = {
    "empty": ("", None, "empty"),
    "header only": (HEADER, None, "no rows"),
    "missing column": (HEADER.replace("score,", "") + ROW, 1, "column score is missing"),
    "unknown column": (HEADER.replace("score", "score,colour") + ROW, 1, "unknown column 'colour'"),
    "column twice": (HEADER.replace("\n", ",qw\n") + ROW, 1, "qw is there twice"),
    "covariance in part": (HEADER.replace("\n", ",cov_00\n") + ROW, 1, "cov_01 is missing"),
    "a cell too few": (HEADER + ROW + LATER.replace("0.2,", ""), 3, "11 values where 12 belong"),
    "a cell too many": (HEADER + ROW + LATER.replace("0.2,", "0.2,0.3,"), 3, "13 values where 12 belong"),
    "text": (HEADER + ROW + LATER.replace("0.2,", "abc,"), 3, "column ty holds 'abc'"),
    "empty cell": (HEADER + ROW + LATER.replace("0.2,", ","), 3, "column ty is empty"),
    "seconds": (HEADER + ROW.replace("1600059000033333333", "1600059000.03"), 2, "timestamp_ns holds '1600059000.03'"),
    "beyond int64": (HEADER + ROW.replace("1600059000033333333", "9" * 20), 2, "timestamp_ns"),
    "nan": (HEADER + ROW + "\n" + LATER.replace("0.2,", "nan,"), 4, "ty is NaN or infinite"),
    "infinite": (HEADER + ROW.replace(",0.9,", ",inf,"), 2, "tz is NaN or infinite"),
    "nan score": (HEADER + ROW.replace("0,1,0.1", "0,nan,0.1"), 2, "score is NaN or infinite"),
    "zero quaternion": (HEADER + ROW + LATER.replace("0,0,0,1\n", "0,0,0,0\n"), 3, "quaternion is zero"),
    "unnormalised quaternion": (HEADER + ROW.replace("0,0,0,1\n", "0,0,0,1.02\n"), 2, "norm 1.02 instead of 1"),
    "backwards": (HEADER + LATER + ROW, 3, "go backwards"),
    "duplicate": (HEADER + ROW + LATER + ROW.replace(",1,2,0,", ",1,9,0,") + LATER, 5, "twice at one stamp"),
    "millimetres": (HEADER + ROW.replace("0.9", "900") + LATER.replace("0.9", "900"), None, "millimetres"),
    "binary": (b"\x80\x81\x82", None, "no UTF-8 text"),
    "binary below the header": (HEADER.encode() + b"\xff\xfe\n", None, "no UTF-8 text"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(write, refusal, case):
    text, line, what = BAD[case]
    error = refusal(read_object_poses, write(text))
    assert what in str(error)
    assert error.line == line


def test_missing_file_and_folder(tmp_path, refusal):
    assert "does not exist" in str(refusal(read_object_poses, tmp_path / "nothing.csv"))
    assert "folder" in str(refusal(read_object_poses, tmp_path))


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"cov_00": -1.0}, "not positive definite"),
        ({"cov_01": 5.0}, "not positive definite"),
        ({"cov_55": 0.0}, "not positive definite"),
        ({"cov_23": np.nan}, "NaN or infinite in part"),
        ({"cov_55": np.inf}, "NaN or infinite in part"),
    ],
)
def test_bad_covariance(write, refusal, changes, what):
    names = [f"cov_{i}{j}" for i in range(6) for j in range(i, 6)]
    good = {name: float(name[4] == name[5]) for name in names}
    rows = [
        row.strip() + "," + ",".join(map(str, values.values()))
        for row, values in [(ROW, good), (LATER, good | changes)]
    ]
    error = refusal(read_object_poses, write("\n".join([HEADER.strip() + "," + ",".join(names), *rows])))
    assert what in str(error)
    assert error.line == 3


def test_line_of_object(write):
    assert line_of_object(write(GOLDEN), 9) == 4


@given(poses=object_poses())
@settings(max_examples=20, deadline=None)
def test_instances_count_up_within_image_and_object(poses):
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(len(poses))
    images, ids = poses.stamps_ns[shuffled], poses.object_ids[shuffled]
    seen: dict[tuple[int, int], int] = {}
    for image, object_id, instance in zip(images, ids, count_instances(images, ids), strict=True):
        assert instance == seen.get((image, object_id), 0)
        seen[image, object_id] = instance + 1


def test_shared_logs(shared_data):
    files = sorted(shared_data.glob("**/object_poses*.csv"))
    assert len(files) == 37
    for file in files:
        poses = read_object_poses(file)
        rows = file.read_text().splitlines()[1:]
        assert len(poses) == len(rows)
        assert sorted(poses.stamps_ns.tolist()) == sorted(int(row.split(",")[0]) for row in rows)
        assert all(a <= b for a, b in pairwise(poses.stamps_ns.tolist()))
