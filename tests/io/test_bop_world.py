from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from io_strategies import SEEDS, random_poses
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import local, make_pose, retract
from poet_loc.io.bop_world import Sightings, fit_camera_offset, place_objects, robust_mean_pose

YCBV_OFFSET = make_pose(Rotation.from_quat([0.00075, -0.00287, -0.01066, 0.99994]), [0.02627, -0.00017, 0.00028])


def noise(count: int, seed: int, angle_rad: float, distance_m: float) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 6)) * np.repeat([angle_rad, distance_m], 3)


def wrong_where(bad: np.ndarray, T: RigidTransform, seed: int) -> RigidTransform:
    matrices = T.as_matrix()
    matrices[bad] = random_poses(int(bad.sum()), seed).as_matrix()
    return RigidTransform.from_matrix(matrices)


def sightings(offset: RigidTransform, seed: int, turn_rad: float = 0.6, about=(1, 1, 1)) -> Sightings:
    """Sightings of three objects whose camera trajectory belongs to a camera that the true camera sits at."""
    rng = np.random.default_rng(seed)
    count = 120
    frames = np.repeat(np.arange(count), 3)
    rotations = Rotation.from_rotvec(rng.normal(size=(count, 3)) * turn_rad * np.array(about))
    T_world_true = make_pose(rotations, rng.normal(size=(count, 3)))
    objects = random_poses(3, seed + 1)
    indices = np.tile(np.arange(3), count)
    return Sightings(
        keys=((1, 0), (2, 0), (2, 1)),
        landmark_indices=indices,
        T_world_cam=(T_world_true * offset.inv())[frames],
        T_cam_obj=T_world_true.inv()[frames] * objects[indices],
    )


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_robust_mean_of_one_pose_seen_often_is_that_pose(seed):
    pose = random_poses(1, seed)
    mean = robust_mean_pose(RigidTransform.concatenate([pose] * 5))
    np.testing.assert_allclose(local(pose[0], mean), 0, atol=1e-7)


def test_robust_mean_is_the_geometric_median():
    poses = retract(RigidTransform.identity(41), noise(41, 0, 0.1, 0.1))
    poses = wrong_where(np.arange(41) % 4 == 0, poses, 1)
    mean = robust_mean_pose(poses)

    def distances(point: np.ndarray) -> float:
        return float(np.linalg.norm(poses.translation - point, axis=1).sum())

    def chords(rotvec: np.ndarray) -> float:
        matrix = Rotation.from_rotvec(rotvec).as_matrix()
        return float(np.linalg.norm(poses.rotation.as_matrix() - matrix, axis=(1, 2)).sum())

    best = minimize(distances, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    np.testing.assert_allclose(mean.translation, best.x, atol=1e-5)
    best = minimize(chords, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    np.testing.assert_allclose(mean.rotation.as_rotvec(), best.x, atol=1e-5)


def test_robust_mean_bears_two_fifths_of_wrong_poses():
    truth = random_poses(1, 3)[0]
    poses = retract(RigidTransform.concatenate([truth] * 200), noise(200, 4, 0.01, 0.005))
    mean = robust_mean_pose(wrong_where(np.arange(200) % 5 < 2, poses, 5))
    error = local(truth, mean)
    # the wrong ones are metres away; what is left is about one sigma
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.linalg.norm(error[3:]) < 0.01


def test_robust_mean_moves_with_the_world():
    poses, move = random_poses(20, 6), random_poses(1, 7)[0]
    np.testing.assert_allclose(
        robust_mean_pose(move * poses).as_matrix(), (move * robust_mean_pose(poses)).as_matrix(), atol=1e-6
    )


def test_spread_is_the_ninetieth_percentile():
    scene = sightings(RigidTransform.identity(), 0)
    shifts = np.zeros((360, 6))
    shifts[:, 3] = np.where(np.arange(360) // 3 % 12 == 0, 0.5, 0.0)  # one frame of twelve is half a metre off
    shifts[:, 4] = np.where(np.arange(360) // 3 % 2 == 0, 0.002, -0.002)
    moved = Sightings(scene.keys, scene.landmark_indices, scene.T_world_cam, retract(scene.T_cam_obj, shifts))
    for place in place_objects(moved):
        assert place.frames == 120
        assert 0.0019 < place.distance_p90_m < 0.0045
        assert place.angle_p90_rad < 1e-6


def test_noise_free_offset_is_found_exactly():
    scenes = [sightings(YCBV_OFFSET, seed) for seed in (0, 10)]
    assert max(place.distance_p90_m for place in place_objects(scenes[0])) > 0.01
    offset = fit_camera_offset(scenes)
    np.testing.assert_allclose(local(YCBV_OFFSET, offset), 0, atol=1e-9)
    assert max(place.distance_p90_m for place in place_objects(scenes[0].moved(offset))) < 1e-6


def test_large_offset_is_found_too():
    offset = make_pose(Rotation.from_rotvec([0.1, -0.5, 0.4]), [0.3, -0.2, 0.1])
    np.testing.assert_allclose(local(offset, fit_camera_offset([sightings(offset, 1)])), 0, atol=1e-8)


def test_offset_bears_noise_and_wrong_poses():
    scene = sightings(YCBV_OFFSET, 2)
    count = len(scene.T_cam_obj)
    seen = retract(scene.T_cam_obj, noise(count, 0, np.deg2rad(0.2), 0.001))
    seen = wrong_where(np.arange(count) % 10 == 0, seen, 1)
    offset = fit_camera_offset([Sightings(scene.keys, scene.landmark_indices, scene.T_world_cam, seen)])
    error = local(YCBV_OFFSET, offset)
    assert np.linalg.norm(error[3:]) < 0.001
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.1


@pytest.mark.parametrize("about", [(0, 0, 0), (0, 0, 1), (0.01, 0.01, 0.01)])
def test_a_camera_that_hardly_turns_tells_no_offset(about):
    assert fit_camera_offset([sightings(YCBV_OFFSET, 3, about=about)]) is None
