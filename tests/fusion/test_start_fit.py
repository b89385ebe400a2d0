"""The fit of a start to its votes, against scipy's least squares on a cost written anew."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fusion import ballot
from fusion.ballot import CORRECTION_SIZE, GIVEN_POSE, WHOLE, Ballot, correction_in
from fusion.start_fit import fit_correction
from fusion.votes import (
    VOTE_ACROSS,
    VOTE_ALONG,
    VOTE_ARM,
    VOTE_OBJECT,
    VOTE_ORDER,
    VOTE_PLACE,
    VOTE_SIZE,
    VOTE_TURN,
)

MAX_SPEED, MAX_TILT = 0.3, np.radians(12.0)
GRAVITY = np.array([0.0, 0.0, -9.81])
UP = np.array([0.0, 0.0, 1.0])


def votes_of(truth, objects, seed=0, frames=12, turned=None, noise=0.0):
    """Return votes, stamps of objects seen from a moving imu whose motion was integrated from elsewhere.

    truth: correction [rotation vector, d, v]. turned (K, 3): by how much each object's rotation is seen wrong.
    """
    rng = np.random.default_rng(seed)
    C, d, v = Rotation.from_rotvec(truth[:3]), truth[3:6], truth[6:]
    votes, stamps = np.zeros((64, VOTE_SIZE)), np.zeros(64, dtype=np.int64)
    n = 0
    for frame in range(frames):
        since = (frame - frames + 1) / 30.0
        R_m, x_m = Rotation.from_rotvec(0.2 * rng.standard_normal(3)), 0.1 * rng.standard_normal(3)
        R = C * R_m
        p = C.apply(x_m) + 0.5 * (GRAVITY - C.apply(GRAVITY)) * since**2 + d + v * since
        for k, place in enumerate(objects):
            vote = votes[n]
            arm = R.inv().apply(place - p) + noise * rng.standard_normal(3)
            seen = R if turned is None else Rotation.from_rotvec(turned[k]) * R
            vote[:9], vote[9:12] = seen.as_matrix().ravel(), place - seen.apply(arm)
            vote[12:21], vote[21:24] = R_m.as_matrix().ravel(), x_m
            vote[VOTE_ARM : VOTE_ARM + 3], vote[VOTE_PLACE : VOTE_PLACE + 3] = arm, place
            vote[VOTE_ORDER], vote[VOTE_OBJECT] = 1.0, k
            vote[VOTE_TURN], vote[VOTE_ACROSS], vote[VOTE_ALONG] = 0.01 * (1 + k), 2e-5, 4e-4
            stamps[n] = round(since * 1e9)
            n += 1
    return votes, stamps, n


def fitted(votes, stamps, n, start, steps=8):
    options = np.zeros(GIVEN_POSE)
    options[ballot.MAX_SPEED], options[ballot.MAX_TILT] = MAX_SPEED, MAX_TILT
    cast = Ballot(votes, stamps, 0, n, 0, UP, GRAVITY, options, np.zeros(256))
    correction = correction_in(np.zeros(CORRECTION_SIZE), np.full(len(stamps), WHOLE))
    correction.C[:] = Rotation.from_rotvec(start[:3]).as_matrix().ravel()
    correction.d[:], correction.v[:] = start[3:6], start[6:]
    for _ in range(steps):
        fit_correction(cast, correction)
    return np.r_[Rotation.from_matrix(correction.C.reshape(3, 3)).as_rotvec(), correction.d, correction.v]


def cost(votes, stamps, n):
    """Return the residuals that the fit is to make small, as scipy wants them."""
    counts = np.bincount(votes[:n, VOTE_OBJECT].astype(int))

    def residuals(x):
        C, rows = Rotation.from_rotvec(x[:3]), [x[6:] / MAX_SPEED]
        up = C.apply(UP)
        rows.append(np.array([up[0], up[1]]) * 3.0 / MAX_TILT)
        for i in range(n):
            vote, since = votes[i], stamps[i] * 1e-9
            weight = 1.0 / np.sqrt(counts[int(vote[VOTE_OBJECT])])
            R = C * Rotation.from_matrix(vote[12:21].reshape(3, 3))
            arm = R.apply(vote[VOTE_ARM : VOTE_ARM + 3])
            shift = C.apply(vote[21:24]) + 0.5 * (GRAVITY - C.apply(GRAVITY)) * since**2 + x[3:6] + x[6:] * since
            off = vote[VOTE_PLACE : VOTE_PLACE + 3] - arm - shift
            ray = R.apply(vote[VOTE_ARM : VOTE_ARM + 3] / np.linalg.norm(arm))
            along = off @ ray
            rows.append(weight * (off - along * ray) / np.sqrt(vote[VOTE_ACROSS]))
            rows.append(weight * np.array([along / np.sqrt(vote[VOTE_ALONG])]))
            turn = Rotation.from_matrix(vote[:9].reshape(3, 3)) * R.inv()
            rows.append(weight * turn.as_rotvec() / np.sqrt(vote[VOTE_TURN]))
        return np.concatenate(rows)

    return residuals


OBJECTS = np.array([[0.2, 0.1, 0.1], [-0.15, 0.2, 0.05], [0.0, -0.25, 0.12]])
TRUTH = np.array([0.0, 0.0, 1.2, 0.4, -0.9, 0.7, 0.05, -0.1, 0.02])


@pytest.mark.parametrize("objects", [1, 2, 3])
def test_exact_votes_give_the_exact_correction(objects):
    still = np.r_[TRUTH[:6], np.zeros(3)]  # no velocity, which is taken for unlikely
    votes, stamps, n = votes_of(still, OBJECTS[:objects])
    found = fitted(votes, stamps, n, still + 0.05 * np.r_[np.ones(6), np.zeros(3)])
    np.testing.assert_allclose(found, still, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_fit_is_the_least_squares_solution(seed):
    turned = np.radians(6.0) * np.random.default_rng(seed).standard_normal((3, 3))
    votes, stamps, n = votes_of(TRUTH, OBJECTS, seed, turned=turned, noise=0.004)
    found = fitted(votes, stamps, n, TRUTH)
    best = least_squares(cost(votes, stamps, n), TRUTH, xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(found, best.x, atol=2e-3)
    assert np.sum(cost(votes, stamps, n)(found) ** 2) < (1.0 + 1e-3) * 2.0 * best.cost


def test_places_tell_the_heading_where_rotations_are_wrong():
    turned = np.radians([[0.0, 0.0, 10.0], [0.0, 0.0, 8.0], [0.0, 0.0, 9.0]])
    votes, stamps, n = votes_of(TRUTH, OBJECTS, turned=turned)
    off = Rotation.from_rotvec(fitted(votes, stamps, n, TRUTH)[:3]) * Rotation.from_rotvec(TRUTH[:3]).inv()
    assert np.degrees(off.magnitude()) < 2.0


def test_camera_poses_count_each_by_itself():
    truth = np.array([0.02, -0.03, 0.5, 1.0, -2.0, 0.5, 1.5, 0.0, -0.4])
    votes, stamps, n = votes_of(truth, [np.zeros(3)])
    for vote in votes[:n]:
        vote[VOTE_ARM : VOTE_ARM + 3], vote[VOTE_PLACE : VOTE_PLACE + 3] = 0.0, vote[9:12]
        vote[VOTE_OBJECT], vote[VOTE_ACROSS], vote[VOTE_ALONG], vote[VOTE_TURN] = -1.0, 4e-4, 4e-4, 3e-4
    found = fitted(votes, stamps, n, truth)
    # 12 poses of 2 cm over 0.37 s tell velocities to 5 cm/s, against 0.3 m/s of what is likely
    np.testing.assert_allclose(found[6:], truth[6:], atol=0.06)
