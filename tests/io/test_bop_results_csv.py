from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from io_strategies import INT64, SEEDS, random_poses, same_poses

from poet_loc.io.bop_results_csv import BopResults, read_bop_results, write_bop_results

HEADER = "scene_id,im_id,obj_id,score,R,t,time\n"
ROW = "48,1,2,0.5,1 0 0 0 0 -1 0 1 0,100.5 -200 1500,0.018\n"
LATER = "48,36,13,1.0,1 0 0 0 1 0 0 0 1,0 0 900,-1\n"
GOLDEN = HEADER + ROW + LATER


def test_golden_file(write):
    results = read_bop_results(write(GOLDEN))
    assert results.scene_ids.tolist() == [48, 48]
    assert results.image_ids.tolist() == [1, 36]
    assert results.object_ids.tolist() == [2, 13]
    assert results.scores.tolist() == [0.5, 1]
    assert results.times_s.tolist() == [0.018, -1]
    np.testing.assert_allclose(results.T_cam_obj[0].apply([0, 1, 0]), [0.1005, -0.2, 2.5], atol=1e-15)


def test_header_glued_to_its_first_row_is_repaired_with_a_warning(write):
    with pytest.warns(UserWarning, match=r":1: the header is glued to its first row"):
        results = read_bop_results(write(HEADER.strip() + GOLDEN.removeprefix(HEADER)))
    assert results.image_ids.tolist() == [1, 36]
    assert results.object_ids.tolist() == [2, 13]


def test_official_file(shared_fixtures):
    path = shared_fixtures / "poet_official" / "eval" / "bop_example.csv"
    with pytest.warns(UserWarning, match="glued"):
        results = read_bop_results(path)
    assert results.scene_ids.tolist() == [48] * 6
    assert results.image_ids.tolist() == [1, 1, 2, 2, 3, 3]
    assert results.object_ids.tolist() == [1, 2, 2, 3, 3, 1]
    np.testing.assert_allclose(results.T_cam_obj.translation[0] * 1e3, [402.928253, -677.044662, -634.408325])


@given(ids=st.lists(st.tuples(INT64, INT64, INT64), min_size=1, max_size=6), seed=SEEDS)
@settings(max_examples=50, deadline=None)
def test_round_trip(tmp_path_factory, ids, seed):
    path = tmp_path_factory.mktemp("results") / "results.csv"
    columns = np.array(ids, np.int64).T
    rng = np.random.default_rng(seed)
    results = BopResults(*columns, rng.uniform(size=len(ids)), random_poses(len(ids), seed), rng.uniform(size=len(ids)))
    write_bop_results(path, results)
    again = read_bop_results(path)
    for name in ("scene_ids", "image_ids", "object_ids", "scores", "times_s"):
        np.testing.assert_array_equal(getattr(again, name), getattr(results, name))
    assert same_poses(again.T_cam_obj, results.T_cam_obj)


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("", None, "empty"),
        (HEADER, None, "no rows"),
        (ROW, 1, "the header is"),
        (HEADER + ROW + LATER.replace(",13,", ","), 3, "no row of BOP results"),
        (HEADER + ROW + LATER.replace("0 0 900", "0 900"), 3, "no row of BOP results"),
        (HEADER + ROW + "\n" + LATER.replace("0 0 900,", "0 0,900 "), 4, "no row of BOP results"),
        (HEADER + ROW + LATER.replace("48,", "forty,"), 3, "no row of BOP results"),
        (HEADER + ROW + LATER.replace("900", "nan"), 3, "NaN or infinite"),
        (HEADER + ROW + LATER.replace("1 0 0 0 1", "1 0 0 0 2"), 3, "R is no rotation"),
        (HEADER + LATER.replace("900", "0.9"), None, "looks like metres"),
    ],
)
def test_bad_input(write, refusal, text, line, what):
    error = refusal(read_bop_results, write(text))
    assert what in str(error)
    assert error.line == line
