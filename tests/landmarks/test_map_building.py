"""Maps from known camera poses: exact without noise, robust, symmetric, refused when they scatter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors

from landmarks.map_building import MapOptions, build_map
from poet_loc.core.geometry import local, make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import LandmarkMap, ObjectPoses, Symmetry
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import read_log

BOX = Symmetry((0.0, 0.6, 0.8), 2)
CAN = Symmetry((0.0, 0.0, 1.0), "continuous")


def apart(built: LandmarkMap, true: LandmarkMap) -> np.ndarray:
    """(L, 6) xi from the true to the built landmarks."""
    assert [each.key for each in built] == [each.key for each in true]
    return local(true.T_world_obj, built.T_world_obj)


def test_without_noise_the_map_is_exact() -> None:
    rng = np.random.default_rng(0)
    true, truth = make_map(rng, [2, 3, 3, 9]), fly_around(rng, 40)
    built = build_map(detect(truth, true), truth, names={2: "box"})
    np.testing.assert_allclose(apart(built.landmark_map, true), 0.0, atol=1e-9)
    assert [each.name for each in built.landmark_map] == ["box", "", "", ""]
    assert not built.refused
    for spread in built.spreads:
        assert (spread.samples, spread.inlier_share) == (40, 1.0)
        assert spread.spread_mm < 1e-6


def test_a_third_of_gross_errors_moves_nothing() -> None:
    rng = np.random.default_rng(1)
    true, truth = make_map(rng, [1, 2]), fly_around(rng, 600)
    errors = small_errors(rng, 600, 2)
    errors[200:400, 0] = gross_errors(rng, 200)
    errors[200:400, 1] = gross_errors(rng, 1)  # a steady one
    built = build_map(detect(truth, true, errors), truth)
    xi = apart(built.landmark_map, true)
    assert np.abs(xi[:, :3]).max() < np.radians(0.5)
    assert np.abs(xi[:, 3:]).max() < 0.003
    for spread in built.spreads:
        assert spread.inlier_share == pytest.approx(2 / 3, abs=0.02)


def test_covariance_counts_independent_errors() -> None:
    """Errors that stay for a second each: the map's NEES over many draws."""
    rng = np.random.default_rng(2)
    true, truth = make_map(rng, [1]), fly_around(rng, 240, step_ns=250_000_000)
    squares = []
    for _ in range(100):
        errors = np.repeat(small_errors(rng, 60, 1), 4, axis=0)
        built = build_map(detect(truth, true, errors), truth).landmark_map
        xi = apart(built, true)[0]
        squares.append(xi @ np.linalg.solve(built.landmarks[0].covariance, xi) / 6.0)
    assert 0.8 < np.mean(squares) < 1.4


@pytest.mark.parametrize("symmetry", [BOX, CAN])
def test_symmetric_objects(symmetry: Symmetry) -> None:
    rng = np.random.default_rng(3)
    true, truth = make_map(rng, [1, 2], {1: symmetry}), fly_around(rng, 200)
    poses = detect(truth, true, small_errors(rng, 200, 2, 0.5))
    turns = rng.choice([0.0, np.pi], (400, 1)) if symmetry is BOX else rng.uniform(-np.pi, np.pi, (400, 1))
    turns[poses.object_ids == 1] = 0.0
    rotation = poses.T_cam_obj.rotation * Rotation.from_rotvec(turns * np.array(symmetry.axis))
    flipped = ObjectPoses(**{**vars(poses), "T_cam_obj": make_pose(rotation, poses.T_cam_obj.translation)})
    built = build_map(flipped, truth, symmetries={2: symmetry})
    assert not built.refused
    landmark, expected = built.landmark_map.landmarks[1], true.landmarks[1]
    assert landmark.symmetry == symmetry
    np.testing.assert_allclose(landmark.T_world_obj.translation, expected.T_world_obj.translation, atol=0.002)
    axes = [each.T_world_obj.rotation.apply(symmetry.axis) for each in (landmark, expected)]
    np.testing.assert_allclose(axes[0], axes[1], atol=0.01)
    if symmetry is BOX:
        turn = (expected.T_world_obj.rotation.inv() * landmark.T_world_obj.rotation).magnitude()
        assert min(turn, abs(np.pi - turn)) < 0.01
    assert built.spreads[1].inlier_share == 1.0
    assert build_map(flipped, truth).spreads[1].inlier_share < 0.65  # unless one says that it is symmetric


def test_what_scatters_is_refused_with_a_reason() -> None:
    rng = np.random.default_rng(4)
    true, truth = make_map(rng, [1, 2, 3, 4]), fly_around(rng, 60)
    errors = small_errors(rng, 60, 4)
    errors[:, 1] = gross_errors(rng, 60)
    errors[:, 2, 3:] += 0.05 * rng.standard_normal((60, 3))
    seen = np.ones((60, 4), bool)
    seen[3:, 3] = False
    built = build_map(detect(truth, true, errors, seen), truth)
    assert [landmark.object_id for landmark in built.landmark_map] == [1]
    reasons = {spread.object_id: spread.refused for spread in built.refused}
    assert "of its poses agree" in reasons[2]
    assert "position scatters by" in reasons[3]
    assert "seen 3 times" in reasons[4]
    lax = MapOptions(max_spread_mm=1e4, max_spread_deg=360.0, min_inlier_share=0.0, min_samples=1)
    assert len(build_map(detect(truth, true, errors, seen), truth, lax).landmark_map) == 4


def test_no_common_time_is_a_mistake() -> None:
    rng = np.random.default_rng(5)
    true, truth = make_map(rng, [1]), fly_around(rng, 20)
    later = Trajectory(truth.stamps_ns + 3_600_000_000_000, truth.T_world_body)
    with pytest.raises(InputError, match="no detection falls inside the span"):
        build_map(detect(truth, true), later)


def test_real_detections_find_the_real_map(shared_data: Path) -> None:
    log = read_log(shared_data / "ycbv_dope" / "0017", "supervised")
    built = build_map(log.object_poses["supervised"], log.T_world_cam)
    xi = apart(built.landmark_map, log.landmark_map)
    assert np.linalg.norm(xi[:, 3:], axis=1).max() < 0.03
    assert np.linalg.norm(xi[:, :3], axis=1).max() < np.radians(3.0)
