"""Boxes in images: a file written by hand, and back and forth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from poet_loc.core.input_error import InputError
from poet_loc.io.boxes_csv import read_boxes, write_boxes

GOLDEN = """image,x1,y1,x2,y2,score,class
rgb/000001.jpg,1.5,2,30.25,40,0.5,7
000001.jpg,-3,2,30,40,1,2

000002.jpg,0,0,10,20,0.125,1
"""


def test_a_file_written_by_hand(tmp_path: Path) -> None:
    (tmp_path / "boxes.csv").write_text(GOLDEN)
    found = read_boxes(tmp_path / "boxes.csv")
    assert list(found) == ["000001.jpg", "000002.jpg"]
    np.testing.assert_array_equal(found["000001.jpg"], [[1.5, 2, 30.25, 40, 0.5, 7], [-3, 2, 30, 40, 1, 2]])


def test_equal_names_in_several_folders_stay_apart(tmp_path: Path) -> None:
    rows = [
        "000048/rgb/000001.png,1,2,30,40,1,2",
        "000049/rgb/000001.png,1,2,30,40,1,3",
        "000049/rgb/2.png,1,2,3,4,1,1",
    ]
    (tmp_path / "boxes.csv").write_text("\n".join([GOLDEN.split("\n")[0], *rows]))
    found = read_boxes(tmp_path / "boxes.csv")
    assert {name: rows[0, 5] for name, rows in found.items()} == {
        "000048/rgb/000001.png": 2, "000049/rgb/000001.png": 3, "2.png": 1
    }  # fmt: skip


def test_there_and_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 100, (5, 4)).cumsum(axis=1)[:, [0, 1, 2, 3]]
    rows = np.concatenate([corners, rng.random((5, 1)), rng.integers(1, 9, (5, 1))], axis=1)
    write_boxes(tmp_path / "boxes.csv", {"a.png": rows[:3], "empty.png": rows[:0], "b.png": rows[3:]})
    found = read_boxes(tmp_path / "boxes.csv")
    assert list(found) == ["a.png", "b.png"]
    np.testing.assert_allclose(np.concatenate([found["a.png"], found["b.png"]]), rows, atol=5.1e-4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("image,x1,y1,x2,y2,score\n", "the header is"),
        ("image,x1,y1,x2,y2,score,class\na.png,1,2,3,x,0.5,1\n", "boxes.csv:2"),
        ("image,x1,y1,x2,y2,score,class\na.png,1,2,3,4,0.5,1.5\n", "class from 1"),
        ("image,x1,y1,x2,y2,score,class\na.png,5,2,3,4,0.5,1\n", "x1 < x2"),
    ],
)
def test_mistakes_are_told(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "boxes.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read_boxes(tmp_path / "boxes.csv")
