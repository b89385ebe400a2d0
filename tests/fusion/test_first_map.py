"""A log without any map: the world is an object's, upright, and what is found serves as the map of the next run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.first_map import first_map
from fusion.fuse import fuse
from fusion.options import Estimate, FuseOptions
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError

UNKNOWN = FuseOptions(estimate=Estimate(map="unknown"))


@pytest.fixture(scope="module")
def log():
    options = SimulationOptions(duration_s=25.0, imu_rate_hz=100.0, objects=4, symmetric_objects=0, seed=2)
    return simulate(replace(options, odometry=True))


@pytest.fixture(scope="module")
def bare(log):
    return replace(log, landmark_map=None, T_odom_cam=None)


@pytest.fixture(scope="module")
def found(bare):
    return fuse(bare, UNKNOWN)


def up_in_object(landmark):
    return landmark.T_world_obj.rotation.inv().apply([0.0, 0.0, 1.0])


def shape_error_m(result, log):
    """Return the RMSE of the position after the best rotation and translation of the whole (Umeyama)."""
    truth, rows = log.T_world_imu.interpolate(result.stamps_ns)
    place = result.T_world_imu.translation[rows]
    there, here = truth.translation - truth.translation.mean(axis=0), place - place.mean(axis=0)
    turn, _ = Rotation.align_vectors(there, here)
    return np.sqrt(np.mean(np.sum((there - turn.apply(here)) ** 2, axis=1)))


def test_every_object_is_upright(log):
    exact = simulate(SimulationOptions(duration_s=20.0, objects=5, symmetric_objects=0, noise="none", seed=2))
    made = first_map(exact.object_poses[""], exact.imu, exact.calibration)
    assert [each.key for each in made] == [each.key for each in exact.landmark_map]
    for each, true in zip(made, exact.landmark_map, strict=True):
        assert up_in_object(each) @ up_in_object(true) > np.cos(np.radians(1.5))


@pytest.mark.parametrize("estimator", ["eskf", "graph"])
def test_a_log_without_a_map_is_fused(estimator, bare, log):
    result = fuse(bare, replace(UNKNOWN, estimator=estimator))
    assert shape_error_m(result, log) < 0.04
    assert len(result.calibrated.landmark_map) == len(log.landmark_map)
    assert np.degrees(result.calibrated.gravity_sigma) < 2.0


def test_the_map_that_was_found_serves_the_next_run(found, bare, log):
    known = shape_error_m(fuse(replace(log, T_odom_cam=None)), log)
    again = shape_error_m(fuse(replace(bare, landmark_map=found.calibrated.landmark_map)), log)
    assert again < shape_error_m(found, log)
    assert again < 1.5 * known


def test_a_camera_alone_needs_no_upright_world(bare, log):
    alone = replace(bare, imu=None, T_odom_cam=log.T_odom_cam)
    result = fuse(alone, UNKNOWN)
    assert result.motion == "odometry"
    assert result.calibrated.gravity is None
    assert shape_error_m(result, log) < 0.04


def test_a_map_whose_rotations_mean_nothing_is_told_to_be_left_out(bare, log):
    """As one writes it who has no map: the anchor lies on its side."""
    lying = make_pose(Rotation.from_euler("x", 90.0, degrees=True), np.zeros(3))
    zeros = [replace(each, T_world_obj=lying * each.T_world_obj) for each in log.landmark_map]
    with pytest.raises(InputError, match=r"never started.*leave landmarks\.json out"):
        fuse(replace(bare, landmark_map=replace(log.landmark_map, landmarks=tuple(zeros))), UNKNOWN)


def test_detections_may_be_handed_over_beside_the_log(bare, found):
    result = fuse(replace(bare, object_poses={}), UNKNOWN, object_poses=bare.object_poses[""])
    np.testing.assert_array_equal(result.T_world_imu.translation, found.T_world_imu.translation)
