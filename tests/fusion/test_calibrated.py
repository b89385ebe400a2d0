"""What a result says of extrinsics, time offset, gravity and map: near the truth, by its own covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion.calibrated import Calibrated
from fusion.fuse import fuse
from fusion.options import DetectionBias, Estimate, FuseOptions
from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import Log

WHITE = FuseOptions(bias=DetectionBias(use=False))
OFF = RigidTransform.from_exp_coords([0.03, -0.03, 0.03, 0.02, -0.02, 0.01])


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(SimulationOptions(duration_s=15.0, noise="white", objects=5, symmetric_objects=0, seed=3))


def off_by(log: Log, shift_s: float) -> Log:
    calibration = replace(
        log.calibration,
        T_cam_imu=log.calibration.T_cam_imu * OFF,
        timeshift_cam_imu_s=log.calibration.timeshift_cam_imu_s + shift_s,
    )
    return replace(log, calibration=calibration)


def squared_distance(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize("changes", [{}, {"smooth": True}, {"estimator": "graph"}, {"estimator": "batch"}])
def test_extrinsics(log, changes):
    result = fuse(off_by(log, 0.0), replace(WHITE, estimate=Estimate(extrinsics=True), **changes)).calibrated
    true = log.calibration.T_cam_imu.inv()
    rotation = (result.T_imu_cam.rotation.inv() * true.rotation).as_rotvec()
    error = np.concatenate([rotation, true.translation - result.T_imu_cam.translation])
    assert np.linalg.norm(rotation) < 0.3 * np.linalg.norm([0.03, 0.03, 0.03])
    assert squared_distance(error, result.extrinsic_covariance) < chi2.ppf(0.9999, 6)
    assert np.allclose((result.T_cam_imu * result.T_imu_cam).as_matrix(), np.eye(4))
    found = result.applied_to(log.calibration)
    assert np.allclose(found.T_cam_imu.as_matrix(), result.T_cam_imu.as_matrix())
    assert found.timeshift_cam_imu_s == log.calibration.timeshift_cam_imu_s
    assert result.landmark_map is result.timeshift_cam_imu_s is result.gravity is None


def test_time_offset_and_gravity(log):
    options = replace(WHITE, estimate=Estimate(time_offset=True, gravity=True))
    wrong = replace(
        off_by(log, 0.03), calibration=replace(off_by(log, 0.03).calibration, T_cam_imu=log.calibration.T_cam_imu)
    )
    result = fuse(wrong, options).calibrated
    assert result.timeshift_cam_imu_s == pytest.approx(log.calibration.timeshift_cam_imu_s, abs=0.003)
    error = result.timeshift_cam_imu_s - log.calibration.timeshift_cam_imu_s
    assert abs(error) < 5 * result.timeshift_sigma_s < 0.02
    tilt = np.arccos(-result.gravity[2] / np.linalg.norm(result.gravity))
    assert tilt < 5 * result.gravity_sigma < np.radians(5.0)
    assert result.applied_to(wrong.calibration).timeshift_cam_imu_s == result.timeshift_cam_imu_s
    assert result.T_cam_imu is result.landmark_map is None


@pytest.mark.parametrize("estimator", ["eskf", "graph", "batch"])
def test_unknown_map(log, estimator):
    result = fuse(log, replace(WHITE, estimator=estimator, estimate=Estimate(map="unknown"))).calibrated
    found = {landmark.key: landmark for landmark in result.landmark_map}
    distances = []
    for landmark in log.landmark_map:
        estimate = found[landmark.key]
        assert estimate.name == landmark.name
        error = (estimate.T_world_obj.inv() * landmark.T_world_obj).as_exp_coords()
        if estimate.covariance.max() > 1e-12:  # the anchor's is zero, or the graph's least
            distances.append(squared_distance(error, estimate.covariance))
    assert len(distances) == len(log.landmark_map) - 1
    assert sum(distances) < chi2.ppf(0.9999, 6 * len(distances))
    assert max(distances) > 0.05


def test_nothing_is_said_of_what_was_taken_as_given(log):
    assert fuse(log, WHITE).calibrated is None


def test_values_and_sigmas_of_a_file():
    """Degrees and metres of what is found; nothing of what is not."""
    down = 9.81 * np.array([0.0, np.sin(0.05), -np.cos(0.05)])
    T = RigidTransform.from_exp_coords([0.0, 0.0, 0.1, 0.2, 0.0, 0.0])
    covariance = np.diag(np.square([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))
    told = Calibrated(T, covariance, -0.045, 0.001, down, 0.002).as_plain()
    assert (told["timeshift_cam_imu_s"], told["timeshift_sigma_s"]) == (-0.045, 0.001)
    np.testing.assert_allclose(told["T_imu_cam"], T.as_matrix())
    np.testing.assert_allclose(told["rotation_sigma_deg"], np.degrees([0.01, 0.02, 0.03]))
    np.testing.assert_allclose(told["translation_sigma_m"], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(told["gravity_m_s2"], down)
    assert told["gravity_tilt_deg"] == pytest.approx(np.degrees(0.05))
    assert told["gravity_sigma_deg"] == pytest.approx(np.degrees(0.002))
    assert Calibrated(gravity=down, gravity_sigma=0.002).as_plain().keys() == {
        "gravity_m_s2",
        "gravity_tilt_deg",
        "gravity_sigma_deg",
    }
    assert not Calibrated().as_plain()
