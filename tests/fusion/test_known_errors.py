"""Mean errors that are known: taken off exactly, the same online, and what a filter gains that is told them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.fuse import fuse
from fusion.known_errors import known_errors
from fusion.online import Estimator
from fusion.options import DetectionBias, FuseOptions
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Landmark, LandmarkMap

MEANS = ((1, 2.0, -4.0, 1.0, 0.005, 0.01, 0.04), (3, -3.0, 0.0, 2.0, -0.01, 0.0, -0.05))


def erring(log, means):
    """Return the log with mean errors put on its detections, written out by hand."""
    poses = log.object_poses[""]
    t, q = poses.T_cam_obj.translation.copy(), poses.T_cam_obj.rotation.as_quat()
    for i, object_id in enumerate(poses.object_ids):
        for known, *mean in means:
            if known == object_id:
                x, y, stretch = mean[3:]
                p = t[i].copy()
                t[i] += np.array([x * p[2], y * p[2], -x * p[0] - y * p[1]]) + stretch * p
                q[i] = (Rotation.from_rotvec(mean[:3], degrees=True) * Rotation.from_quat(q[i])).as_quat()
    T_cam_obj = RigidTransform.from_components(t, Rotation.from_quat(q))
    return replace(log, object_poses={"": replace(poses, T_cam_obj=T_cam_obj)})


@pytest.fixture(scope="module")
def log():
    return simulate(SimulationOptions(duration_s=8.0, camera_rate_hz=15.0, objects=3, seed=2))


def told(means=MEANS) -> FuseOptions:
    return FuseOptions(bias=DetectionBias(means=means))


def test_a_filter_that_is_told_them_is_one_that_never_saw_them(log):
    clean, corrected = fuse(log, FuseOptions()), fuse(erring(log, MEANS), told())
    np.testing.assert_allclose(corrected.T_world_imu.translation, clean.T_world_imu.translation, atol=1e-9)
    untold = fuse(erring(log, MEANS), FuseOptions())
    assert np.abs(untold.T_world_imu.translation[-1] - clean.T_world_imu.translation[-1]).max() > 1e-3


def fed(log, options: FuseOptions) -> np.ndarray:
    """Return the state after a log was fed sample by sample."""
    estimator, imu, poses = Estimator(log.calibration, log.landmark_map, options), log.imu, log.object_poses[""]
    T = poses.T_cam_obj
    for k, stamp in enumerate(imu.stamps_ns):
        of = np.flatnonzero(poses.stamps_ns == stamp)
        if len(of):
            estimator.feed_object_poses(
                stamp, poses.object_ids[of], T.translation[of], T.rotation.as_quat()[of], instances=poses.instances[of]
            )
        estimator.feed_imu(stamp, imu.angular_velocity[k], imu.specific_force[k])
    assert estimator.state() is not None
    return estimator.memory.x.copy()


def test_online_takes_them_off_too(log):
    np.testing.assert_allclose(fed(erring(log, MEANS), told()), fed(log, FuseOptions()), atol=1e-9)


numbers = st.floats(-1.0, 1.0)


@given(st.tuples(*[numbers] * 6), st.tuples(numbers, numbers, st.floats(0.5, 2.0)), st.tuples(*[numbers] * 3))
def test_taking_off_is_the_inverse_of_a_bias(unit, p, turn):
    mean = np.array(unit) * [30.0, 30.0, 30.0, 0.2, 0.2, 0.2]
    world = LandmarkMap((Landmark(7, make_pose(Rotation.identity(), np.zeros(3))),))
    known = known_errors(DetectionBias(means=((7, *mean),)), world)
    assert known is not None
    p, R = np.array(p), Rotation.from_rotvec(turn)
    x, y, stretch = mean[3:]
    t = p + np.array([x * p[2], y * p[2], -x * p[0] - y * p[1]]) + stretch * p
    of = np.zeros(1, dtype=np.int64)
    R_back, t_back = known.taken_off(
        of, Rotation.concatenate([Rotation.from_rotvec(mean[:3], degrees=True) * R]), t[None]
    )
    np.testing.assert_allclose(t_back[0], p, atol=1e-9)
    assert (R_back[0].inv() * R).magnitude() < 1e-9


def test_nothing_known_costs_nothing(log):
    assert known_errors(DetectionBias(), log.landmark_map) is None
    assert known_errors(DetectionBias(means=((99, *[0.1] * 6),)), log.landmark_map) is None
    assert known_errors(DetectionBias(use=False, means=MEANS), log.landmark_map) is None


@pytest.mark.parametrize(
    "means", [((1, *[np.nan] * 6),), ((1, 200.0, *[0.0] * 5),), ((1, *[0.0] * 5, 0.9),), ((1, *[0.0] * 6),) * 2]
)
def test_impossible_means_are_told(means):
    with pytest.raises(InputError, match=r"bias\.means"):
        told(means)
