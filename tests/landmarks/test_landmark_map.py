"""Symmetry rotations as a group, and the nearest one by brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from landmarks.landmark_map import CONTINUOUS, landmark_names, map_arrays, symmetry_rotations
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Landmark, LandmarkMap, Symmetry

AXIS = (0.36, -0.48, 0.8)


def one_landmark(symmetry: Symmetry | None) -> LandmarkMap:
    return LandmarkMap((Landmark(7, make_pose(Rotation.identity(), np.zeros(3)), symmetry=symmetry),))


@pytest.mark.parametrize("order", [2, 3, 4, 7])
def test_symmetry_rotations_are_the_cyclic_group(order: int) -> None:
    rotations = symmetry_rotations(Symmetry(AXIS, order))
    assert rotations.shape == (order, 3, 3)
    np.testing.assert_allclose(rotations[0], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotations @ np.array(AXIS), np.tile(AXIS, (order, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.matrix_power(rotations[1], order), np.eye(3), atol=1e-12)
    for power in range(order):
        np.testing.assert_allclose(np.linalg.matrix_power(rotations[1], power), rotations[power], atol=1e-12)


def test_no_symmetry_is_the_identity_and_a_continuous_one_has_no_list() -> None:
    np.testing.assert_array_equal(symmetry_rotations(None), np.eye(3)[None])
    with pytest.raises(ValueError, match="continuous"):
        symmetry_rotations(Symmetry(AXIS, "continuous"))


@given(seed=st.integers(0, 2**32 - 1), order=st.sampled_from([1, 2, 3, 5, "continuous"]))
def test_nearest_symmetry_is_the_best_of_all_turns(seed: int, order: int) -> None:
    rng = np.random.default_rng(seed)
    symmetry = None if order == 1 else Symmetry(AXIS, order)
    measured, expected = Rotation.random(rng=rng), Rotation.random(rng=rng)
    arrays = map_arrays(one_landmark(symmetry))
    found = arrays.nearest_symmetry(np.zeros(1, np.intp), measured.as_matrix()[None], expected.as_matrix()[None])
    turns = np.linspace(0, 2 * np.pi, 3601)[:-1] if order == "continuous" else 2 * np.pi * np.arange(order) / order
    choices = measured * Rotation.from_rotvec(turns[:, None] * np.array(AXIS))
    least = (expected.inv() * choices).magnitude().min()
    angle = (expected.inv() * Rotation.from_matrix(found[0])).magnitude()
    assert angle <= least + 1e-9
    assert angle >= least - (1e-3 if order == "continuous" else 1e-6)
    # and it is one of them: the axis stays where it was
    np.testing.assert_allclose(found[0] @ np.array(AXIS), measured.apply(AXIS), atol=1e-9)


def test_arrays_keep_the_order_of_the_map() -> None:
    covariance = np.diag(np.arange(1.0, 7.0))
    landmarks = LandmarkMap(
        (
            Landmark(5, make_pose(Rotation.from_rotvec([0, 0, 1]), [1, 2, 3]), 1, covariance=covariance),
            Landmark(2, make_pose(Rotation.identity(), [4, 5, 6]), symmetry=Symmetry(AXIS, "continuous")),
            Landmark(5, make_pose(Rotation.identity(), [7, 8, 9]), symmetry=Symmetry(AXIS, 4)),
        )
    )
    arrays = map_arrays(landmarks)
    np.testing.assert_array_equal(arrays.object_ids, [5, 2, 5])
    np.testing.assert_array_equal(arrays.instances, [1, 0, 0])
    np.testing.assert_array_equal(arrays.orders, [1, CONTINUOUS, 4])
    np.testing.assert_array_equal(arrays.covariances, [covariance, np.zeros((6, 6)), np.zeros((6, 6))])
    np.testing.assert_allclose(arrays.t_world_obj, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    np.testing.assert_allclose(arrays.R_world_obj[0], Rotation.from_rotvec([0, 0, 1]).as_matrix())
    assert len(map_arrays(LandmarkMap())) == 0


def test_names() -> None:
    assert landmark_names([(2, 0), (3, 1)]) == "2:0 3:1"
    assert landmark_names([]) == ""
