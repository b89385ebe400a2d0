from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from io_strategies import SEEDS, STAMPS

from poet_loc.core.input_error import InputError
from poet_loc.core.records import ImuSamples
from poet_loc.io.imu_csv import read_imu, write_imu

HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
ROW = "1403715273262142976,-0.002,0.0174533,0.0774926,9.087496,0.130755,-3.693838\n"
LATER = "1403715273267142977,0,1e-3,2,3,4,5\n"
GOLDEN = HEADER + ROW + LATER


def test_golden_file(write):
    imu = read_imu(write(GOLDEN))
    assert imu.stamps_ns.tolist() == [1403715273262142976, 1403715273267142977]
    np.testing.assert_array_equal(imu.angular_velocity, [[-0.002, 0.0174533, 0.0774926], [0, 1e-3, 2]])
    np.testing.assert_array_equal(imu.specific_force, [[9.087496, 0.130755, -3.693838], [3, 4, 5]])


def test_header_without_units(write):
    bare = HEADER.replace(" [ns]", "").replace(" [rad s^-1]", "").replace(" [m s^-2]", "")
    assert len(read_imu(write(bare + ROW))) == 1


@given(stamps=STAMPS, seed=SEEDS)
@settings(max_examples=60, deadline=None)
def test_round_trip_is_exact(tmp_path_factory, stamps, seed):
    path = tmp_path_factory.mktemp("imu") / "imu.csv"
    values = np.random.default_rng(seed).normal(size=(2, len(stamps), 3))
    write_imu(path, ImuSamples(stamps, *values))
    again = read_imu(path)
    np.testing.assert_array_equal(again.stamps_ns, stamps)
    np.testing.assert_array_equal([again.angular_velocity, again.specific_force], values)
    assert path.read_text().startswith(HEADER)


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("", None, "empty"),
        (HEADER, None, "no rows"),
        (ROW + LATER, 1, "column timestamp is missing"),
        (HEADER.replace("rad s^-1", "deg s^-1") + ROW, 1, "w_RS_S_x is in deg s^-1"),
        (HEADER.replace("[ns]", "[s]") + ROW, 1, "timestamp is in s"),
        (HEADER.replace("\n", ",temperature [C]\n") + ROW, 1, "unknown column 'temperature'"),
        (HEADER + LATER + ROW, 3, "goes backwards"),
        (HEADER + ROW + LATER + LATER, 4, "there twice"),
        (HEADER + ROW + LATER.replace("1e-3", "nan"), 3, "w_RS_S_y is NaN"),
        (HEADER + ROW.replace("1403715273262142976", "1.403715273262142976e18"), 2, "timestamp holds '1.40371"),
        (HEADER + ROW + "1403715273267142977,1,2\n", 3, "3 values where 7 belong"),
        (HEADER + ROW + "  \n" + LATER, 3, "blanks only"),
    ],
)
def test_bad_input(write, refusal, text, line, what):
    error = refusal(read_imu, write(text))
    assert what in str(error)
    assert error.line == line


def test_stamps_just_beyond_a_double_survive(write):
    imu = read_imu(write(HEADER + ROW.replace("1403715273262142976", str(2**53 + 1))))
    assert imu.stamps_ns[0] == 2**53 + 1


def test_shared_logs(shared_data):
    files = sorted(shared_data.glob("**/imu.csv"))
    assert len(files) == 13
    for file in files:
        imu = read_imu(file)
        assert imu.stamps_ns.tolist() == [int(row.split(",")[0]) for row in file.read_text().splitlines()[1:]]
        assert 9 < np.median(np.linalg.norm(imu.specific_force, axis=1)) < 11


def test_a_file_whose_end_was_filled_with_zero_bytes_is_one_short_line(tmp_path):
    """As a logger's disk leaves it when the power goes."""
    path = tmp_path / "imu.csv"
    path.write_bytes(f"{HEADER}{ROW}".encode()[:-3] + bytes(3000))
    with pytest.raises(InputError, match=r"imu\.csv:2: column a_RS_S_z holds ") as refused:
        read_imu(path)
    assert len(str(refused.value)) < len(str(path)) + 150
