"""Noise larger than stated is found by the quartile of its innovations, and a filter that follows it stays right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from fusion import memory
from fusion.fuse import fuse
from fusion.health import as_plain, troubles
from fusion.measurements import CAMERA_POSE, OBJECT_POSE, ODOMETRY_STEP
from fusion.nav_state import StateLayout
from fusion.noise_scale import FOLLOWED, LEAST, LOWER_QUARTILE, PLACE, TURN, follow_scale, scale_of, widen, widening
from fusion.options import FuseOptions, Gate
from fusion.simulate import Displacement, SimulationOptions, simulate
from poet_loc.core.consistency import pose_nees

RATE, LARGEST = Gate().adaptation, Gate().max_noise_scale


def new_memory() -> memory.Memory:
    m = memory.views.py_func(*memory.allocate(StateLayout(n_objects=2)))
    m.scales[:, :FOLLOWED] = 1.0
    return m


def followed(
    factors: tuple[float, float], gross: float = 0.0, count: int = 4000, k: int = 0
) -> tuple[np.ndarray, memory.Memory]:
    """Return the scales over time of a filter that widens what it expects, where errors are so many times larger."""
    m, rng, over_time = new_memory(), np.random.default_rng(3), np.zeros((count, 2))
    m.orders[1] = 0
    for i in range(count):
        parts = chi2.rvs(3, size=2, random_state=rng) * np.array(factors) ** 2
        parts = np.where(rng.random() < gross, 1e3, parts)
        parts /= [scale_of(m, OBJECT_POSE, part) ** 2 for part in (TURN, PLACE)]
        follow_scale(m, OBJECT_POSE, k, np.array([parts.sum(), *parts]), RATE, LARGEST)
        over_time[i] = m.scales[0, :FOLLOWED]
    return over_time, m


def test_the_quartile_is_chi_squares():
    assert pytest.approx(chi2.ppf(0.25, 3), rel=1e-6) == LOWER_QUARTILE


@pytest.mark.parametrize("factors", [(1.0, 1.0), (4.0, 1.5), (1.0, 6.0)])
def test_rotation_and_position_are_widened_to_what_they_are(factors):
    over_time, m = followed(factors)
    mean = np.exp(np.log(over_time[500:].clip(min=1.0)).mean(axis=0))  # what was used
    np.testing.assert_allclose(mean, factors, rtol=0.06)
    assert widening(m) == pytest.approx(over_time[-1].clip(min=1.0))
    assert m.scales[0, FOLLOWED] == len(over_time)
    assert np.all(m.scales[1] == [1.0, 1.0, 0.0])


def test_of_half_gross_errors_the_quartile_is_the_rests_median():
    over_time, _ = followed((2.0, 2.0), gross=0.5)
    expected = 2.0 * np.sqrt(chi2.ppf(0.5, 3) / LOWER_QUARTILE)
    np.testing.assert_allclose(np.exp(np.log(over_time[500:]).mean(axis=0)), expected, rtol=0.06)


def test_noise_that_is_smaller_than_stated_is_left_as_it_is():
    over_time, m = followed((0.1, 0.1))
    assert np.all(over_time[100:] == LEAST)
    assert widening(m) == (1.0, 1.0)
    assert widening(followed((1e3, 1e3))[1]) == (LARGEST, LARGEST)


def test_what_says_nothing_moves_nothing():
    m = new_memory()
    follow_scale(m, OBJECT_POSE, 0, np.array([np.inf, 50.0, 50.0]), RATE, LARGEST)  # of an object not known yet
    assert np.all(m.scales[0] == [1.0, 1.0, 0.0])
    turned, m = followed((5.0, 1.0), count=50, k=1)  # of an axis, a rotation has two degrees of freedom
    assert np.all(turned[:, TURN] == 1.0)
    assert m.scales[0, PLACE] != 1.0


def test_a_covariance_is_widened_as_a_whole():
    m, rng = new_memory(), np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    for kind, row in ((OBJECT_POSE, 0), (CAMERA_POSE, 1)):
        m.scales[:, :FOLLOWED] = 1.0
        m.scales[row, :FOLLOWED] = 3.0, 0.7
        R, D = root @ root.T, np.diag([3.0, 3.0, 3.0, 1.0, 1.0, 1.0])
        expected = D @ R @ D
        widen(m, kind, R)
        np.testing.assert_allclose(R, expected)
        other = expected.copy()
        widen(m, ODOMETRY_STEP, other)
        np.testing.assert_array_equal(other, expected)


@pytest.fixture(scope="module")
def logs():
    """Three logs whose detections and camera poses state a third of the 1-sigma that they have."""
    return simulated(1.0 / 3.0)


def simulated(stated_share: float):
    wanted = SimulationOptions(
        duration_s=25.0,
        imu_rate_hz=100.0,
        objects=4,
        symmetric_objects=0,
        covariances=True,
        camera_poses=True,
        stated_share=stated_share,
    )
    return [simulate(replace(wanted, seed=seed)) for seed in (1, 2, 3)]


def fared(logs, options: FuseOptions) -> tuple[float, float]:
    """Return RMSE, m, and mean NEES/dof over the logs, from 2 s after the start."""
    squares, nees = [], []
    for log in logs:
        result = fuse(log, options)
        truth, known = log.T_world_imu.interpolate(result.stamps_ns)
        known &= result.stamps_ns > result.stamps_ns[0] + 2_000_000_000
        error = (truth.translation - result.T_world_imu.translation)[known]
        squares.append(np.sum(error**2, axis=1).mean())
        nees.append(pose_nees(result.T_world_imu[known], truth[known], result.pose_covariances[known]).mean())
    return float(np.sqrt(np.mean(squares))), float(np.mean(nees))


@pytest.mark.parametrize(
    ("measurements", "estimator"), [("objects", "eskf"), ("camera", "eskf"), ("objects", "graph"), ("objects", "batch")]
)
def test_an_estimator_that_is_told_too_little_noise_stays_right(logs, measurements, estimator):
    options = FuseOptions(measurements=measurements, estimator=estimator)
    rmse, nees = fared(logs, options)
    assert rmse < 0.025
    assert nees < 4.0
    believing, believed = fared(logs, replace(options, gate=Gate(adaptation=0.0)))
    assert rmse < 0.5 * believing
    assert nees < 0.4 * believed


def test_what_states_its_noise_rightly_is_believed():
    right = simulated(1.0)
    for measurements in ("objects", "camera"):
        options = FuseOptions(measurements=measurements)
        adapted, believed = fared(right, options), fared(right, replace(options, gate=Gate(adaptation=0.0)))
        assert adapted == pytest.approx(believed, rel=0.1)


def test_the_factor_is_told(logs):
    result = fuse(logs[0])
    assert 2.0 < result.noise_scale[1] < 5.0
    assert as_plain(result.health)["noise_scale"]["position"] == pytest.approx(result.noise_scale[1], abs=1e-6)
    turn, place = result.noise_scale
    assert f"took the 1-sigma of the poses {turn:.1f} (rotation) and {place:.1f} (position) times larger" in troubles(
        result
    )


def test_one_object_that_is_moved_widens_nothing():
    moved = SimulationOptions(duration_s=15.0, objects=4, symmetric_objects=0, moved=Displacement(1, after_s=6.0))
    result = fuse(simulate(moved))
    assert result.health.released
    assert max(result.noise_scale) < 1.2
