"""The compiled filter against the plain one on filterpy: the same numbers on whole logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filter_runs import LAYOUTS, assert_same, run, simulated

from fusion import filter_loop, memory, reference_filter
from fusion.fuse import run_filter
from fusion.measurements import ODOMETRY_STEP
from fusion.noise_scale import FOLLOWED
from fusion.options import DetectionBias, DetectionNoise, Estimate, FuseOptions
from fusion.prepare import pose_problem
from poet_loc.io.log_folder import read_log


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS.keys())
@pytest.mark.parametrize("noise", ["white", "network"])
def test_compiled_is_plain_on_objects(layout, noise):
    problem, options = simulated(layout=layout, noise=noise), FuseOptions()
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    assert np.count_nonzero(compiled.decisions) > 50


@pytest.mark.parametrize("stated", [1.0, 0.4])
def test_compiled_is_plain_on_camera_poses(stated):
    problem, options = simulated("camera"), FuseOptions(measurements="camera")
    problem.measurements.covariances[:] *= stated**2
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    assert np.count_nonzero(compiled.decisions) > 40
    assert (stated == 1.0) == np.all(compiled.memory.scales[1, :FOLLOWED] < 1.2)


def test_compiled_is_plain_through_an_imu_gap_and_with_noise_that_adapts():
    problem = simulated(noise="network", layout=LAYOUTS["everything"])
    stamps = problem.imu.stamps_ns
    kept = (stamps < stamps[250]) | (stamps > stamps[300])
    problem = replace(problem, imu=problem.imu[kept][:-40])  # and measurements beyond the end
    problem.measurements.covariances[:] /= 9.0
    options = FuseOptions()
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    assert np.all(compiled.memory.scales[0, :FOLLOWED] > 1.2)


def test_compiled_is_plain_where_one_part_of_a_bias_never_changes():
    options = FuseOptions(bias=DetectionBias(correlation_rotation_s=np.inf, correlation_along_s=1.0))
    problem = simulated(noise="network", options=options)
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    other = replace(options, bias=DetectionBias(correlation_rotation_s=np.inf, correlation_along_s=9.0))
    assert np.abs(run(filter_loop.run_log, problem, other).core[-1] - compiled.core[-1]).max() > 1e-6


def test_compiled_is_plain_while_the_time_offset_is_followed():
    options = FuseOptions(bias=DetectionBias(use=False))
    problem = simulated(layout=LAYOUTS["time offset"], options=options, noise="white", stamp_delay_s=0.02)
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    assert compiled.memory.counters[memory.DELAY] == pytest.approx(-20e6, abs=5e6)


def test_compiled_is_plain_on_an_unknown_map():
    options = FuseOptions(estimate=Estimate(map="unknown", extrinsics=True), noise=DetectionNoise(rotation_deg=2.0))
    problem = simulated(noise="white", options=options, covariances=False, symmetric_objects=0)
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    assert np.all(compiled.memory.known == 1.0)


@pytest.mark.parametrize("motion", ["odometry", "constant-velocity"])
def test_compiled_is_plain_without_an_imu(motion):
    options = FuseOptions(motion=motion)
    problem = simulated(noise="white", options=options, odometry=True)
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    assert np.count_nonzero(compiled.decisions) > 50


@pytest.mark.parametrize("measurements", ["objects", "camera"])
def test_compiled_is_plain_with_odometry_beside_the_imu(measurements):
    options = FuseOptions(motion="imu+odometry", measurements=measurements, estimate=Estimate(extrinsics=True))
    problem = simulated(measurements, options=options, odometry=True)
    assert problem.layout.clone
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    steps = problem.measurements.kinds == ODOMETRY_STEP
    assert np.count_nonzero(compiled.decisions[steps]) > 10
    assert np.count_nonzero(compiled.decisions[~steps]) > 50


def test_run_reference_returns_what_run_filter_returns():
    problem, options = simulated("camera"), FuseOptions(measurements="camera")
    fast, plain = run_filter(problem, options), reference_filter.run_reference(problem, options)
    assert (fast.name, plain.name) == ("fuse/eskf/camera", "fuse/reference/camera")
    np.testing.assert_array_equal(fast.stamps_ns, plain.stamps_ns)
    np.testing.assert_allclose(fast.T_world_imu.translation, plain.T_world_imu.translation, atol=1e-9)
    np.testing.assert_allclose(fast.pose_covariances, plain.pose_covariances, rtol=1e-7, atol=1e-15)
    np.testing.assert_array_equal(fast.gate.position_accepted, plain.gate.position_accepted)


@pytest.mark.parametrize(("folder", "detections"), [("euroc_v101", None), ("ycbv_dope/0051", "selftrained")])
def test_compiled_is_plain_on_real_logs(shared_data, folder, detections):
    log, options = read_log(shared_data / folder), FuseOptions()
    problem = pose_problem(log, options, object_poses=log.detections(detections)[1])
    problem = replace(problem, imu=problem.imu[:2000])
    compiled, plain = (run(loop, problem, options) for loop in (filter_loop.run_log, reference_filter.run_log))
    assert_same(compiled, plain)
    assert compiled.memory.counters[memory.MODE] == memory.TRACKING
    assert np.count_nonzero(compiled.decisions) > 100
