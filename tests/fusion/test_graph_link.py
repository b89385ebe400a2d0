"""The linear link between two keyframes against numeric derivatives, the filter's noise and gtsam's own factor."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filter_runs import simulated
from scipy.spatial.transform import Rotation

from fusion.graph_link import LINK_SIZES, link_keyframes
from fusion.graph_motion import MotionChain
from fusion.graph_rows import Between
from fusion.graph_variables import keyframe_variables
from fusion.nav_state import CORE, GRAVITY, StateLayout, local_state, nominal_state, retract_state
from fusion.options import FuseOptions, Gap

LAYOUT = StateLayout()
BOTH = 2 * CORE


def states(rng, far):
    """Return nominal arrays: where a keyframe began, and where it has come since."""
    turn = Rotation.from_rotvec(rng.normal(size=3))
    origin = nominal_state(LAYOUT)
    origin[:9], origin[9:21] = turn.as_matrix().ravel(), 0.2 * rng.normal(size=12)
    return origin, retract_state(origin, far * rng.normal(size=CORE), LAYOUT)


def span(problem, gap):
    stamps = problem.imu.stamps_ns
    return int(stamps[100]) + 2_000_000, int(stamps[130 if gap else 118]) + 1_000_000


def setting(gap=False):
    problem, options = simulated(duration_s=3.0), FuseOptions(gap=Gap(longest_s=0.02))
    if gap:
        problem = replace(problem, imu=problem.imu[np.r_[0:105, 117 : len(problem.imu)]])
    return problem, MotionChain.of(problem, options)


def link(chain, start, end, origin, now, gravity=False):
    return link_keyframes(chain.stamps_ns, chain.values, start, end, chain.densities, gravity, origin, now)


def carried(chain, start, end, x):
    """Return what the filter makes of a nominal array, and its noise."""
    core, _, Q = Between(chain.stamps_ns, chain.values, chain.densities, CORE).predict(start, x, np.array([end]))
    found = x.copy()
    found[:21] = core[0]
    return found, Q[0]


@pytest.mark.parametrize("gap", [False, True])
def test_the_link_carries_on_and_its_noise_is_the_filters(gap):
    problem, chain = setting(gap)
    (origin, now), (start, end) = states(np.random.default_rng(1), 0.0), span(problem, gap)
    expected, Q = carried(chain, start, end, now)
    rows = link(chain, start, end, origin, now)
    np.testing.assert_allclose(now, expected, atol=1e-12)
    np.testing.assert_allclose(rows[:, -1], 0.0, atol=1e-6)
    root = np.linalg.inv(rows[:, CORE:BOTH])
    root[3:6] = now[:9].reshape(3, 3) @ root[3:6]  # gtsam's position error is in the body's axes
    sigma = np.sqrt(np.diag(Q))
    np.testing.assert_allclose(root @ root.T / np.outer(sigma, sigma), Q / np.outer(sigma, sigma), atol=3e-3)
    if gap:
        _, chain = setting()
        assert np.all(sigma[:9] > 3.0 * np.sqrt(np.diag(carried(chain, start, end, origin)[1]))[:9])


@pytest.mark.parametrize("far", [0.0, 0.05])
@pytest.mark.parametrize("gravity", [False, True])
def test_the_links_jacobians_are_its_derivatives(gravity, far):
    """Of the error in the second keyframe's axes, also where the first has come far from where it began."""
    problem, chain = setting()
    rng = np.random.default_rng(2)
    (origin, now), (start, end) = states(rng, far), span(problem, False)
    rows = link(chain, start, end, origin, now, gravity)

    def error(step):
        moved = [in_filters_axes(x, step[at : at + CORE]) for x, at in ((origin, 0), (now, CORE))]
        if gravity:
            moved[0][GRAVITY : GRAVITY + 3] += step[BOTH:]
        found = local_state(moved[1], carried(chain, start, end, moved[0])[0], LAYOUT)
        R = moved[1][:9].reshape(3, 3)
        return np.r_[found[:3], R.T @ found[3:6], R.T @ found[6:9], found[9:]]

    size, step = sum(LINK_SIZES[: 7 if gravity else 6]), 1e-6
    numeric = np.stack([(error(d) - error(-d)) / (2.0 * step) for d in step * np.eye(size)], axis=1)
    to_rows = rows[:, CORE:BOTH] @ np.linalg.inv(numeric[:, CORE:BOTH])
    scale = np.abs(rows[:, :-1]).max(axis=1)
    np.testing.assert_allclose((to_rows @ numeric) / scale[:, None], rows[:, :-1] / scale[:, None], atol=2e-5)
    np.testing.assert_allclose(to_rows @ error(np.zeros(size)) / scale, -rows[:, -1] / scale, atol=1e-6)


def in_filters_axes(x, step):
    """Return a core after a step in gtsam's tangent."""
    errors = step.copy()
    errors[3:6] = x[:9].reshape(3, 3) @ step[3:6]
    return retract_state(x, errors, LAYOUT)


@pytest.mark.parametrize("far", [0.0, 0.05])
def test_the_link_says_what_gtsams_factor_says(far):
    problem, chain = setting()
    (origin, now), (start, end) = states(np.random.default_rng(3), far), span(problem, False)
    factor, predicted = chain.link(0, start, end, now)
    values, columns, at = gtsam.Values(), {}, 0
    for k, x in enumerate((origin, predicted)):
        for variable in keyframe_variables(k, True):
            variable.insert(values, x)
    A, b = factor.linearize(values).jacobian()
    for key in list(factor.keys()):
        size = 3 if chr(gtsam.Symbol(key).chr()) == "v" else 6
        columns[key], at = A[:, at : at + size], at + size
    blocks = [columns[variable.key] for k in (0, 1) for variable in keyframe_variables(k, True)]
    blocks = [np.roll(block, 3, axis=1) if i % 3 == 2 else block for i, block in enumerate(blocks)]
    A = np.hstack(blocks)  # ours have the gyroscope's biases first
    rows = link(chain, start, end, origin, now)
    expected, found = A.T @ A, rows[:, :-1].T @ rows[:, :-1]
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.05)
    np.testing.assert_allclose(np.linalg.norm(rows[:, -1]), np.linalg.norm(b), rtol=0.05, atol=0.1)
