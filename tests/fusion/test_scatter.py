"""An object's biases are as large as its detections' scatter says, where it is known how much they usually scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filter_runs import assert_same, differing, run
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion import filter_loop, reference_filter
from fusion.fit_noise import fit_noise
from fusion.fuse import fuse
from fusion.options import DetectionBias, FuseOptions, Gate
from fusion.prepare import pose_problem
from fusion.scatter import scatter_of
from poet_loc.core.consistency import pose_nees
from poet_loc.core.input_error import InputError
from poet_loc.io.log_folder import Log

SIGMAS = np.array([0.02, 0.003, 0.015])
TIMES = np.repeat(SIGMAS, (3, 2, 1))
STAMPS = np.arange(4000, dtype=np.int64) * 33_333_333
KNOWN = DetectionBias(
    scatter_rotation_deg=1.8, scatter_across=0.0018, scatter_along=0.011, scatter_exponent=0.5, scatter_margin=1.0
)
"""About what `differing` has in the middle."""
UNKNOWN = DetectionBias(scatter_rotation_deg=0.0, scatter_across=0.0, scatter_along=0.0)


@given(st.integers(0, 10_000), st.floats(0.01, 100.0))
@settings(max_examples=10, deadline=None)
def test_the_scatter_of_white_noise_is_its_sigma_whatever_drifts_below_it(seed, size):
    rng = np.random.default_rng(seed)
    drift = 10.0 * TIMES * np.sin(np.arange(4000)[:, None] / 500.0)
    found = scatter_of(STAMPS, size * (drift + TIMES * rng.standard_normal((4000, 6))))
    np.testing.assert_allclose(found, size * SIGMAS, rtol=0.1)


def test_flips_hardly_change_it_and_far_apart_detections_say_nothing():
    rng = np.random.default_rng(0)
    errors = TIMES * rng.standard_normal((4000, 6))
    errors[rng.random(4000) < 0.05] += 3.0
    np.testing.assert_allclose(scatter_of(STAMPS, errors), SIGMAS, rtol=0.35)
    assert np.isnan(scatter_of(10 * STAMPS, errors)).all()


def test_of_two_detections_of_an_object_in_one_frame_the_first_counts():
    errors = TIMES * np.random.default_rng(0).standard_normal((4000, 6))
    twice = np.stack([errors, errors + 1.0], axis=1).reshape(-1, 6)
    np.testing.assert_array_equal(scatter_of(np.repeat(STAMPS, 2), twice), scatter_of(STAMPS, errors))


def test_the_filter_finds_the_scatter_that_the_errors_have():
    log = differing(0, False)
    problem, options = pose_problem(log, FuseOptions()), FuseOptions(bias=KNOWN)
    found = run(filter_loop.run_log, problem, options).memory.scatter[:, 0]
    made = np.sqrt(0.2) * np.radians([1.0, 2.0, 4.0, 8.0, 16.0])
    np.testing.assert_allclose(found, made, rtol=0.35)
    assert fit_noise([log]).scatter[0] == pytest.approx(np.exp(np.log(made).mean()), rel=0.25)


def test_an_object_that_scatters_less_counts_for_more():
    squared, consistency = {True: [], False: []}, []
    for seed in range(4):
        log = differing(seed, False)
        truth_of = log.T_world_imu
        for known in (True, False):
            result = fuse(log, FuseOptions(bias=KNOWN if known else UNKNOWN))
            truth, valid = truth_of.interpolate(result.stamps_ns)
            off = (result.T_world_imu.rotation.inv() * truth.rotation).magnitude()[valid]
            squared[known].append(np.mean(off**2))
            if known:
                consistency.append(pose_nees(result.T_world_imu, truth, result.pose_covariances)[valid].mean())
    assert np.all(np.array(squared[True]) < squared[False])
    assert np.mean(squared[True]) < 0.85 * np.mean(squared[False])
    assert 0.2 < np.mean(consistency) < 1.5


def test_compiled_is_plain_where_the_usual_scatter_is_known():
    options = FuseOptions(bias=KNOWN)
    problem = pose_problem(differing(1, False), options)
    fast, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(fast, plain)
    assert np.ptp(fast.memory.x[problem.layout.spread_start :].reshape(-1, 4)[:, 0]) > 0.5


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 30.0])
def test_a_graph_takes_each_detection_with_the_biases_that_the_filter_gave_it(rate_hz):
    log, options = differing(3, False), FuseOptions(bias=KNOWN)
    filtered = fuse(log, options)
    graph = replace(options.graph, keyframe_rate_hz=rate_hz, kernel="none")
    found = fuse(log, replace(options, estimator="graph", graph=graph))
    end, same = filtered.T_world_imu[-1], found.T_world_imu[-1]
    assert (end.rotation.inv() * same.rotation).magnitude() < 0.15 * filtered.sigmas[-1, :3].max()
    assert np.linalg.norm(end.translation - same.translation) < 0.15 * filtered.sigmas[-1, 3:6].max()


@pytest.mark.parametrize("exponent", [0.25, 0.5])
def test_biases_grow_with_that_power_of_the_scatter(exponent):
    turning = turning_of(differing(0, False), replace(KNOWN, scatter_exponent=exponent))
    made = np.array([1.0, 2.0, 4.0, 8.0, 16.0])  # by how much the rotations scatter, against each other
    np.testing.assert_allclose(turning / turning[2], (made / made[2]) ** exponent, rtol=0.2)


def test_what_is_usual_to_within_the_margin_says_nothing():
    log = differing(0, False)
    free, within = (turning_of(log, replace(KNOWN, scatter_margin=margin)) for margin in (1.0, 3.0))
    assert within[1:4] == pytest.approx(1.0)  # these scatter a half to twice the usual
    np.testing.assert_allclose(within[[0, 4]], free[[0, 4]] * [3.0**0.5, 3.0**-0.5], rtol=1e-2)


def test_what_states_its_covariance_is_believed_whatever_it_scatters():
    log = differing(0, False)
    detections = log.object_poses[""]
    covariances = np.tile(np.diag(np.r_[np.full(3, 0.1), np.full(3, 0.03)] ** 2), (len(detections), 1, 1))
    stating = replace(log, object_poses={"": replace(detections, covariances=covariances)})
    turning = turning_of(stating, KNOWN)
    np.testing.assert_allclose(turning, turning[0], rtol=1e-6)
    np.testing.assert_array_equal(turning, turning_of(stating, UNKNOWN))


def turning_of(log: Log, bias: DetectionBias) -> np.ndarray:
    """Return by how much larger the objects' biases of rotation are in the end."""
    options = FuseOptions(bias=bias, gate=Gate(adaptation=0.0))
    problem = pose_problem(log, options)
    memory = run(filter_loop.run_log, problem, options).memory
    return memory.x[problem.layout.spread_start :].reshape(-1, 4)[:, 0].copy()


def test_no_power_is_not_to_know():
    log = differing(0, False)
    none = fuse(log, FuseOptions(bias=DetectionBias(scatter_exponent=0.0))).T_world_imu
    unknown = fuse(log, FuseOptions(bias=UNKNOWN)).T_world_imu
    assert np.abs(none.translation - unknown.translation).max() < 1e-9
    assert np.abs(none.translation - fuse(log, FuseOptions()).T_world_imu.translation).max() > 1e-4


def test_impossible_scatter_is_told():
    with pytest.raises(InputError, match="scatter-along"):
        FuseOptions(bias=DetectionBias(scatter_along=-0.1))
