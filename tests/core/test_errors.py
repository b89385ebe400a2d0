"""Errors against evo, brute force and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics
from evo.core.filters import filter_pairs_by_path
from evo.core.trajectory import PosePath3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core import errors
from poet_loc.core.geometry import make_pose

RELATIONS = [relation.name for relation in metrics.PoseRelation]


def walk(seed: int, poses: int = 150) -> tuple[RigidTransform, RigidTransform]:
    """A reference that walks, stands still for a while and turns, and an estimate near it."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.03, 0.05, (poses, 3))
    steps[40:60] = 0.0
    turns = np.cumsum(rng.normal(0.02, 0.1, (poses, 3)), axis=0)
    ref = make_pose(Rotation.from_rotvec(turns), np.cumsum(steps, axis=0) + [100.0, -20.0, 3.0])
    noise = rng.normal(0.0, 0.05, (poses, 6)) * (rng.random((poses, 1)) < 0.9)
    return ref * RigidTransform.from_exp_coords(noise), ref


def as_evo(poses: RigidTransform) -> PosePath3D:
    return PosePath3D(poses_se3=list(poses.as_matrix()))


@pytest.mark.parametrize("relation", RELATIONS)
def test_ape_agrees_with_evo(relation: errors.Relation) -> None:
    est, ref = walk(1)
    if relation == "point_distance_error_ratio":
        with pytest.raises(ValueError, match="relative_pose_error"):
            errors.absolute_pose_error(est, ref, relation)
        return
    oracle = metrics.APE(metrics.PoseRelation[relation])
    oracle.process_data((as_evo(ref), as_evo(est)))
    np.testing.assert_allclose(errors.absolute_pose_error(est, ref, relation), oracle.error, rtol=0, atol=1e-9)


@pytest.mark.parametrize("relation", RELATIONS)
@pytest.mark.parametrize("all_pairs", [False, True])
@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (7, "frames"), (0.25, "meters"), (1.0, "meters")])
def test_rpe_agrees_with_evo(relation: errors.Relation, all_pairs: bool, delta: float, unit: str) -> None:
    est, ref = walk(2)
    oracle = metrics.RPE(metrics.PoseRelation[relation], delta, metrics.Unit[unit], all_pairs=all_pairs)
    oracle.process_data((as_evo(ref), as_evo(est)))
    if unit == "frames":
        pairs = errors.pairs_by_frames(len(est), int(delta), all_pairs)
    else:
        pairs = errors.pairs_by_metres(est.translation, delta, all_pairs)
    error = errors.relative_pose_error(est, ref, pairs, relation)
    assert len(error) > 5
    np.testing.assert_allclose(error, oracle.error, rtol=1e-9, atol=1e-9)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 4), min_size=1, max_size=30), st.integers(1, 9), st.sampled_from([0.0, 0.1, 0.6]))
def test_pairs_by_metres_are_evos(steps: list[int], delta: int, tolerance: float) -> None:
    """Whole steps along a line, some of them zero: ties and exact hits are the rule."""
    positions = np.zeros((len(steps) + 1, 3))
    positions[1:, 0] = np.cumsum(steps)
    poses = list(make_pose(Rotation.identity(len(positions)), positions).as_matrix())
    for all_pairs in (False, True):
        oracle = filter_pairs_by_path(poses, float(delta), tolerance * delta, all_pairs)
        i, j = errors.pairs_by_metres(positions, delta, all_pairs, tolerance)
        assert list(zip(i.tolist(), j.tolist(), strict=True)) == oracle


def test_pairs_of_short_logs_are_empty() -> None:
    assert len(errors.pairs_by_frames(3, 5)[0]) == len(errors.pairs_by_frames(3, 5, all_pairs=True)[0]) == 0
    for all_pairs in (False, True):
        assert len(errors.pairs_by_metres(np.zeros((1, 3)), 1.0, all_pairs)[0]) == 0


def test_position_error_is_in_world_axes() -> None:
    ref = make_pose(Rotation.from_rotvec([[0.0, 0.0, 2.0]]), [[1.0, 2.0, 3.0]])
    est = make_pose(Rotation.from_rotvec([[0.0, 1.0, 0.0]]), [[1.1, 1.8, 3.3]])
    np.testing.assert_allclose(errors.position_error(est, ref), [[0.1, -0.2, 0.3]], atol=1e-15)


@pytest.mark.parametrize(("axis", "column"), [(2, 0), (1, 1), (0, 2)])
def test_attitude_error_names_its_axes(axis: int, column: int) -> None:
    """A turn of the estimate about one of its own axes shows in that axis's column alone, with its sign."""
    ref = Rotation.random(4, random_state=3)
    est = ref * Rotation.from_rotvec(-0.2 * np.eye(3)[axis])
    poses = [make_pose(R, np.zeros((4, 3))) for R in (est, ref)]
    expected = np.zeros((4, 3))
    expected[:, column] = -0.2
    np.testing.assert_allclose(errors.attitude_error(*poses), expected, atol=1e-12)
    np.testing.assert_allclose(errors.rotation_angle(*poses), 0.2, atol=1e-12)
    assert errors.ATTITUDE_AXES[column] == ("roll", "pitch", "yaw")[axis]


def test_statistics_by_hand() -> None:
    got = errors.statistics([-1.0, 2.0, -3.0, 10.0])
    assert got == errors.Statistics(
        mean=4.0, std=pytest.approx(12.5**0.5), median=2.5, p95=pytest.approx(8.95), rmse=pytest.approx(28.5**0.5)
    )
    assert got.scaled(1000.0).median == 2500.0
    assert np.isnan(errors.statistics([]).rmse)
