"""Which detection is which landmark: several instances, symmetric objects, strangers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors

from landmarks.association import associate
from landmarks.landmark_map import map_arrays, symmetry_rotations
from landmarks.options import SolverOptions
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import LandmarkMap, ObjectPoses, Symmetry

CAN = Symmetry((0.0, 0.0, 1.0), "continuous")
BOX = Symmetry((0.0, 0.6, 0.8), 2)
STAR = Symmetry((1.0, 0.0, 0.0), 5)


def with_columns(poses: ObjectPoses, **columns: np.ndarray) -> ObjectPoses:
    kept = {name: getattr(poses, name) for name in poses.__dataclass_fields__}
    return ObjectPoses(**{**kept, **columns})


def turned(poses: ObjectPoses, rotations: np.ndarray) -> ObjectPoses:
    """The detections with another, equally good, rotation."""
    rotation = poses.T_cam_obj.rotation * Rotation.from_matrix(rotations)
    return with_columns(poses, T_cam_obj=make_pose(rotation, poses.T_cam_obj.translation))


def angles(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return (Rotation.from_matrix(expected).inv() * Rotation.from_matrix(found)).magnitude()


def test_one_landmark_and_one_detection_of_a_class_need_no_geometry() -> None:
    rng = np.random.default_rng(0)
    landmarks, truth = make_map(rng, [4, 9, 2]), fly_around(rng, 5)
    poses = detect(truth, landmarks, gross_errors(rng, 15).reshape(5, 3, 6))
    poses = with_columns(poses, instances=np.full(15, 3))  # a detector's own count
    found = associate(poses, map_arrays(landmarks), SolverOptions())
    np.testing.assert_array_equal(found.landmarks, np.tile([0, 1, 2], 5))
    np.testing.assert_allclose(found.R_cam_obj, poses.T_cam_obj.rotation.as_matrix())


def test_a_class_that_the_map_does_not_have_is_no_landmark() -> None:
    rng = np.random.default_rng(1)
    landmarks, truth = make_map(rng, [4, 9, 2]), fly_around(rng, 4)
    poses = detect(truth, landmarks)
    known = LandmarkMap(landmarks.landmarks[:2])
    found = associate(poses, map_arrays(known), SolverOptions())
    np.testing.assert_array_equal(found.landmarks, np.tile([0, 1, -1], 4))
    empty = associate(poses, map_arrays(LandmarkMap()), SolverOptions())
    np.testing.assert_array_equal(empty.landmarks, np.full(12, -1))


@pytest.mark.parametrize("object_ids", [[1, 2, 5, 5], [1, 5, 5, 5], [5, 5, 5, 5], [5, 5, 8, 8, 8]])
def test_instances_of_a_class_are_told_apart_by_geometry(object_ids: list[int]) -> None:
    rng = np.random.default_rng(2)
    landmarks, truth = make_map(rng, object_ids), fly_around(rng, 40)
    poses = detect(truth, landmarks, small_errors(rng, 40, len(object_ids)))
    order = np.concatenate([frame * len(object_ids) + rng.permutation(len(object_ids)) for frame in range(40)])
    shuffled = with_columns(poses[order], instances=rng.integers(0, 9, len(order)))
    found = associate(shuffled, map_arrays(landmarks), SolverOptions())
    np.testing.assert_array_equal(found.landmarks, np.tile(np.arange(len(object_ids)), 40)[order])


def test_instances_survive_a_gross_error_and_missing_ones() -> None:
    rng = np.random.default_rng(3)
    landmarks, truth = make_map(rng, [1, 2, 5, 5, 5]), fly_around(rng, 60)
    errors = small_errors(rng, 60, 5)
    errors[np.arange(60), rng.integers(0, 2, 60)] = gross_errors(rng, 60)
    seen = np.ones((60, 5), bool)
    seen[np.arange(60), rng.integers(2, 5, 60)] = False
    place = np.tile(np.arange(5), 60)[seen.ravel()]
    found = associate(detect(truth, landmarks, errors, seen), map_arrays(landmarks), SolverOptions())
    assert np.mean(found.landmarks == place) > 0.97


def test_instance_numbers_are_believed_when_told_so() -> None:
    rng = np.random.default_rng(4)
    landmarks, truth = make_map(rng, [5, 5, 1]), fly_around(rng, 3)
    poses = detect(truth, landmarks)
    swapped = with_columns(poses, instances=np.tile([1, 0, 0], 3))
    by_geometry = associate(swapped, map_arrays(landmarks), SolverOptions())
    by_number = associate(swapped, map_arrays(landmarks), SolverOptions(trust_instances=True))
    np.testing.assert_array_equal(by_geometry.landmarks, np.tile([0, 1, 2], 3))
    np.testing.assert_array_equal(by_number.landmarks, np.tile([1, 0, 2], 3))


def test_of_too_many_detections_the_ones_that_fit_are_taken() -> None:
    rng = np.random.default_rng(5)
    landmarks, truth = make_map(rng, [1, 2, 3]), fly_around(rng, 10)
    good = detect(truth, landmarks, small_errors(rng, 10, 3))
    ghosts = detect(truth, landmarks, gross_errors(rng, 30).reshape(10, 3, 6))[np.arange(0, 30, 3)]
    both = ObjectPoses(
        *(
            np.concatenate([getattr(good, name), getattr(ghosts, name)])
            for name in ("stamps_ns", "frames", "object_ids", "instances", "scores")
        ),
        T_cam_obj=type(good.T_cam_obj).concatenate([good.T_cam_obj, ghosts.T_cam_obj]),
    )
    found = associate(both, map_arrays(landmarks), SolverOptions())
    np.testing.assert_array_equal(found.landmarks, [*np.tile([0, 1, 2], 10), *[-1] * 10])


@pytest.mark.parametrize("symmetry", [BOX, STAR, CAN])
def test_a_symmetric_object_turns_to_where_the_others_see_it(symmetry: Symmetry) -> None:
    rng = np.random.default_rng(6)
    landmarks, truth = make_map(rng, [1, 2, 3], {2: symmetry}), fly_around(rng, 30)
    clean = detect(truth, landmarks, small_errors(rng, 30, 3))
    turns = np.tile(np.eye(3), (90, 1, 1))
    if symmetry.order == "continuous":
        turns[2::3] = Rotation.from_rotvec(rng.uniform(-3, 3, (30, 1)) * np.array(symmetry.axis)).as_matrix()
    else:
        turns[2::3] = symmetry_rotations(symmetry)[rng.integers(0, symmetry.order, 30)]
    found = associate(turned(clean, turns), map_arrays(landmarks), SolverOptions())
    expected = detect(truth, landmarks).T_cam_obj.rotation.as_matrix()
    assert angles(found.R_cam_obj, expected).max() < np.radians(15)
    if symmetry.order != "continuous":
        np.testing.assert_allclose(found.R_cam_obj, clean.T_cam_obj.rotation.as_matrix(), atol=1e-12)


def test_symmetric_objects_alone_find_each_other() -> None:
    """A half-turn box and a five-pointed star: one of the ten combinations fits."""
    rng = np.random.default_rng(7)
    landmarks, truth = make_map(rng, [1, 2], {0: BOX, 1: STAR}), fly_around(rng, 30)
    clean = detect(truth, landmarks)
    turns = np.empty((60, 3, 3))
    turns[0::2] = symmetry_rotations(BOX)[rng.integers(0, 2, 30)]
    turns[1::2] = symmetry_rotations(STAR)[rng.integers(0, 5, 30)]
    found = associate(turned(clean, turns), map_arrays(landmarks), SolverOptions())
    np.testing.assert_allclose(found.R_cam_obj, clean.T_cam_obj.rotation.as_matrix(), atol=1e-9)


def test_round_objects_alone_are_fixed_by_their_axes_and_the_line_between_them() -> None:
    rng = np.random.default_rng(8)
    landmarks, truth = make_map(rng, [1, 2, 3], {0: CAN, 1: CAN, 2: CAN}), fly_around(rng, 30)
    clean = detect(truth, landmarks)
    spin = Rotation.from_rotvec(rng.uniform(-3, 3, (90, 1)) * np.array(CAN.axis)).as_matrix()
    found = associate(turned(clean, spin), map_arrays(landmarks), SolverOptions())
    assert angles(found.R_cam_obj, clean.T_cam_obj.rotation.as_matrix()).max() < 1e-6


@pytest.mark.parametrize("symmetry", [BOX, CAN])
def test_a_symmetric_object_alone_follows_the_frame_before(symmetry: Symmetry) -> None:
    rng = np.random.default_rng(9)
    landmarks, truth = make_map(rng, [1, 2], {1: symmetry}), fly_around(rng, 40)
    seen = np.ones((40, 2), bool)
    seen[1:, 0] = False  # the other object is there in the first frame only
    clean = detect(truth, landmarks, seen=seen)
    turns = Rotation.from_rotvec(rng.choice([0.0, np.pi], (41, 1)) * np.array(symmetry.axis)).as_matrix()
    turns[clean.object_ids == 1] = np.eye(3)
    found = associate(turned(clean, turns), map_arrays(landmarks), SolverOptions())
    wrong = angles(found.R_cam_obj, clean.T_cam_obj.rotation.as_matrix())
    if symmetry is CAN:  # nobody knows its turn: it changes no faster than the camera
        assert wrong.max() < 1.0
        assert np.abs(np.diff(wrong[1:])).max() < 0.05
    else:
        assert wrong.max() < 1e-6


def test_rows_in_another_order_change_nothing() -> None:
    rng = np.random.default_rng(10)
    landmarks, truth = make_map(rng, [5, 5, 1, 2], {3: BOX}), fly_around(rng, 30)
    errors = small_errors(rng, 30, 4)
    errors[::3, 2] = gross_errors(rng, 10)
    poses = detect(truth, landmarks, errors)
    order = np.concatenate([frame * 4 + rng.permutation(4) for frame in range(30)])
    one = associate(poses, map_arrays(landmarks), SolverOptions())
    other = associate(poses[order], map_arrays(landmarks), SolverOptions())
    np.testing.assert_array_equal(other.landmarks, one.landmarks[order])
    np.testing.assert_array_equal(other.R_cam_obj, one.R_cam_obj[order])
