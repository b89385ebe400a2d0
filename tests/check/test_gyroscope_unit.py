"""Degrees per second told apart from a fast motion, by poses that turn with the gyroscope."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.simulate import SimulationOptions, simulate
from poet_loc.check.turns import gyroscope_beside_poses
from poet_loc.check.units import check_gyroscope
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import ImuSamples
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log, read_log

DEGREES = float(np.degrees(1.0))


def without_truth(log: Log) -> Log:
    return replace(log, T_world_cam=None, T_world_imu=None)


def turning(log: Log, factor: float) -> Log:
    return replace(log, imu=replace(log.imu, angular_velocity=factor * log.imu.angular_velocity))


@pytest.fixture(scope="module")
def fast() -> Log:
    """An imu that spins at 7 to 13 rad/s, which is faster than what counts as a sign of degrees, before one object."""
    log = without_truth(simulate(SimulationOptions(duration_s=20.0, objects=1, symmetric_objects=0, noise="white")))
    axis, ((name, poses),) = np.array([0.6, 0.0, 0.8]), log.object_poses.items()
    start_ns = log.imu.stamps_ns[0]
    seconds, seen_s = ((stamps - start_ns) * 1e-9 for stamps in (log.imu.stamps_ns, poses.stamps_ns))
    noise = Rotation.from_rotvec(np.random.default_rng(0).normal(0.0, 0.03, (len(poses), 3)))
    turned = Rotation.from_rotvec(np.outer(10.0 * seen_s - 3.75 * np.cos(0.8 * seen_s), -axis))
    T = make_pose(noise * turned, poses.T_cam_obj.translation)
    rates = np.outer(10.0 + 3.0 * np.sin(0.8 * seconds), axis)
    force = np.tile([0.0, 0.0, 9.81], (len(log.imu), 1))
    spun = replace(log, object_poses={name: replace(poses, T_cam_obj=T)})
    return replace(spun, imu=ImuSamples(log.imu.stamps_ns, rates, force))


def test_a_fast_motion_is_not_taken_for_degrees(fast):
    assert "gyroscope-degrees" not in {finding.check for finding in check_gyroscope(fast)}
    assert gyroscope_beside_poses(fast).over_poses == pytest.approx(1.0, abs=0.2)


def test_degrees_of_a_fast_motion_are_an_error(fast):
    (finding,) = check_gyroscope(turning(fast, DEGREES))
    assert (finding.check, finding.severity) == ("gyroscope-degrees", "error")
    np.testing.assert_allclose(
        finding.repair(turning(fast, DEGREES)).imu.angular_velocity, fast.imu.angular_velocity, rtol=1e-12
    )


def test_without_poses_that_turn_with_it_degrees_are_a_warning(fast):
    (finding,) = check_gyroscope(replace(fast, object_poses={}))
    assert (finding.check, finding.severity) == ("gyroscope-degrees", "warning")
    poses = next(iter(fast.object_poses.values()))
    order = np.random.default_rng(0).permutation(len(poses))  # poses that belong to other stamps
    elsewhere = replace(poses, T_cam_obj=poses.T_cam_obj[order])
    assert gyroscope_beside_poses(replace(fast, object_poses={"": elsewhere})) is None


def never_at_rest(bias: float, swing: float = 0.5) -> Log:
    """A camera 7 times a second that swings slowly all the time: its quietest moments are no rest."""
    seconds, seen_s = np.arange(0.0, 30.0, 0.01), np.arange(0.0, 30.0, 1.0 / 7.0)

    def rotation(t: np.ndarray) -> Rotation:
        angles = [0.25 * t + swing * np.sin(0.9 * t), swing * np.sin(0.5 * t), 0.5 * swing * np.sin(1.1 * t)]
        return Rotation.from_euler("ZYX", np.stack(angles, axis=-1))

    rates = (rotation(seconds - 1e-4).inv() * rotation(seconds + 1e-4)).as_rotvec() / 2e-4
    force = rotation(seconds).inv().apply([0.0, 0.0, 9.81])
    body = make_pose(rotation(seen_s), np.zeros((len(seen_s), 3)))
    imu = ImuSamples(np.round(seconds * 1e9).astype(np.int64), rates + bias * np.array([1.0, 0.0, 0.0]), force)
    truth = Trajectory(np.round(seen_s * 1e9).astype(np.int64), body)
    return Log(path=Path("log"), imu=imu, T_world_imu=truth)


def test_a_body_that_never_rests_has_no_bias_for_that():
    steady = never_at_rest(0.0)
    assert not list(check_gyroscope(steady))
    assert not list(check_gyroscope(replace(steady, T_world_imu=None)))  # its quiet moments differ
    turntable = never_at_rest(0.0, swing=0.02)
    (finding,) = check_gyroscope(replace(turntable, T_world_imu=None))  # a steady turn alone reads as a bias does
    assert "quietest moments" in finding.what
    assert not list(check_gyroscope(turntable))
    (finding,) = check_gyroscope(never_at_rest(1.5))
    assert (finding.check, finding.severity) == ("gyroscope-bias", "error")


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bias", [0.0, 0.15])
def test_simulated_networks_tell_the_unit(seed, bias):
    log = without_truth(simulate(SimulationOptions(duration_s=15.0, seed=seed, gyroscope_bias_sigma=bias)))
    assert not any(finding.check == "gyroscope-degrees" for finding in check_gyroscope(log))
    (finding,) = check_gyroscope(turning(log, DEGREES))
    assert finding.severity == "error"
    assert finding.evidence["gyroscope_over_poses"] == pytest.approx(DEGREES, rel=0.3)


@pytest.mark.parametrize("name", ["0001", "0029", "0049", "0050", "0054", "0058"])
@pytest.mark.parametrize("detections", ["selftrained", "synthetic"])
def test_real_detections_are_never_wrong_about_the_unit(name, detections, shared_data):
    log = without_truth(read_log(shared_data / "ycbv_dope" / name))
    log = replace(log, object_poses={detections: log.object_poses[detections]}, T_odom_cam=None)
    assert not list(check_gyroscope(log))
    turned = gyroscope_beside_poses(turning(log, DEGREES))
    assert turned is None or turned.in_degrees
    if detections == "selftrained":
        assert turned is not None
