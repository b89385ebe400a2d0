"""A stated covariance is split as the bias model splits errors, and the filter is right about objects that differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filter_runs import assert_same, differing, run
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion import filter_loop, memory, reference_filter
from fusion.bias_spread import follow_spreads, spread_model, white_part
from fusion.columns import Columns
from fusion.fuse import fuse
from fusion.lasting_share import begin_pairs
from fusion.measurements import OBJECT_POSE, ray_aligned_covariance, viewing_axes
from fusion.nav_state import StateLayout, nominal_state
from fusion.options import DetectionBias, DetectionNoise, FuseOptions
from fusion.prepare import object_measurements, pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.consistency import pose_nees

NOISE, BIAS, LAYOUT = DetectionNoise(), DetectionBias(), StateLayout(n_objects=2, bias_kinds=2)
SIGMAS = st.floats(1e-3, 0.5)


def factors_after(covariances: np.ndarray, t: np.ndarray, k: int = 1) -> np.ndarray:
    """Return the three factors of object k after detections with this white noise."""
    m, count = memory.views.py_func(*memory.allocate(LAYOUT)), len(covariances)
    m.x[:], m.spread_model[:] = nominal_state(LAYOUT), spread_model(NOISE)
    m.stated[:] = 1.0
    begin_pairs(m, BIAS.white_below)
    ints, kinds = np.zeros(count, dtype=np.int64), np.full(count, OBJECT_POSE)
    motion = np.zeros(0, dtype=np.int64), np.zeros((0, 9))
    places = np.tile(t, (count, 1))
    log = Columns(
        *motion, ints, kinds, ints + k, np.zeros((count, 9)), places, covariances, ints.copy(), np.zeros((count, 3))
    )
    follow_spreads(m, log, 0, count)
    return m.x[LAYOUT.spread_start + 4 * k :][:3]


@given(SIGMAS, SIGMAS, SIGMAS, st.floats(-0.5, 0.5), st.floats(0.3, 3.0))
@settings(max_examples=30, deadline=None)
def test_white_part_and_biases_make_up_what_was_stated(rotation, across, along, aside, depth):
    t = np.array([aside, -0.5 * aside, depth])
    axes, stated = viewing_axes(t), np.zeros((6, 6))
    stated[:3, :3] = rotation**2 * np.eye(3)
    stated[3:, 3:] = axes @ np.diag([across, across, along]) ** 2 @ axes.T
    white = white_part(stated[None], t[None], NOISE, BIAS)[0]
    turning, aside_by, along_by = factors_after(white[None], t)
    far, whole = np.linalg.norm(t), NOISE.stated_scale**2
    biases = [(BIAS.across, BIAS.steady_across), (BIAS.along, BIAS.steady_along)]
    of_across, of_along = ((far * np.hypot(*pair)) ** 2 for pair in biases)
    of_rotation = np.radians(np.hypot(BIAS.rotation_deg, BIAS.steady_rotation_deg)) ** 2
    assert white[0, 0] + turning**2 * of_rotation == pytest.approx(whole * rotation**2)
    in_ray = axes.T @ white[3:, 3:] @ axes
    assert in_ray[0, 0] + aside_by**2 * of_across == pytest.approx(whole * across**2)
    assert in_ray[2, 2] + along_by**2 * of_along == pytest.approx(whole * along**2)


def test_detections_that_state_nothing_leave_the_biases_as_they_are():
    t = np.array([[0.1, -0.2, 0.9], [0.3, 0.1, 1.4]])
    R = ray_aligned_covariance(t, NOISE.across, NOISE.along, np.radians(NOISE.rotation_deg), NOISE.floor)
    for each in range(2):
        np.testing.assert_allclose(factors_after(np.repeat(R[each : each + 1], 300, axis=0), t[each]), 1.0, rtol=1e-12)


def test_the_factor_is_the_geometric_mean_until_there_are_many():
    t, sizes = np.array([0.0, 0.0, 1.0]), np.array([0.5, 2.0, 3.0, 0.25])
    default = ray_aligned_covariance(t[None], NOISE.across, NOISE.along, np.radians(NOISE.rotation_deg), NOISE.floor)
    found = factors_after(default * sizes[:, None, None] ** 2, t)
    np.testing.assert_allclose(found, np.exp(np.log(sizes).mean()), rtol=1e-12)


def test_without_biases_all_that_is_stated_is_white():
    stated = np.diag([0.1, 0.1, 0.1, 0.01, 0.01, 0.03])[None] ** 2
    scale = NOISE.stated_scale
    white = white_part(stated, np.array([[0.0, 0.0, 1.0]]), NOISE, replace(BIAS, use=False))
    np.testing.assert_allclose(white, scale**2 * stated)


def test_an_object_that_says_how_unsure_it_is_counts_for_as_much():
    squared, consistency = {True: [], False: []}, []
    for seed in range(4):
        for stated in (True, False):
            log = differing(seed, stated)
            result = fuse(log, FuseOptions())
            truth, valid = log.T_world_imu.interpolate(result.stamps_ns)
            off = (result.T_world_imu.rotation.inv() * truth.rotation).magnitude()[valid]
            squared[stated].append(np.mean(off**2))
            if stated:
                consistency.append(pose_nees(result.T_world_imu, truth, result.pose_covariances)[valid].mean())
    assert np.mean(squared[True]) < 0.5 * np.mean(squared[False])
    assert 0.3 < np.mean(consistency) < 1.5


def test_compiled_is_plain_with_stated_covariances():
    problem = pose_problem(differing(1, True), FuseOptions())
    options = FuseOptions()
    fast, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(fast, plain)
    assert np.ptp(fast.memory.x[problem.layout.spread_start :].reshape(-1, 4)[:, 0]) > 1.0


def test_measurements_carry_the_white_part():
    log = differing(0, True)
    measured = object_measurements(log.object_poses[""], log.landmark_map, log.calibration, FuseOptions())
    white, biased = NOISE.rotation_deg**2, BIAS.rotation_deg**2 + BIAS.steady_rotation_deg**2
    share = white / (white + biased) * NOISE.stated_scale**2
    sizes = np.radians([1.0, 2.0, 4.0, 8.0, 16.0])[measured.objects]
    np.testing.assert_allclose(measured.covariances[:, 0, 0], share * sizes**2)


@pytest.mark.parametrize("estimator", ["eskf", "graph", "batch"])
def test_detections_that_call_themselves_exact_break_no_estimator(estimator):
    log = simulate(
        SimulationOptions(duration_s=4.0, imu_rate_hz=100.0, camera_rate_hz=10.0, objects=4, noise="network")
    )
    poses = log.object_poses[""]
    exact = replace(poses, covariances=np.tile(1e-14 * np.eye(6), (len(poses), 1, 1)))
    result = fuse(replace(log, object_poses={"": exact}), FuseOptions(estimator=estimator))
    assert np.isfinite(result.trajectory.T_world_body.translation).all()
