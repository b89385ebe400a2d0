"""What is believed of odometry's motion: jumps are taken off, holes are not known, what is clean stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from poet_loc.core.geometry import local
from poet_loc.core.odometry_breaks import FAR, Expected, believed_motion, odometry_breaks
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.tum import read_tum

EXPECTED = Expected((np.radians(0.25), 0.005), 0.1, (0.5, 0.3))
RATE_HZ = 30.0


def stamps_of(intervals_s) -> np.ndarray:
    return np.r_[0, np.cumsum(np.round(1e9 * np.asarray(intervals_s)))].astype(np.int64)


def hand_held(seed: int, count: int) -> np.ndarray:
    """Return twists (count, 6) of a motion that swings at 0.2 Hz, with the drift that is expected."""
    rng, at = np.random.default_rng(seed), np.arange(count) / RATE_HZ
    swing = rng.uniform(-1.0, 1.0, (6, 1)) * np.sin(2.0 * np.pi * (0.2 * at + rng.uniform(0.0, 1.0, (6, 1))))
    drift = np.repeat(EXPECTED.walk, 3) * np.sqrt(RATE_HZ) * rng.normal(size=(count, 6))
    return np.repeat([0.3, 0.2], 3) * swing.T + drift


@given(st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_clean_odometry_is_believed(seed):
    twists = hand_held(seed, 300)
    believed = believed_motion(stamps_of(np.full(300, 1.0 / RATE_HZ)), twists, EXPECTED)
    np.testing.assert_array_equal(believed.twists, twists)
    assert not believed.sigmas.any()


@given(st.integers(0, 10**6), st.integers(2, 119))
@settings(max_examples=50, deadline=None)
def test_what_is_believed_depends_on_the_past_alone(seed, until):
    """Of the first two, on both."""
    rng, twists = np.random.default_rng(seed), hand_held(seed, 120)
    intervals = np.where(rng.uniform(size=120) < 0.03, rng.uniform(0.05, 4.0, 120), 1.0 / RATE_HZ)
    twists[rng.uniform(size=120) < 0.05] += 3.0 * rng.normal(size=6)
    stamps = stamps_of(intervals)
    whole, part = (believed_motion(stamps[: n + 1], twists[:n], EXPECTED) for n in (120, until))
    for name in ("twists", "sigmas", "taken_off", "holes_s"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:until])


@given(st.integers(0, 10**6))
@settings(max_examples=50, deadline=None)
def test_what_is_not_believed_is_taken_off(seed):
    rng, twists = np.random.default_rng(seed), hand_held(seed, 120)
    at = rng.integers(0, 115)
    twists[at : at + rng.integers(1, 6)] += rng.uniform(0.0, 10.0) * rng.normal(size=6)
    believed = believed_motion(stamps_of(np.full(120, 1.0 / RATE_HZ)), twists, EXPECTED)
    off = np.linalg.norm((twists - believed.twists).reshape(-1, 2, 3), axis=2) / RATE_HZ
    np.testing.assert_allclose(believed.taken_off, off, atol=1e-12)
    np.testing.assert_array_equal(believed.sigmas, believed.taken_off)


@pytest.mark.parametrize(("at", "frames"), [(60, 1), (60, 2), (0, 1), (1, 1), (2, 1)])
def test_a_jump_is_taken_off_and_a_sigma_of_what_is_not_known(at, frames):
    """Whole, but for the little that could be motion; also where tracking slides into it over two frames."""
    twists = hand_held(1, 120)
    spoiled, jump = twists.copy(), np.array([0.0, 0.7, 0.0, 0.3, 0.0, 0.4])
    spoiled[at : at + frames] += jump * RATE_HZ / frames
    believed = believed_motion(stamps_of(np.full(120, 1.0 / RATE_HZ)), spoiled, EXPECTED)
    off = believed.taken_off.sum(axis=0)
    np.testing.assert_allclose(off, [0.7, 0.5], atol=0.05)
    np.testing.assert_allclose(believed.sigmas, believed.taken_off)
    assert np.flatnonzero(believed.taken_off.any(axis=1)).tolist() == list(range(at, at + frames))
    moved = (believed.twists - twists).sum(axis=0) / RATE_HZ
    assert np.linalg.norm(moved[:3]) < 0.02 + FAR * 0.02
    assert np.linalg.norm(moved[3:]) < 0.05


@pytest.mark.parametrize("frames", [2, 3])
def test_motion_that_ends_at_once_is_followed(frames):
    """Nothing says that the first frames were no motion, but the camera does not go on with it."""
    twists = hand_held(1, 120)
    spoiled = twists.copy()
    spoiled[:frames] += [0.0, 10.0, 0.0, 5.0, 0.0, 6.0]
    believed = believed_motion(stamps_of(np.full(120, 1.0 / RATE_HZ)), spoiled, EXPECTED)
    np.testing.assert_array_equal(believed.twists, spoiled)


def test_motion_that_starts_at_once_is_followed():
    """Half a metre per second from one frame to the next: within a second it is believed, and meanwhile not known."""
    twists = np.zeros((90, 6))
    twists[45:, 3] = 0.5
    believed = believed_motion(stamps_of(np.full(90, 1.0 / RATE_HZ)), twists, EXPECTED)
    missed = (twists - believed.twists).sum(axis=0)[3] / RATE_HZ
    np.testing.assert_array_equal(believed.twists[60:], twists[60:])
    assert missed > 0.0
    assert missed == pytest.approx(believed.sigmas[:, 1].sum())


@pytest.mark.parametrize("rate_hz", [5.0, 30.0])
def test_a_hole_is_an_interval_much_longer_than_the_others(rate_hz):
    intervals = np.full(60, 1.0 / rate_hz)
    intervals[40] = 2.0
    believed = believed_motion(stamps_of(intervals), np.zeros((60, 6)), EXPECTED)
    assert np.flatnonzero(believed.holes_s[1:] > 0.0).tolist() == [39]
    unseen_s = 2.0 - max(0.1, 3.0 / rate_hz)
    assert believed.holes_s[40] == pytest.approx(unseen_s)
    np.testing.assert_allclose(believed.sigmas[40], np.array([0.5, 0.3]) * np.sqrt(unseen_s))
    assert not believed.sigmas[41:].any()


@pytest.mark.parametrize("seed", range(5))
def test_sparse_and_uneven_odometry_is_believed(seed):
    """Keyframes: intervals of very different lengths, over which the motion changes much, from rest on."""
    rng, poses = np.random.default_rng(seed), [RigidTransform.identity()]
    for k, twist in enumerate(hand_held(seed, 1800)):
        moved = twist / RATE_HZ if k > 200 else np.zeros(6)
        poses.append(poses[-1] * RigidTransform.from_exp_coords(moved))
    kept = np.cumsum(rng.integers(2, 16, size=180))
    kept = kept[kept < len(poses)]
    stamps, T = np.round(kept * 1e9 / RATE_HZ).astype(np.int64), RigidTransform.concatenate(poses)[kept]
    twists = local(T[:-1], T[1:]) / (np.diff(stamps)[:, None] * 1e-9)
    believed = believed_motion(stamps, twists, EXPECTED)
    np.testing.assert_array_equal(believed.twists, twists)
    assert not believed.holes_s[10:].any()


@pytest.mark.parametrize("rate_hz", [0.5, 1.0, 3.0])
def test_slow_odometry_has_no_holes(rate_hz):
    stamps = stamps_of(np.full(20, 1.0 / rate_hz))
    still = Trajectory(stamps, RigidTransform.from_exp_coords(np.zeros((21, 6))))
    assert odometry_breaks(still, EXPECTED) == []
    (hole,) = odometry_breaks(Trajectory(np.r_[stamps[0] - 10**10, stamps[1:]], still.T_world_body), EXPECTED)
    assert (hole.hole, hole.seconds) == (True, pytest.approx(10.0 + 1.0 / rate_hz))


def test_breaks_are_named_with_stamp_and_size():
    intervals = np.full(90, 1.0 / RATE_HZ)
    intervals[60] = 2.0
    stamps = stamps_of(intervals)
    steps = RigidTransform.from_exp_coords(np.tile([0.0, 0.0, 0.004, 0.005, 0.0, 0.0], (90, 1)))
    poses = [RigidTransform.identity()]
    for k, step in enumerate(steps):
        turned = RigidTransform.from_exp_coords([0.0, np.radians(40.0), 0.0, 0.0, 0.0, 0.0])
        poses.append(poses[-1] * (turned * step if k == 30 else step))
    jump, hole = odometry_breaks(Trajectory(stamps, RigidTransform.concatenate(poses)), EXPECTED)
    assert (jump.after_ns, jump.hole, hole.after_ns, hole.hole) == (stamps[30], False, stamps[60], True)
    assert np.degrees(jump.angle) == pytest.approx(40.0, abs=2.0)
    assert jump.text.startswith("a jump of 0.0")
    assert hole.text == "a hole of 2.0 s"


def test_real_odometry_has_no_breaks_to_tell_of(shared_data):
    files = sorted((shared_data / "ycbv_dope").glob("*/T_odom_cam.tum"))
    assert files
    assert [odometry_breaks(read_tum(file), EXPECTED) for file in files] == [[]] * len(files)
