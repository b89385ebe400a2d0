"""The fitted noise against errors of known make, and against the shared logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.fit_noise import FitNoiseOptions, fit_noise
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Landmark, LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log

WHITE = np.array([0.03, 0.03, 0.03, 0.004, 0.004, 0.015])
VARYING = np.array([0.05, 0.05, 0.05, 0.006, 0.006, 0.03])
TAU = np.array([4.0, 4.0, 4.0, 2.0, 2.0, 1.0])

TABLE_COLUMNS = ("stamps_ns", "frames", "object_ids", "instances", "scores")

MEANS = {1: np.array([0.05, -0.08, 0.02, 0.004, 0.01, -0.04]), 2: np.array([-0.03, 0.04, 0.0, -0.006, 0.008, 0.03])}
SCATTER = np.array([0.01, 0.01, 0.01, 0.001, 0.001, 0.004])


def made_log(seed: int, frames: int = 3000, object_id: int = 1, mean: np.ndarray | float = 0.0) -> Log:
    """A camera at rest before one object, whose errors are white noise, a Gauss-Markov bias and what they all share."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(frames, dtype=np.int64) * 33_333_333
    phi = np.exp(-0.033333333 / TAU)
    bias, errors = VARYING * rng.normal(size=6), np.zeros((frames, 6))
    for i in range(frames):
        bias = phi * bias + np.sqrt(1 - phi**2) * VARYING * rng.normal(size=6)
        errors[i] = mean + bias + WHITE * rng.normal(size=6)
    p = np.array([0.0, 0.0, 1.2])
    t = p + np.column_stack([errors[:, 3] * p[2], errors[:, 4] * p[2], errors[:, 5] * p[2]])
    T_cam_obj = make_pose(Rotation.from_rotvec(errors[:, :3]), t)
    zeros = np.zeros(frames, dtype=np.int64)
    poses = ObjectPoses(stamps, np.arange(frames), zeros + object_id, zeros, np.ones(frames), T_cam_obj)
    world = LandmarkMap((Landmark(object_id, make_pose(Rotation.identity(), p)),))
    still = Trajectory(stamps, RigidTransform.from_translation(np.zeros((frames, 3))))
    return Log(Path("made"), {"": poses}, world, T_world_cam=still)


def test_the_parts_of_errors_of_known_make_are_found():
    fitted = fit_noise([made_log(seed) for seed in range(8)])
    for name, part in (("rotation", 0), ("across", 3), ("along", 5)):
        found = fitted.parts[name]
        assert found.white == pytest.approx(WHITE[part], rel=0.1)
        assert np.hypot(found.varying, found.steady) == pytest.approx(VARYING[part], rel=0.15)
        assert found.varying > 2 * found.steady
        assert found.correlation_s == pytest.approx(TAU[part], rel=0.4)


def test_the_options_hold_each_parts_own_correlation_time():
    fitted = fit_noise([made_log(0)])
    bias = fitted.options()[1]
    times = bias.correlation_rotation_s, bias.correlation_across_s, bias.correlation_along_s
    assert times == tuple(fitted.parts[name].correlation_s for name in ("rotation", "across", "along"))


def test_gross_errors_are_counted_and_left_out():
    log = made_log(0)
    poses = log.object_poses[""]
    translation = poses.T_cam_obj.translation
    translation[::10] += [0.0, 0.0, 1.0]
    spoiled = replace(poses, T_cam_obj=make_pose(poses.T_cam_obj.rotation, translation))
    clean, found = fit_noise([log]), fit_noise([replace(log, object_poses={"": spoiled})])
    assert found.gross_share == pytest.approx(0.1, abs=0.01)
    assert found.parts["along"].white == pytest.approx(clean.parts["along"].white, rel=0.1)


def test_detections_that_are_too_few_to_fit_are_no_gross_errors():
    log, few = made_log(0, 1000), made_log(1, 60, object_id=2)
    poses, others = log.object_poses[""], few.object_poses[""]
    order = np.argsort(np.r_[poses.stamps_ns, others.stamps_ns], kind="stable")
    columns = {name: np.r_[getattr(poses, name), getattr(others, name)][order] for name in TABLE_COLUMNS}
    T_cam_obj = RigidTransform.concatenate([poses.T_cam_obj, others.T_cam_obj])[order]
    world = LandmarkMap((*log.landmark_map, *few.landmark_map))
    fitted = fit_noise(
        [replace(log, object_poses={"": ObjectPoses(**columns, T_cam_obj=T_cam_obj)}, landmark_map=world)]
    )
    assert fitted.detections == 1000
    assert fitted.gross_share == 0.0


def test_without_ground_truth_there_is_nothing_to_fit():
    with pytest.raises(InputError, match="T_world_cam"):
        fit_noise([replace(made_log(0, 200), T_world_cam=None)])
    with pytest.raises(InputError, match="longest-lag-s is inf; give more than 0 and less than inf"):
        FitNoiseOptions(longest_lag_s=np.inf)


def test_real_networks_err_mostly_in_depth_and_for_long(shared_data):
    from poet_loc.io.log_folder import read_log

    log = read_log(shared_data / "ycbv_dope" / "0014", "supervised")
    parts = fit_noise([log], "supervised").parts
    lasting = {name: np.hypot(part.varying, part.steady) for name, part in parts.items()}
    assert lasting["along"] > 2 * lasting["across"]
    assert all(lasting[name] > parts[name].white for name in parts)


def test_mean_errors_of_objects_are_found_and_what_scatters_about_them_is_steady():
    rng, logs = np.random.default_rng(3), []
    for object_id, mean in MEANS.items():
        logs += [made_log(10 * object_id + i, 2000, object_id, mean + SCATTER * rng.normal(size=6)) for i in range(5)]
    fitted = fit_noise(logs)
    for object_id, mean in MEANS.items():
        np.testing.assert_array_less(np.abs(fitted.means[object_id] - mean), 0.35 * VARYING)
    unaware = [fit_noise([log]) for log in logs]
    for name in ("rotation", "along"):
        slow = np.hypot(fitted.parts[name].varying, fitted.parts[name].steady)
        whole = np.mean([np.hypot(one.parts[name].varying, one.parts[name].steady) for one in unaware])
        assert slow < 0.85 * whole


def test_what_scatters_from_log_to_log_is_hardly_taken_for_a_mean_error():
    rng, size = np.random.default_rng(4), np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.03])
    drawn = {object_id: size * rng.normal(size=(4, 6)) for object_id in range(1, 7)}
    logs = [made_log(10 * k + i, 1000, k, mean) for k, each in drawn.items() for i, mean in enumerate(each)]
    fitted = fit_noise(logs)
    believed = np.array([fitted.means[k] / size for k in drawn])
    averages = np.array([each.mean(axis=0) / size for each in drawn.values()])
    assert np.mean(believed**2) < 0.3 * np.mean(averages**2)


def test_one_log_tells_no_mean_error():
    assert fit_noise([made_log(0, 1000, 1, MEANS[1])]).means == {}
