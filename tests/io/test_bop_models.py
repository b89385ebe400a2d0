from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.records import Symmetry
from poet_loc.io.bop_models import BopModel, read_models_info, write_models_info

BOX = '"min_x": -50, "min_y": -20, "min_z": -5, "size_x": 100, "size_y": 40, "size_z": 10'
GOLDEN = f"""{{
 "2": {{"diameter": 269.573, {BOX}}},
 "13": {{"diameter": 161.9, {BOX}, "symmetries_continuous": [{{"axis": [0, 0, 1], "offset": [1.5, 0, 0]}}]}},
 "21": {{"diameter": 100, {BOX}, "symmetries_discrete": [[-1, 0, 0, -0.5, 0, -1, 0, 2, 0, 0, 1, 0, 0, 0, 0, 1]]}}
}}
"""


def test_golden_file(write):
    models = read_models_info(write(GOLDEN))
    assert list(models) == [2, 13, 21]
    assert models[2].diameter_m == pytest.approx(0.269573)
    assert models[2].box_m == ((-0.05, -0.02, -0.005), (0.1, 0.04, 0.01))
    assert models[2].symmetry is None
    assert models[13].symmetries_continuous == (((0, 0, 1), (0.0015, 0, 0)),)
    assert models[13].symmetry == Symmetry((0, 0, 1), "continuous")
    np.testing.assert_allclose(models[21].symmetries_discrete.translation, [[-0.0005, 0.002, 0]])
    assert models[21].symmetry.order == 2
    np.testing.assert_allclose(models[21].symmetry.axis, [0, 0, 1], atol=1e-12)


def test_round_trip(write, tmp_path):
    models = read_models_info(write(GOLDEN))
    write_models_info(tmp_path / "models_info.json", models)
    again = read_models_info(tmp_path / "models_info.json")
    assert list(again) == list(models)
    for key, model in models.items():
        assert again[key].diameter_m == pytest.approx(model.diameter_m, rel=1e-15)
        np.testing.assert_allclose(again[key].box_m, model.box_m, rtol=1e-15)
        assert again[key].symmetries_continuous == model.symmetries_continuous
        assert (again[key].symmetries_discrete is None) == (model.symmetries_discrete is None)
    np.testing.assert_allclose(again[21].symmetries_discrete.as_matrix(), models[21].symmetries_discrete.as_matrix())


def turns(*rotvecs) -> BopModel:
    rotations = Rotation.from_rotvec(np.array(rotvecs, float))
    return BopModel(0.1, ((0, 0, 0), (1, 1, 1)), RigidTransform.from_rotation(rotations))


@pytest.mark.parametrize("order", [2, 3, 4, 6])
def test_turns_about_one_axis_are_one_group(order):
    axis = np.array([0.0, -0.6, 0.8])
    symmetry = turns(*[axis * 2 * np.pi * k / order for k in range(1, order)]).symmetry
    assert symmetry.order == order
    assert abs(np.dot(symmetry.axis, axis)) == pytest.approx(1)


def test_of_several_axes_the_one_with_most_turns_is_kept():
    quarter = [[0, 0, np.pi / 2 * k] for k in (1, 2, 3)]
    symmetry = turns([np.pi, 0, 0], [0, np.pi, 0], *quarter).symmetry
    assert symmetry == Symmetry((0, 0, 1), 4)
    assert turns([np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi]).symmetry.order == 2


def test_what_is_no_group_of_turns_is_left_out_with_a_warning():
    with pytest.warns(UserWarning, match="left out"):
        assert turns([0, 0, 1.0]).symmetry is None


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("", None, "empty"),
        ("[]", None, "no models"),
        (GOLDEN.replace('"13"', '"bowl"'), 3, "'bowl' is no object id"),
        (GOLDEN.replace('"diameter": 161.9, ', ""), 3, "model 13: diameter is missing"),
        (GOLDEN.replace("161.9", "-1"), 3, "model 13: diameter is not positive"),
        (GOLDEN.replace("[0, 0, 1]", "[0, 0, 0]"), 3, "model 13: axis of symmetries_continuous is zero"),
        (GOLDEN.replace("[[-1, 0", "[[-2, 0"), 4, "model 21: symmetries_discrete holds no rotation"),
    ],
)
def test_bad_input(write, refusal, text, line, what):
    error = refusal(read_models_info, write(text))
    assert what in str(error)
    assert error.line == line
