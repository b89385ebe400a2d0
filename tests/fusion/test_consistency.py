"""Statistics of consistency against draws whose distribution is known, and the filter against the truth."""

from __future__ import annotations

import numpy as np
import pytest
from filter_runs import memory_of
from scipy.stats import chi2

from fusion import filter_loop, memory
from fusion.consistency import core_errors, effective_samples, nees, nis_summaries, series_bounds, truncated_mean
from fusion.fuse import loop_columns, run_filter
from fusion.nav_state import CORE, EXTRINSIC_ROTATION, StateLayout, nominal_state, retract_state
from fusion.options import FuseOptions
from fusion.prepare import pose_problem
from fusion.simulate import SimulationOptions, simulate_with_truth
from poet_loc.core.consistency import mean_bounds


def autoregressive(n: int, phi: float, rng: np.random.Generator, columns: int = 1) -> np.ndarray:
    noise = np.sqrt(1.0 - phi**2) * rng.standard_normal((n, columns))
    values = np.empty((n, columns))
    values[0] = rng.standard_normal(columns)
    for i in range(1, n):
        values[i] = phi * values[i - 1] + noise[i]
    return values


def test_nees_of_draws_from_the_covariance_is_one():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((15, 15)) * np.logspace(-5, 1, 15)[:, None]
    errors = rng.standard_normal((20_000, 15)) @ A.T
    values = nees(errors, np.broadcast_to(A @ A.T, (20_000, 15, 15)))
    low, high = mean_bounds(15, len(values), 0.999)
    assert low < values.mean() < high
    np.testing.assert_allclose(np.quantile(15 * values, 0.9), chi2.ppf(0.9, 15), rtol=0.02)


def test_core_errors_are_what_retract_takes():
    rng, layout = np.random.default_rng(1), StateLayout()
    x, error = nominal_state(layout), 0.3 * rng.standard_normal(CORE)
    moved = retract_state(x, error, layout)
    found = core_errors(x[None, :EXTRINSIC_ROTATION], moved[None, :EXTRINSIC_ROTATION])
    np.testing.assert_allclose(found[0], error, atol=1e-12)


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_effective_samples_of_an_autoregressive_series(phi):
    rng, n = np.random.default_rng(2), 4000
    found = np.mean([effective_samples(autoregressive(n, phi, rng)[:, 0]) for _ in range(20)])
    np.testing.assert_allclose(found, n * (1.0 - phi) / (1.0 + phi), rtol=0.12)


def test_series_bounds_hold_for_correlated_errors_where_those_for_independent_ones_do_not():
    rng, inside, naive = np.random.default_rng(3), 0, 0
    for _ in range(200):
        values = np.mean(autoregressive(600, 0.9, rng, 3) ** 2, axis=1)
        low, high = series_bounds(values, 3)
        inside += low < values.mean() < high
        low, high = mean_bounds(3, len(values))
        naive += low < values.mean() < high
    assert inside > 170
    assert naive < 120


def test_truncated_mean():
    draws = np.random.default_rng(4).chisquare(6, 400_000)
    limit = float(chi2.ppf(0.9, 6))
    np.testing.assert_allclose(truncated_mean(6, limit), draws[draws < limit].mean(), rtol=3e-3)


def test_nis_of_white_camera_poses_is_what_the_filter_expects():
    log, _ = simulate_with_truth(SimulationOptions(duration_s=30.0, camera_poses=True, objects=1))
    options = FuseOptions(measurements="camera")
    summaries = nis_summaries(run_filter(pose_problem(log, options), options).gate)
    assert [summary.part for summary in summaries] == ["pose", "position", "rotation"]
    for summary in summaries:
        assert (summary.object_id, summary.instance) == (-1, 0)
        assert summary.accepted > 0.97
        assert 0.9 < summary.mean_accepted < 1.1
        assert 0.9 < summary.median < 1.1
        assert summary.bounds[0] < summary.mean_accepted < summary.bounds[1]


def test_nees_of_the_whole_core_is_within_its_bounds_over_independent_runs():
    """Thirty runs, one sample each: the state at the end, with velocity and biases."""
    options, values = FuseOptions(measurements="camera"), []
    for seed in range(30):
        log, truth = simulate_with_truth(
            SimulationOptions(duration_s=6.0, camera_poses=True, objects=1, seed=seed, imu_rate_hz=100.0)
        )
        problem = pose_problem(log, options)
        floats, integers = memory_of(problem, options)
        filter_loop.run_log(floats, integers, *loop_columns(problem))
        m = memory.views.py_func(floats, integers)
        end = problem.imu.stamps_ns[-1:]
        assert m.counters[memory.NOW] == end[0]
        pose = truth.motion.pose(end)
        true = np.hstack(
            [
                pose.rotation.as_matrix().reshape(1, 9),
                pose.translation,
                truth.motion.velocity(end),
                truth.gyroscope_bias[-1:],
                truth.accelerometer_bias[-1:],
            ]
        )
        error = core_errors(m.x[None, :EXTRINSIC_ROTATION], true)
        values.append(nees(error, m.P[None, :CORE, :CORE])[0])
    low, high = mean_bounds(15, len(values), 0.99)
    assert low < np.mean(values) < high
