from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from io_strategies import INT64, random_poses, same_poses, trajectories

from poet_loc.core.trajectory import Trajectory
from poet_loc.io.tum import read_tum, seconds_text, write_tum

POSE = " 0.1 0.2 1.5 0 0 0.6 0.8\n"
GOLDEN = (
    "# timestamp tx ty tz qx qy qz qw\n"
    "1600059000.033333333 0.1 -0.2 1.5 0 0 0.6 0.8\n"
    "\n"
    "1600059000.066666667\t0.3  0.4 1.25 0.5 0.5 0.5 0.5  # a note\n"
)


def test_golden_file(write):
    trajectory = read_tum(write(GOLDEN))
    assert trajectory.stamps_ns.tolist() == [1600059000033333333, 1600059000066666667]
    np.testing.assert_array_equal(trajectory.T_world_body.translation, [[0.1, -0.2, 1.5], [0.3, 0.4, 1.25]])
    np.testing.assert_allclose(trajectory.T_world_body.rotation.as_rotvec()[0], [0, 0, 2 * np.arccos(0.8)], atol=1e-12)
    np.testing.assert_allclose(
        trajectory.T_world_body.rotation.as_matrix()[1], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12
    )


@given(trajectory=trajectories())
@settings(max_examples=80, deadline=None)
def test_round_trip_keeps_every_nanosecond(tmp_path_factory, trajectory):
    path = tmp_path_factory.mktemp("tum") / "T_world_cam.tum"
    write_tum(path, trajectory)
    again = read_tum(path)
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_array_equal(again.T_world_body.translation, trajectory.T_world_body.translation)
    assert same_poses(again.T_world_body, trajectory.T_world_body)


@given(stamp=INT64)
@example(stamp=0)
@example(stamp=-1)
@example(stamp=2**63 - 1)
def test_seconds_are_exact(stamp):
    assert Fraction(seconds_text(stamp)) * 10**9 == stamp
    assert len(seconds_text(stamp).partition(".")[2]) == 9


def read_stamp(write, text: str) -> int:
    return int(read_tum(write(text + POSE)).stamps_ns[0])


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1600059000", 1600059000000000000),
        ("1600059000.", 1600059000000000000),
        ("1600059000.5", 1600059000500000000),
        ("1600059000.033", 1600059000033000000),
        ("1600059000.0333333331", 1600059000033333333),
        ("1600059000.0333333339", 1600059000033333334),
        ("1.6000590000333333e+09", 1600059000033333300),
        ("1.6000500e+09", 1600050000000000000),
        ("+12.25", 12250000000),
        ("-12.25", -12250000000),
        (".5", 500000000),
        ("0000000012.25", 12250000000),
        ("9223372036.854775807", 2**63 - 1),
    ],
)
def test_other_ways_to_write_seconds(write, text, stamp):
    assert read_stamp(write, text) == stamp


@given(seconds=st.integers(0, 9_000_000_000), decimals=st.text("0123456789", max_size=9))
@settings(max_examples=60, deadline=None)
def test_any_number_of_decimals_is_exact(tmp_path_factory, seconds, decimals):
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    path.write_text(f"{seconds}.{decimals}{POSE}")
    assert read_tum(path).stamps_ns[0] == Fraction(f"{seconds}.{decimals or 0}") * 10**9


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("", None, "empty"),
        ("# only a comment\n", None, "no rows"),
        ("# c\n1.0 2 3\n", 2, "3 values where 8 belong"),
        ("1.0,0.1,0.2,1.5,0,0,0.6,0.8\n", 1, "1 values where 8 belong"),
        ("time x y z a b c d\n1.0" + POSE, 1, "tx holds 'x'"),
        ("# c\n\nsoon" + POSE, 3, "'soon' is no time in seconds"),
        ("nan" + POSE, 1, "'nan' is no time"),
        ("1_0.5" + POSE, 1, "'1_0.5' is no time"),
        ("1600059000033333333" + POSE, 1, "'1600059000033333333' is no time in seconds"),
        ("1e999999999" + POSE, 1, "no time in seconds"),
        ("9223372036.854775808" + POSE, 1, "no time in seconds"),
        ("2.0" + POSE + "1.0" + POSE, 2, "goes backwards"),
        ("1.0" + POSE + "# c\n1.0" + POSE, 3, "there twice"),
        ("1.0" + POSE.replace("1.5", "nan"), 1, "tz is NaN"),
        ("1.0" + POSE + "2.0" + POSE.replace("1.5", "1,5"), 2, "tz holds '1,5' where a number belongs"),
        ("1.0" + POSE.replace("0.6 0.8", "0 0"), 1, "quaternion is zero"),
        ("1.0" + POSE.replace("0.6 0.8", "0.6 0.9"), 1, "instead of 1"),
    ],
)
def test_bad_input(write, refusal, text, line, what):
    error = refusal(read_tum, write(text))
    assert what in str(error)
    assert error.line == line


def test_shared_logs(shared_data):
    files = sorted(shared_data.glob("**/*.tum"))
    assert len(files) == 38
    for file in files:
        stamps = [int(row.split()[0].replace(".", "")) for row in file.read_text().splitlines()]  # nine decimals
        assert read_tum(file).stamps_ns.tolist() == stamps


def test_evo_reads_what_we_write(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    stamps = 1600059000000000000 + np.arange(5) * 33333333
    write_tum(tmp_path / "t.tum", Trajectory(stamps, random_poses(5, 1)))
    evo = file_interface.read_tum_trajectory_file(tmp_path / "t.tum")
    np.testing.assert_allclose(evo.poses_se3, random_poses(5, 1).as_matrix(), atol=1e-12)
