"""How much of the errors lasts is found from pairs of objects, and a filter that knows it is right about white ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filter_runs import assert_same, run
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import filter_loop, memory, reference_filter
from fusion.columns import Columns
from fusion.detection_errors import NetworkErrors, gauss_markov
from fusion.eskf import ACCEPTED, POSITION_ONLY
from fusion.fuse import fuse
from fusion.lasting_share import (
    BIAS_SCALE,
    LASTING,
    LEAST_BIAS_SCALE,
    LEAST_STEPS,
    LOG_PLACE,
    LOG_TURN,
    MET,
    SETTLED_NS,
    STAMP,
    STEPS,
    begin_pairs,
    bias_scale,
    follow_pairs,
    write_disagreement,
)
from fusion.measurements import CAMERA_POSE, OBJECT_POSE
from fusion.nav_state import SPREAD_SIZE, SPREADS, StateLayout, nominal_state
from fusion.options import DetectionBias, Estimate, FuseOptions
from fusion.place_watch import RELEASED
from fusion.prepare import pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.consistency import pose_nees
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError

WHITE_BELOW = DetectionBias().white_below
FRAME_NS = 33_000_000
RNG = np.random.default_rng(5)
MAP = make_pose(Rotation.random(3, RNG), RNG.normal(size=(3, 3)))


def new_memory(**states: bool) -> tuple[memory.Memory, memory.Work]:
    layout = StateLayout(n_objects=3, bias_kinds=2, **states)
    m = memory.views.py_func(*memory.allocate(layout))
    m.x[:], m.known[:] = nominal_state(layout, T_world_obj=MAP), 1.0
    begin_pairs(m, WHITE_BELOW)
    return m, memory.work_views.py_func(m.work, layout.n_error)


def detections(T_cam_obj: RigidTransform, objects: list[int], decision: int = ACCEPTED) -> Columns:
    count = len(objects)
    zeros, of_all = np.zeros(count, dtype=np.int64), np.ones(count, dtype=np.int64)
    R = T_cam_obj.rotation.as_matrix().reshape(count, 9)
    motion = np.zeros(0, dtype=np.int64), np.zeros((0, 9))
    poses = (np.array(objects), R, np.ascontiguousarray(T_cam_obj.translation), np.zeros((count, 6, 6)))
    return Columns(*motion, zeros, OBJECT_POSE * of_all, *poses, decision * of_all, np.zeros((count, 3)))


def followed(errors: np.ndarray, seen: list[int], step_ns: int = FRAME_NS, **states: bool) -> memory.Memory:
    """Return the memory after frames of detections whose errors [rotation, position] (F, O, 6) stand in camera axes."""
    m, w = new_memory(**states)
    T_cam_world = make_pose(Rotation.from_rotvec([0.3, -0.2, 0.5]), [0.1, 0.2, 2.0])
    for e in errors:
        T = T_cam_world * MAP[seen]
        m.counters[memory.NOW] += step_ns
        log = detections(make_pose(Rotation.from_rotvec(e[:, :3]) * T.rotation, T.translation + e[:, 3:]), seen)
        follow_pairs(m, w, log, 0, len(seen))
    return m


def lasting(share: float, frames: int, objects: int = 2, seed: int = 0) -> np.ndarray:
    """Return errors (F, O, 6) of which this share of the variance lasts for 100 s, the rest is white."""
    rng = np.random.default_rng(seed)
    slow = gauss_markov(frames, (objects, 6), FRAME_NS * 1e-11, rng)
    return 0.02 * (np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.standard_normal(slow.shape))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_the_disagreement_is_that_of_the_poses(seed):
    rng = np.random.default_rng(seed)
    m, w = new_memory()
    T = make_pose(Rotation.random(2, rng), rng.normal(size=(2, 3)))
    e = np.zeros(6)
    write_disagreement(m, w, detections(T, [2, 0]), 0, e)
    there = T[0] * MAP[2].inv() * MAP[0]
    np.testing.assert_allclose(e[:3], (T[1].rotation * there.rotation.inv()).as_rotvec(), atol=1e-9)
    np.testing.assert_allclose(e[3:], T[1].translation - there.translation, atol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5])
def test_the_ratio_says_which_share_lasts(share):
    """Over logs of 13 s: E|e|^2 is 1 / (1 - share) times half of what e changes by, and so are geometric means."""
    found = [followed(lasting(share, 400, seed=seed), [0, 1]).pairs[-1, [LOG_TURN, LOG_PLACE]] for seed in range(8)]
    spread = np.std(found) / np.sqrt(len(found))
    # A chi-square's logarithm bends: what lasts is nearly constant in a log, and weighs as its mean logarithm.
    assert np.mean(found) == pytest.approx(-np.log(1.0 - share), abs=3.0 * spread + 0.25 * share)


@pytest.mark.parametrize(("share", "expected"), [(0.0, LEAST_BIAS_SCALE), (0.9, 1.0)])
def test_biases_are_scaled_by_what_lasts(share, expected):
    m = followed(lasting(share, 600), [0, 1])
    assert bias_scale(m) == expected
    spreads = m.x[m.layout[SPREADS] :].reshape(3, SPREAD_SIZE)[:, :3]
    np.testing.assert_allclose(spreads, expected, rtol=1e-9)


def test_between_white_and_lasting_the_variance_grows_with_the_ratio():
    m = followed(lasting(0.4, 600, seed=1), [0, 1])
    ratio = np.exp(m.pairs[-1, [LOG_TURN, LOG_PLACE]].max())
    assert WHITE_BELOW < ratio < LASTING
    assert bias_scale(m) ** 2 == pytest.approx((ratio - WHITE_BELOW) / (LASTING - WHITE_BELOW))


def test_either_half_that_lasts_keeps_the_biases():
    white, slow = lasting(0.0, 600), lasting(0.9, 600)
    turned, moved = np.dstack([slow[:, :, :3], white[:, :, 3:]]), np.dstack([0.1 * white[:, :, :3], slow[:, :, 3:]])
    assert bias_scale(followed(turned, [0, 1])) == 1.0
    assert bias_scale(followed(moved, [0, 1])) == 1.0


def test_what_says_nothing_is_left_out():
    white, steps = lasting(0.0, int(LEAST_STEPS)), int(LEAST_STEPS) - 1
    assert followed(white, [0, 1]).pairs[-1, STEPS] == steps
    assert bias_scale(followed(white, [0, 1])) == 1.0  # one step short of the least
    assert followed(white[:, :1], [1]).pairs[-1, STEPS] == 0  # no pair
    assert followed(white, [0, 1], step_ns=400_000_000).pairs[-1, STEPS] == 0  # too far apart
    assert followed(0.0 * white, [0, 1]).pairs[-1, STEPS] == 0  # no errors at all
    for decision in (0, POSITION_ONLY, ACCEPTED | RELEASED):
        m, w = new_memory()
        for _ in range(2):
            m.counters[memory.NOW] += FRAME_NS
            follow_pairs(m, w, detections(MAP[[0, 1]], [0, 1], decision), 0, 2)
        assert np.all(np.isinf(m.pairs[:-1, STAMP]))


def test_an_object_just_put_where_it_was_seen_says_nothing_yet():
    """What it errs by is in the map: five seconds later it is not."""
    assert followed(lasting(0.0, 200), [0, 1], objects=True).pairs[-1, STEPS] == 199
    m, w = new_memory(objects=True)
    m.pairs[1, MET] = 0.0
    for frame in range(1, 200):
        m.counters[memory.NOW] += FRAME_NS
        turned = Rotation.from_rotvec(0.01 * RNG.normal(size=(2, 3))) * MAP[[0, 1]].rotation
        follow_pairs(m, w, detections(make_pose(turned, RNG.normal(size=(2, 3))), [0, 1]), 0, 2)
        assert np.isinf(m.pairs[0, STAMP]) == (frame * FRAME_NS <= SETTLED_NS)
    assert m.pairs[-1, STEPS] == 199 - SETTLED_NS // FRAME_NS - 1


def test_a_pair_is_of_the_same_two_objects():
    m, w = new_memory()
    for partner in (1, 2, 1, 2, 1):
        m.counters[memory.NOW] += FRAME_NS
        follow_pairs(m, w, detections(MAP[[0, partner]], [0, partner]), 0, 2)
    assert m.pairs[-1, STEPS] == 0


def white_log(seed: int, objects: int, **options: object):
    return simulate(SimulationOptions(noise="white", objects=objects, symmetric_objects=0, seed=seed, **options))


def errors_of(log, options: FuseOptions) -> tuple[float, float]:
    """Return RMSE (m) and mean NEES/dof."""
    result = fuse(log, options)
    truth = log.T_world_imu.between(int(result.stamps_ns[0]), int(result.stamps_ns[-1]))
    at = np.searchsorted(result.stamps_ns, truth.stamps_ns, side="right") - 1
    estimate, _ = result.trajectory.interpolate(truth.stamps_ns)
    gap = np.linalg.norm(estimate.translation - truth.T_world_body.translation, axis=1)
    nees = pose_nees(estimate, truth.T_world_body, result.pose_covariances[at])
    return float(np.sqrt(np.mean(gap**2))), float(np.mean(nees))


@pytest.mark.parametrize("map_", ["known", "unknown"])
@pytest.mark.parametrize("objects", [2, 8])
def test_default_options_are_right_about_white_errors(map_, objects):
    options = FuseOptions(estimate=Estimate(map=map_))
    believed = replace(options, bias=replace(options.bias, white_below=0.0))
    logs = [white_log(seed, objects) for seed in range(4)]
    found, before = ([errors_of(log, each) for log in logs] for each in (options, believed))
    assert 0.75 <= np.mean([nees for _, nees in found]) <= 1.25  # of ten logs and more 0.8 to 0.9
    assert np.mean([nees for _, nees in before]) < 0.65
    assert np.mean([rmse for rmse, _ in found]) < 0.75 * np.mean([rmse for rmse, _ in before])


def test_a_networks_errors_keep_their_biases_to_the_last_digit():
    log = simulate(SimulationOptions(objects=4, symmetric_objects=0, duration_s=30.0, seed=2))
    default, always = FuseOptions(), FuseOptions(bias=DetectionBias(white_below=0.0))
    one, other = fuse(log, default), fuse(log, always)
    assert np.array_equal(one.sigmas, other.sigmas)


@pytest.mark.parametrize(("bias_share", "correlated_share"), [(0.05, 0.05), (0.1, 0.2), (0.0, 0.3)])
def test_errors_that_last_a_little_are_neither_white_nor_a_networks(bias_share, correlated_share):
    shares = NetworkErrors(bias_share=bias_share, correlated_share=correlated_share, gross_share=0.02)
    logs = [
        simulate(SimulationOptions(objects=4, symmetric_objects=0, covariances=True, network=shares, seed=seed))
        for seed in range(4)
    ]
    assert 0.8 <= np.mean([errors_of(log, FuseOptions())[1] for log in logs]) <= 1.35


def test_plain_and_compiled_scale_alike():
    options = FuseOptions(estimate=Estimate(map="unknown"))
    problem = pose_problem(white_log(1, 3, duration_s=14.0, camera_rate_hz=20.0, imu_rate_hz=100.0), options)
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert compiled.memory.pairs[-1, BIAS_SCALE] < 0.5
    assert_same(compiled, plain)


def test_camera_poses_have_no_pairs():
    m, w = new_memory()
    log = detections(MAP[[0, 1]], [0, 1])
    log.kinds[:] = CAMERA_POSE
    follow_pairs(m, w, log, 0, 2)
    assert np.all(np.isinf(m.pairs[:-1, STAMP]))


@pytest.mark.parametrize("wrong", [-0.1, 2.0, np.nan])
def test_a_ratio_from_which_biases_are_whole_anyway_is_refused(wrong):
    with pytest.raises(InputError, match=r"bias\.white-below"):
        FuseOptions(bias=DetectionBias(white_below=wrong))
