from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from io_strategies import STAMPS

from poet_loc.io.frames_csv import Frames, read_frames, write_frames

HEADER = "timestamp_ns,frame,image\n"
GOLDEN = HEADER + '1600059000033333333,1,rgb/000001.png\n1600059000066666667,2,"a, b.png"\n'


def test_golden_file(write):
    frames = read_frames(write(GOLDEN))
    assert frames.stamps_ns.tolist() == [1600059000033333333, 1600059000066666667]
    assert frames.frames.tolist() == [1, 2]
    assert frames.images == ("rgb/000001.png", "a, b.png")


@given(stamps=STAMPS, image=st.text('abc_/., "', max_size=10))
@settings(max_examples=40, deadline=None)
def test_round_trip(tmp_path_factory, stamps, image):
    path = tmp_path_factory.mktemp("frames") / "frames.csv"
    frames = Frames(stamps, np.arange(len(stamps)) * 3, (image.strip(),) * len(stamps))
    write_frames(path, frames)
    again = read_frames(path)
    np.testing.assert_array_equal(again.stamps_ns, stamps)
    np.testing.assert_array_equal(again.frames, frames.frames)
    assert again.images == frames.images


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("", None, "empty"),
        (HEADER, None, "no rows"),
        (GOLDEN.replace("image", "file"), 1, "the header is"),
        (HEADER + "1.5,1,a\n", 2, "no row of frames"),
        (HEADER + "1,1,a\n\n2,2\n", 4, "no row of frames"),
        (HEADER + "99999999999999999999,1,a\n", 2, "no row of frames"),
        (HEADER + "2,1,a\n1,2,b\n", 3, "goes backwards"),
        (HEADER + "2,1,a\n2,2,b\n", 3, "there twice"),
    ],
)
def test_bad_input(write, refusal, text, line, what):
    error = refusal(read_frames, write(text))
    assert what in str(error)
    assert error.line == line
