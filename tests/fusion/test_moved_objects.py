"""An object that is moved half way is found, named and released; nobody is released where nothing was moved."""

from __future__ import annotations

import numpy as np
import pytest
from filter_runs import assert_same, run

from fusion import filter_loop, reference_filter
from fusion.fuse import fuse
from fusion.nav_state import OBJECT_SIZE, OBJECTS, pose_at
from fusion.options import DetectionBias, FuseOptions, Moved
from fusion.place_watch import TIMES
from fusion.prepare import pose_problem
from fusion.simulate import Displacement, SimulationOptions, simulate, simulate_with_truth
from fusion.smoother import run_smoother
from poet_loc.core.geometry import local

SECOND = 1_000_000_000
KEY = (2, 0)


def moved_log(seed: int = 2, distance: float = 0.2, turn_deg: float = 0.0, until_s: float = np.inf, **others):
    wanted = {"duration_s": 50.0, "imu_rate_hz": 100.0, "camera_rate_hz": 15.0, "objects": 4, "symmetric_objects": 0}
    moved = Displacement(1, 20.0, until_s, distance, turn_deg)
    return simulate_with_truth(SimulationOptions(seed=seed, moved=moved, **(wanted | others)))


def late_rmse(result, log) -> float:
    """Return the position's RMSE (m) after the object was moved."""
    truth = log.T_world_imu.between(int(log.imu.stamps_ns[0]) + 20 * SECOND, int(result.stamps_ns[-1]))
    estimate, _ = result.trajectory.interpolate(truth.stamps_ns)
    return float(np.sqrt(np.mean(np.sum((estimate.translation - truth.T_world_body.translation) ** 2, axis=1))))


@pytest.mark.parametrize(("distance", "turn_deg"), [(0.2, 0.0), (0.0, 40.0), (0.2, 40.0)])
def test_the_moved_object_is_named_and_released(distance, turn_deg):
    log, _ = moved_log(distance=distance, turn_deg=turn_deg)
    result = fuse(log)
    at = int(log.imu.stamps_ns[0]) + 20 * SECOND
    assert [key for key, _, _ in result.health.released] == [KEY]
    _, first, last = result.health.released[0]
    assert at + 2 * SECOND < first < at + 25 * SECOND
    assert last > result.stamps_ns[-1] - 5 * SECOND
    assert [key for key, each in result.health.objects.items() if each.released] == [KEY]
    own = (result.gate.object_ids == KEY[0]) & result.gate.released
    assert not result.gate.rotation_accepted[own].any()
    used = result.gate.position_accepted[own].mean()
    assert used == 0.0 if distance else used > 0.7
    assert np.all(np.isfinite(result.gate.nis[own]))
    assert late_rmse(result, log) < 0.025


def test_without_release_the_error_grows():
    grown, held = [], []
    for seed in (1, 2, 4):  # with three objects, the moved one pulls most; of ten of twelve seeds it is released
        log, _ = moved_log(seed, distance=0.1, objects=3)
        grown.append(late_rmse(fuse(log, FuseOptions(moved=Moved(release=False))), log))
        held.append(late_rmse(fuse(log), log))
    assert np.mean(grown) > 1.3 * np.mean(held)
    assert np.mean(held) < 0.025


@pytest.mark.parametrize("seed", range(4))
def test_nobody_is_released_where_nothing_was_moved(seed):
    log = simulate(SimulationOptions(seed=seed, duration_s=40.0, imu_rate_hz=100.0, camera_rate_hz=15.0, objects=5))
    assert fuse(log).health.released == ()


def test_a_moved_object_is_estimated_anew_where_it_stands():
    log, truth = moved_log(distance=0.2, turn_deg=40.0, noise="white")
    options = FuseOptions(moved=Moved(then="re-estimate"), bias=DetectionBias(use=False))
    problem = pose_problem(log, options)
    found = run(filter_loop.run_log, problem, options)
    result = fuse(log, options)
    assert [key for key, _, _ in result.health.released] == [KEY]
    assert not any(each.released for each in result.health.objects.values())
    again = result.gate.stamps_ns > result.health.released[0][2]
    assert result.gate.position_accepted[again & (result.gate.object_ids == KEY[0])].mean() > 0.8
    T_found = pose_at(found.memory.x, OBJECTS + OBJECT_SIZE)
    error = local(list(truth.moved_map)[1].T_world_obj, T_found)
    before = local(list(truth.landmark_map)[1].T_world_obj, T_found)
    assert np.linalg.norm(error[3:]) < 0.04 < 0.1 < np.linalg.norm(before[3:])
    assert np.degrees(np.linalg.norm(error[:3])) < 6.0
    assert late_rmse(result, log) < 0.02


@pytest.mark.parametrize("then", ["leave-out", "re-estimate"])
def test_compiled_is_plain_and_the_smoother_goes_back_over_it(then):
    log, _ = moved_log(distance=0.2, imu_rate_hz=50.0, camera_rate_hz=8.0, duration_s=34.0, objects=3)
    options = FuseOptions(moved=Moved(then=then, after_s=1.0))
    problem = pose_problem(log, options)
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert compiled.memory.places[1, TIMES] == 1.0  # released once
    assert_same(compiled, plain, 1e-8)
    smoothed = run_smoother(problem, options)
    assert np.isfinite(smoothed.pose_covariances).all()
    assert late_rmse(smoothed, log) < 1.2 * late_rmse(fuse(log, options), log)


def test_an_object_that_comes_back_is_used_again():
    log, _ = moved_log(until_s=35.0)
    health = fuse(log).health
    back = int(log.imu.stamps_ns[0]) + 35 * SECOND
    assert [key for key, _, _ in health.released] == [KEY]
    assert not health.objects[KEY].released
    assert back < health.released[0][2] < back + 10 * SECOND
