"""Errors up to symmetry, against brute force over the group and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core import symmetric_errors as se
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Symmetry

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0


def turns(order: int) -> Rotation:
    return Rotation.from_rotvec(np.arange(order)[:, None] * 2 * np.pi / order * AXIS)


@pytest.mark.parametrize("order", [2, 3, 5, "continuous"])
def test_least_angle_is_that_of_brute_force(order) -> None:
    est, ref = Rotation.random(30, rng=np.random.default_rng(0)), Rotation.random(30, rng=np.random.default_rng(1))
    every = turns(3600 if order == "continuous" else order)
    brute = np.min([((ref * turn).inv() * est).magnitude() for turn in every], axis=0)
    found = se.rotation_angle_up_to_symmetry(est, ref, Symmetry(tuple(3 * AXIS), order))
    np.testing.assert_allclose(found, brute, atol=2e-3 if order == "continuous" else 1e-12)
    whole = se.rotation_angle_up_to_symmetry(est, ref, None)
    np.testing.assert_allclose(whole, (ref.inv() * est).magnitude())
    assert (found <= whole + 1e-12).all()


@settings(max_examples=50, deadline=None)
@given(turn=st.floats(-3.1, 3.1), tilt=st.floats(0, 3.0), seed=st.integers(0, 99))
def test_turn_and_tilt_are_told_apart(turn: float, tilt: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ref = Rotation.random(1, rng=rng)
    across = np.cross(AXIS, rng.normal(size=3))
    across /= np.linalg.norm(across)
    est = ref * Rotation.from_rotvec([tilt * across]) * Rotation.from_rotvec([turn * AXIS])
    np.testing.assert_allclose(se.turn_about_axis(est, ref, AXIS), abs(turn), atol=1e-6)
    np.testing.assert_allclose(se.axis_tilt(est, ref, AXIS), tilt, atol=1e-6)


def random_poses(count: int, seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return make_pose(Rotation.random(count, rng=rng), rng.normal(size=(count, 3)) * 0.05 + [0, 0, 1])


def test_mssd_and_mspd_by_hand() -> None:
    points = np.random.default_rng(2).normal(size=(40, 3)) * 0.05
    est, ref = random_poses(5, 0), random_poses(5, 1)
    half_turn = make_pose(Rotation.from_rotvec([np.pi * AXIS]), [[0.01, 0.0, 0.02]])
    symmetries = se.symmetry_transforms(half_turn)
    assert len(symmetries) == 2
    camera = np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]])
    for n in range(5):
        surface, pixels = [], []
        for s in symmetries:
            distances, shifts = [], []
            for p in points:
                a, b = est[n].apply(p), ref[n].apply(s.apply(p))
                distances.append(np.linalg.norm(a - b))
                shifts.append(np.linalg.norm((camera @ a)[:2] / a[2] - (camera @ b)[:2] / b[2]))
            surface.append(max(distances))
            pixels.append(max(shifts))
        assert se.mssd(est[n : n + 1], ref[n : n + 1], points, symmetries)[0] == pytest.approx(min(surface))
        assert se.mspd(est[n : n + 1], ref[n : n + 1], points, symmetries, camera)[0] == pytest.approx(min(pixels))


def test_a_turned_body_of_revolution_has_no_error() -> None:
    angle = np.arange(360) * 2 * np.pi / 360
    ring = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), np.full(360, 0.02)], -1) + [0.1, 0.0, 0.0]
    symmetries = se.symmetry_transforms(None, [((0.0, 0.0, 1.0), (0.1, 0.0, 0.0))])
    ref = random_poses(3, 4)
    turn = make_pose(
        Rotation.from_rotvec([0, 0, 1.1]), [0.1, 0, 0] - Rotation.from_rotvec([0, 0, 1.1]).apply([0.1, 0, 0])
    )
    est = RigidTransform.concatenate([pose * turn for pose in ref])
    assert se.mssd(est, ref, ring, symmetries).max() < 0.05 * 0.02
    assert se.mssd(est, ref, ring, se.symmetry_transforms(None)).min() > 0.04


def test_average_recall_counts_what_is_missing() -> None:
    assert se.average_recall([0.01, 0.2], [0.05, 0.1, 0.15, 0.25], 2) == pytest.approx(100 * (3 * 0.5 + 1) / 4)
    assert se.average_recall([0.0], se.RECALL_SHARES, 4) == 25.0
    assert np.isnan(se.average_recall([], se.RECALL_PIXELS, 0))
    assert se.RECALL_SHARES[0] == 0.05
    assert se.RECALL_SHARES[-1] == 0.5
    assert len(se.RECALL_PIXELS) == 10


def test_visible_surface_discrepancy() -> None:
    ref = np.zeros((20, 20))
    ref[5:15, 5:15] = 1.0
    scene = np.where(ref > 0, 1.0, 3.0)
    assert se.vsd(ref, ref, scene, tau=0.02) == 0.0
    assert se.vsd(ref + 0.03 * (ref > 0), ref, scene, tau=0.02) == 1.0
    moved = np.roll(ref, 5, axis=1)
    assert se.vsd(moved, ref, scene, tau=0.02) == pytest.approx(1 - 50 / 150)
    covered = scene.copy()
    covered[:, :10] = 0.5  # something stands before the left half: it does not count
    assert se.vsd(ref, ref, covered, tau=0.02) == 0.0
    assert se.vsd(np.zeros((20, 20)), ref, scene, tau=0.02) == 1.0
