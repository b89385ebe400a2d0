"""A time offset of tenths of a second: the log's turn rates bring every estimator near enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.coarse_offset import coarse_offset, with_coarse_offset
from fusion.fuse import fuse
from fusion.graph import run_graph
from fusion.options import Estimate, FuseOptions
from fusion.prepare import pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import Log, read_log

ESTIMATED = FuseOptions(estimate=Estimate(time_offset=True))


def stated(log: Log, timeshift_s: float) -> Log:
    return replace(log, calibration=replace(log.calibration, timeshift_cam_imu_s=timeshift_s))


def late(log: Log, seconds: float) -> Log:
    moved = {k: replace(p, stamps_ns=p.stamps_ns + round(seconds * 1e9)) for k, p in log.object_poses.items()}
    return replace(log, object_poses=moved)


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(SimulationOptions(duration_s=20.0, objects=5, seed=4, timeshift_cam_imu_s=0.5))


@pytest.mark.parametrize("estimator", ["eskf", "graph", "batch"])
def test_half_a_second_is_found(log, estimator):
    result = fuse(stated(log, 0.0), replace(ESTIMATED, estimator=estimator))
    assert result.calibrated.timeshift_cam_imu_s == pytest.approx(0.5, abs=0.004)
    estimate, valid = result.trajectory.interpolate(log.T_world_imu.stamps_ns)
    errors = np.linalg.norm(estimate.translation - log.T_world_imu.T_world_body.translation, axis=1)[valid]
    assert np.sqrt(np.mean(errors**2)) < 0.03


@pytest.mark.parametrize("offset_s", [-0.7, 0.6])
def test_it_is_found_with_a_real_imu(shared_data, offset_s):
    log = read_log(shared_data / "euroc_v101")
    found = fuse(late(log, -offset_s), ESTIMATED).calibrated
    assert found.timeshift_cam_imu_s == pytest.approx(log.calibration.timeshift_cam_imu_s + offset_s, abs=0.003)


def test_it_is_found_with_a_real_networks_detections(shared_data):
    """The same as in time, but for where the filter starts."""
    log = read_log(shared_data / "ycbv_dope/0055")
    alone = replace(log, object_poses={"": log.object_poses["supervised"]}, T_odom_cam=None)
    before, after = (fuse(late(alone, -shift), ESTIMATED).calibrated for shift in (0.0, 0.5))
    assert after.timeshift_cam_imu_s - before.timeshift_cam_imu_s == pytest.approx(0.5, abs=0.003)


@pytest.mark.parametrize("estimator", ["graph", "batch"])
def test_a_graphs_measurements_are_where_they_were_made(log, estimator):
    """With the prior that a user would widen, and nothing but the filter to lead there."""
    options = replace(ESTIMATED, estimator=estimator, prior=replace(ESTIMATED.prior, time_offset=0.2))
    result = run_graph(pose_problem(stated(log, 0.38), options), options)
    assert result.calibrated.timeshift_cam_imu_s == pytest.approx(0.5, abs=0.004)


def test_a_calibration_that_agrees_is_kept(log):
    assert with_coarse_offset(log, ESTIMATED, None, None) is log
    near = stated(log, 0.48)
    assert with_coarse_offset(near, ESTIMATED, None, None) is near


def test_nothing_is_moved_that_is_not_estimated(log):
    wrong = stated(log, 0.0)
    assert with_coarse_offset(wrong, FuseOptions(), None, None) is wrong
    without_imu = replace(ESTIMATED, motion="constant-velocity")
    assert with_coarse_offset(wrong, without_imu, None, None) is wrong


def test_odometry_tells_it_where_the_detections_do_not(shared_data):
    log = read_log(shared_data / "ycbv_dope/0029")
    detections = log.object_poses["synthetic"]
    assert coarse_offset(replace(log, T_odom_cam=None, camera_poses=None), object_poses=detections) is None
    match = coarse_offset(log, object_poses=detections)
    assert abs(match.offset.offset_s) < match.offset_error_s
