"""Health: modes by when poses were accepted, tallies by counting, the same numbers online and of a whole log."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace

import numpy as np
import pytest
from test_online import estimator_for, events, feed

from fusion.fuse import fuse, run_filter
from fusion.health import as_plain, mode_of, run_health, troubles
from fusion.options import FuseOptions, HealthOptions
from fusion.prepare import pose_problem
from fusion.simulate import SimulationOptions, simulate

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def log():
    wanted = SimulationOptions(
        duration_s=10.0, imu_rate_hz=100.0, camera_rate_hz=15.0, objects=4, symmetric_objects=1, seed=5
    )
    return simulate(wanted)


def without(log, first_s: float, last_s: float):
    """Return the log without detections in this time."""
    seconds = (log.object_poses[""].stamps_ns - log.imu.stamps_ns[0]) / SECOND
    return replace(log, object_poses={"": log.object_poses[""][(seconds < first_s) | (seconds > last_s)]})


def test_the_mode_is_coasting_where_nothing_is_seen_and_lost_where_it_has_drifted(log):
    gap = without(log, 5.0, 8.0)
    begin = int(log.imu.stamps_ns[0])
    result = fuse(gap)
    health, start = result.health, int(result.stamps_ns[0])
    assert health.modes[0] == "initialising"
    assert health.since_ns[0] == begin
    assert np.all(health.mode_at(np.array([begin, start - 1])) == "initialising")
    seen = begin + 5 * SECOND
    assert health.mode_at(np.array([seen]))[0] == "tracking"
    assert np.all(health.mode_at(seen + np.array([6, 29]) * SECOND // 10) == "coasting")
    assert health.mode_at(np.array([begin + 9 * SECOND]))[0] == "tracking"
    assert health.share("coasting") == pytest.approx(2.5 / (log.imu.stamps_ns[-1] - begin) * SECOND, abs=0.02)
    assert sum(map(health.share, ("initialising", "tracking", "coasting", "lost"))) == pytest.approx(1.0)
    strict = fuse(gap, FuseOptions(health=HealthOptions(lost_sigma=0.03))).health
    at = np.searchsorted(result.stamps_ns, seen + int(2.9 * SECOND))
    assert result.sigmas[at, 3:6].max() > 0.03
    assert strict.mode_at(result.stamps_ns[[at]])[0] == "lost"


def test_refusals_in_a_row_tell_of_being_lost():
    options = HealthOptions(coasting_after_s=1.0, lost_sigma=0.5, lost_refused=20)
    assert mode_of(0.9, 10.0, 100, options) == "tracking"
    assert mode_of(1.1, 0.1, 19, options) == "coasting"
    assert mode_of(1.1, 0.1, 20, options) == "lost"
    assert mode_of(1.1, 0.6, 0, options) == "lost"


def test_objects_are_counted(log):
    result = fuse(log)
    gate = result.gate
    met = gate.stamps_ns > result.stamps_ns[0]
    assert set(result.health.objects) == set(zip(gate.object_ids.tolist(), gate.instances.tolist()))
    for (number, instance), health in result.health.objects.items():
        own = met & (gate.object_ids == number) & (gate.instances == instance)
        assert health.poses == np.count_nonzero(own)
        assert health.position_accepted == pytest.approx(gate.position_accepted[own].mean())
        assert health.rotation_accepted == pytest.approx(gate.rotation_accepted[own].mean())
        text = "".join("+" if used else "-" for used in gate.position_accepted[own] | gate.rotation_accepted[own])
        assert health.longest_refused == max(map(len, text.split("+")))
        assert health.refused_in_a_row == len(text) - len(text.rstrip("-"))
        assert 0.0 < health.test_ratio < 10.0
        assert not health.released


def test_online_says_what_the_whole_log_says(log):
    options = FuseOptions()
    problem = pose_problem(without(log, 5.0, 7.0), options)
    estimator = estimator_for(problem, options)
    result = run_filter(problem, options)
    whole = run_health(result, options, int(problem.imu.stamps_ns[0]))
    seen = 0
    for event in events(problem):
        feed(estimator, problem, event)
        state = estimator.state()
        if event[1] == 1 and state is not None:
            assert state.mode == whole.mode_at(np.array([state.stamp_ns]))[0]
            seen += state.mode == "coasting"
    assert seen > 100
    online = estimator.health()
    assert online.objects.keys() == whole.objects.keys()
    for key, each in online.objects.items():
        np.testing.assert_allclose(list(vars(each).values()), list(vars(whole.objects[key]).values()), rtol=1e-9)


def test_health_json_holds_plain_numbers(log):
    plain = as_plain(fuse(log).health)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["modes"][0]["mode"] == "initialising"
    assert {each["object_id"] for each in plain["objects"]} == {1, 2, 3, 4}
    empty = fuse(without(log, 3.0, 100.0)).health
    unseen = replace(next(iter(empty.objects.values())), poses=0, test_ratio=math.nan)
    assert as_plain(replace(empty, objects={(1, 0): unseen}))["objects"][0]["test_ratio"] is None


def test_an_estimate_that_ran_away_is_told(log):
    result = fuse(log)
    away = replace(result, velocity=np.where(np.arange(len(result.velocity))[:, None] > 500, 4e7, result.velocity))
    assert troubles(away) == ["ran away: its speed reached 4e+07 m/s"]


def test_troubles_are_told_where_there_are_some(log):
    assert troubles(fuse(log)) == []
    poses, imu = log.object_poses[""], log.imu
    exact = replace(poses, covariances=np.tile(1e-6 * np.eye(6), (len(poses), 1, 1)))
    result = fuse(replace(log, object_poses={"": exact}))
    used = sum(each.poses * each.position_accepted for each in result.health.objects.values())
    told = troubles(result)
    assert (
        told[0] == f"used {100 * used / sum(each.poses for each in result.health.objects.values()):.0f} % of the poses"
    )
    assert result.restarts > 0
    assert told[1].startswith("started again")
    kept = imu.stamps_ns < imu.stamps_ns[0] + 6 * SECOND
    short = replace(imu, **{each.name: getattr(imu, each.name)[kept] for each in fields(imu)})
    (only,) = troubles(fuse(replace(log, imu=short)))
    assert only.startswith("ends 3.9 s before the last pose")
    assert only.endswith("where its imu ends")
