"""The smoother against a fixed-point smoother, against batch least squares and against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filter_runs import LAYOUTS, memory_of, run, simulated
from scipy.sparse import bmat, csc_matrix
from scipy.sparse.linalg import splu

from fusion import filter_loop, memory, reference_filter, smoother
from fusion.detection_errors import NetworkErrors, WhiteErrors
from fusion.fuse import fuse, run_filter
from fusion.imu_noise import imu_rows
from fusion.nav_state import CORE, EXTRINSIC_ROTATION, GYRO_BIAS, StateLayout, local_state, retract_state
from fusion.options import DetectionBias, DetectionNoise, Estimate, FuseOptions, Gate
from fusion.prepare import pose_problem
from fusion.reference_models import process_noise, residual_and_jacobian, transition, transport
from fusion.simulate import SimulationOptions, simulate, simulate_with_truth
from fusion.smoother import run_smoother, smooth
from poet_loc.core.consistency import pose_nees
from poet_loc.core.input_error import InputError


class FixedPoint(reference_filter.ReferenceFilter):
    """The plain filter, with the state of one row kept in the error state from then on: smoothing by augmentation.

    C is the covariance of the kept state's error with the present one's; every map and every measurement moves it.
    Source: B. D. O. Anderson and J. B. Moore, "Optimal Filtering" (1979), section 7.2.
    """

    anchor: int
    started_anew = 0

    def keep(self) -> None:
        self.x, self.P, self.C = self.m.x.copy(), self.m.P.copy(), self.m.P.copy()
        self.error, self.stamp = np.zeros(self.layout.n_error), self.m.counters[memory.NOW]

    def spread(self, A, Q):
        super().spread(A, Q)
        if hasattr(self, "C"):
            self.C = self.C @ A.T

    def condition(self, residual, H, R):
        if hasattr(self, "C"):
            gain = self.C @ H.T @ np.linalg.inv(H @ self.m.P @ H.T + R)
            self.error += gain @ residual
            self.P -= gain @ H @ self.C.T
            self.C = self.C - gain @ H @ self.m.P
        return super().condition(residual, H, R)

    def _put_object(self, log, j):
        if hasattr(self, "C"):  # its biases are started anew on the way
            for kind in range(self.layout.bias_kinds):
                self.C[:, self.layout.error_slice("biases", log.objects[j], kind)] = 0.0
        super()._put_object(log, j)

    def forget_what_starts_anew(self):
        if hasattr(self, "C"):  # what has been started anew knows nothing of the kept state
            anew = np.array([np.count_nonzero(row) == 1 for row in self.m.P])
            self.C[:, anew] = 0.0
            self.started_anew += np.count_nonzero(anew)

    def _settle_at_agreed(self, *arguments):
        self.forget_what_starts_anew()
        super()._settle_at_agreed(*arguments)

    def measure(self, *arguments):
        super().measure(*arguments)
        if hasattr(self, "C"):
            self.forget_what_starts_anew()
        elif self.m.counters[memory.NOW] >= self.anchor:
            self.keep()


@pytest.fixture(autouse=True)
def short_stretches(monkeypatch):
    monkeypatch.setattr(smoother, "STRETCH", 70)


def fixed_point(monkeypatch, problem, options, anchor):
    """Return what the plain filter says in the end of its state at the first measurement from anchor on."""
    made = []

    def make(floats, integers):
        made.append(FixedPoint(floats, integers))
        made[-1].anchor = anchor
        return made[-1]

    monkeypatch.setattr(reference_filter, "ReferenceFilter", make)
    result = run(reference_filter.run_log, problem, options)
    return made[0], result


def assert_smoothed_like_fixed_point(monkeypatch, problem, options, share):
    compiled = run(filter_loop.run_log, problem, options)
    used = np.flatnonzero(compiled.decisions)
    anchor = int(problem.measurements.stamps_ns[used[int(share * len(used))]])
    kept, plain = fixed_point(monkeypatch, problem, options, anchor)
    np.testing.assert_array_equal(plain.decisions, compiled.decisions)

    core, covariance = smooth(problem, *memory_of(problem, options))[2:]
    row = int(np.searchsorted(compiled.stamps, kept.stamp))
    np.testing.assert_allclose(kept.x[:EXTRINSIC_ROTATION], compiled.core[row], atol=1e-9)
    core_layout, error = StateLayout(), kept.error[:CORE]
    before = kept.x[: core_layout.n_nominal]
    moved = retract_state(before, error, core_layout)
    np.testing.assert_allclose(core[row], moved[:EXTRINSIC_ROTATION], rtol=1e-7, atol=1e-8)
    G = transport(before, moved, error, core_layout)
    P = G @ kept.P[:CORE, :CORE] @ G.T
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(covariance[row] / np.outer(scale, scale), P / np.outer(scale, scale), rtol=0, atol=1e-6)
    assert np.all(scale < 1.0001 * compiled.sigma[row])
    assert np.linalg.norm(error[3:6]) > 1e-5  # there was something to smooth
    return kept


@pytest.mark.parametrize("layout", ["no biases", "extrinsics and gravity", "time offset", "objects", "everything"])
def test_smoothed_is_the_fixed_point_smoother(monkeypatch, layout):
    problem = simulated(layout=LAYOUTS[layout], noise="network", duration_s=5.0)
    assert_smoothed_like_fixed_point(monkeypatch, problem, FuseOptions(), 0.4)


def test_smoothed_is_the_fixed_point_smoother_through_forgotten_biases(monkeypatch):
    options = FuseOptions(bias=DetectionBias(jump_after=2))
    network = NetworkErrors(gross_share=0.3, gross_run_s=0.5)
    problem = simulated(options=options, noise="network", network=network, duration_s=5.0, camera_rate_hz=20.0)
    kept = assert_smoothed_like_fixed_point(monkeypatch, problem, options, 0.2)
    assert kept.started_anew > 0


def test_smoothed_is_the_fixed_point_smoother_through_a_restart(monkeypatch):
    options = FuseOptions(measurements="camera")
    options = replace(options, start=replace(options.start, lost_window_s=0.8, lost_min_votes=6))
    problem = simulated("camera", options=options, duration_s=8.0)
    measured, moved = problem.measurements, problem.measurements.translations.copy()
    moved[len(moved) // 2 :] += [1.0, 0.5, 0.0]
    problem = replace(problem, measurements=replace(measured, translations=moved))
    kept = assert_smoothed_like_fixed_point(monkeypatch, problem, options, 0.2)
    assert kept.m.counters[memory.RESTARTS] > 0


def test_smoothed_is_the_fixed_point_smoother_on_an_unknown_map(monkeypatch):
    options = FuseOptions(estimate=Estimate(map="unknown"), noise=DetectionNoise(rotation_deg=2.0))
    problem = simulated(
        noise="white", options=options, covariances=False, symmetric_objects=0, duration_s=5.0, camera_rate_hz=8.0
    )
    assert_smoothed_like_fixed_point(monkeypatch, problem, options, 0.0)


@pytest.mark.parametrize("motion", ["odometry", "constant-velocity", "imu+odometry"])
def test_smoothed_is_the_fixed_point_smoother_on_other_motion(monkeypatch, motion):
    options = FuseOptions(motion=motion)
    problem = simulated(noise="network", options=options, odometry=True, duration_s=5.0)
    assert_smoothed_like_fixed_point(monkeypatch, problem, options, 0.4)


class BatchLeastSquares:
    """Every state of a log at once: a prior of the first, each IMU step and each pose as a residual.

    Gauss-Newton on the manifold with the plain models and no recursion: its optimum is what a smoother returns where
    the problem is linear and Gaussian.
    """

    def __init__(self, problem, options, prior_x, prior_P, start_ns):
        self.noise = memory.views.py_func(*memory_of(problem, options)).noise
        self.layout, imu, measured = problem.layout, problem.imu, problem.measurements
        later = imu.stamps_ns[imu.stamps_ns > start_ns]
        inside = (measured.stamps_ns > start_ns) & (measured.stamps_ns <= later[-1])
        columns = (measured.kinds, measured.objects, measured.rotations, measured.translations, measured.covariances)
        self.stamps = np.unique(np.r_[start_ns, later, measured.stamps_ns[inside]])
        self.poses = [c[inside] for c in (np.searchsorted(self.stamps, measured.stamps_ns), *columns)]
        rows = imu_rows(imu)
        values, self.samples = rows[:, :6], rows[np.searchsorted(imu.stamps_ns, self.stamps[1:])]
        samples, at = (imu.stamps_ns - start_ns) * 1e-9, (self.stamps - start_ns) * 1e-9
        self.steps = np.diff(at)
        self.values = np.stack([np.interp(0.5 * (at[1:] + at[:-1]), samples, c) for c in values.T], axis=1)
        self.rates = np.stack([np.interp(at, samples, c) for c in values.T[:3]], axis=1)
        self.prior_x, self.prior_P = prior_x, prior_P
        self.states = [prior_x]
        for dt, value in zip(self.steps, self.values):
            self.states.append(transition(self.states[-1], dt, value[:3], value[3:], self.layout)[0])

    def residuals(self):
        """Yield (covariance, residual, {state number: Jacobian}) with residual(x (+) d) = residual - sum of J d."""
        n, x = self.layout.n_error, self.states
        yield self.prior_P, local_state(x[0], self.prior_x, self.layout), {0: np.eye(n)}
        for i, (dt, value, sample) in enumerate(zip(self.steps, self.values, self.samples)):
            moved, F = transition(x[i], dt, value[:3], value[3:], self.layout)
            step = local_state(x[i + 1], moved, self.layout)
            yield process_noise(n, dt, dt, self.noise, sample), step, {i: -F, i + 1: np.eye(n)}
        for i, kind, k, R_m, t_m, R in zip(*self.poses):
            rate = self.rates[i] - x[i][GYRO_BIAS : GYRO_BIAS + 3]
            r, H = residual_and_jacobian(int(kind), int(k), R_m.reshape(3, 3), t_m, x[i], rate, 0.0, self.layout)
            yield R, r, {i: H}

    def step(self):
        """Take one step of Gauss-Newton; return its largest component in units of 1-sigma."""
        n, count = self.layout.n_error, len(self.stamps)
        blocks, gradient = [[None] * count for _ in range(count)], np.zeros((count, n))
        for covariance, r, jacobians in self.residuals():
            W = np.linalg.inv(np.linalg.cholesky(covariance))
            for i, J in jacobians.items():
                gradient[i] += (W @ J).T @ (W @ r)
                for j, K in jacobians.items():
                    block = (W @ J).T @ (W @ K)
                    blocks[i][j] = block if blocks[i][j] is None else blocks[i][j] + block
        self.solver = splu(csc_matrix(bmat(blocks)))
        moves = self.solver.solve(gradient.ravel()).reshape(count, n)
        self.states = [retract_state(x, d, self.layout) for x, d in zip(self.states, moves)]
        return max(np.max(np.abs(moves[i]) / self.sigma(i)) for i in range(0, count, 20))

    def sigma(self, i):
        n = self.layout.n_error
        unit = np.zeros((n * len(self.stamps), n))
        unit[i * n : (i + 1) * n] = np.eye(n)
        return np.sqrt(np.diag(self.solver.solve(unit)[i * n : (i + 1) * n]))


@pytest.mark.parametrize("measurements", ["camera", "objects"])
def test_smoothed_is_batch_least_squares_where_the_problem_is_linear(measurements):
    believing = Gate(probability=1.0, adaptation=0.0)
    options = FuseOptions(measurements=measurements, gate=believing, bias=DetectionBias(use=False))
    problem = simulated(
        measurements,
        options=options,
        duration_s=4.0,
        symmetric_objects=0,
        noise="white",
        white=WhiteErrors(across_m=0.0003, along_of_depth=0.0005, rotation_deg=0.1),
        camera_pose_position_sigma_m=0.001,
        camera_pose_rotation_sigma_deg=0.1,
    )
    # Both begin from the filter's own state after some time: its errors are small by then.
    floats, integers = memory_of(problem, options)
    cut = 250
    buffers = smoother.loop_columns(problem)
    filter_loop.run_part(floats, integers, *buffers, 0, cut, 0, 0)
    m = memory.views.py_func(floats, integers)
    assert m.counters[memory.MODE] == memory.TRACKING
    batch = BatchLeastSquares(problem, options, m.x.copy(), m.P.copy(), int(m.counters[memory.NOW]))
    steps = [batch.step() for _ in range(3)]
    assert steps[-1] < 1e-3

    smoothed = run_smoother(problem, options)
    causal = run_filter(problem, options)
    for i in range(0, len(batch.stamps), 13):
        row, x, sigma = int(np.searchsorted(smoothed.stamps_ns, batch.stamps[i])), batch.states[i], batch.sigma(i)
        assert smoothed.stamps_ns[row] == batch.stamps[i]
        found = x.copy()
        found[:9] = smoothed.T_world_imu.rotation[row].as_matrix().ravel()
        found[9:12], found[12:15] = smoothed.T_world_imu.translation[row], smoothed.velocity[row]
        found[15:18], found[18:21] = smoothed.gyroscope_bias[row], smoothed.accelerometer_bias[row]
        assert np.max(np.abs(local_state(x, found, batch.layout)) / sigma) < 0.01
        np.testing.assert_allclose(smoothed.sigmas[row], sigma, rtol=0.005)
        assert np.all(sigma < 1.005 * causal.sigmas[row])


def test_smoothing_lowers_the_error_and_stays_consistent():
    options, causal_error, smoothed_error, nees = FuseOptions(measurements="camera"), [], [], []
    for seed in range(6):
        log, _ = simulate_with_truth(SimulationOptions(duration_s=15.0, camera_poses=True, seed=seed, objects=1))
        problem = pose_problem(log, options)
        smoothed, causal = run_smoother(problem, options), run_filter(problem, options)
        np.testing.assert_array_equal(smoothed.stamps_ns, causal.stamps_ns)
        np.testing.assert_array_equal(smoothed.gate.position_accepted, causal.gate.position_accepted)
        truth, valid = log.T_world_imu.interpolate(smoothed.stamps_ns)
        assert valid.all()
        for errors, result in ((causal_error, causal), (smoothed_error, smoothed)):
            turned = (result.T_world_imu.rotation.inv() * truth.rotation).magnitude()
            errors.append(
                [np.sum((result.T_world_imu.translation - truth.translation) ** 2, axis=1).mean(), np.mean(turned**2)]
            )
        nees.append(np.mean(pose_nees(smoothed.T_world_imu, truth, smoothed.pose_covariances)))
    causal_rmse, smoothed_rmse = (np.sqrt(np.mean(errors, axis=0)) for errors in (causal_error, smoothed_error))
    assert np.all(smoothed_rmse < 0.6 * causal_rmse)
    # Six logs of 15 s with errors that stay correlated for some seconds: some 6 x 6 x 4 independent squares.
    assert 0.7 < np.mean(nees) < 1.35


def test_smoothed_results_are_named_apart_and_are_the_same_in_any_stretches(monkeypatch):
    problem, options = simulated("camera"), FuseOptions(measurements="camera")
    short = run_smoother(problem, options)
    monkeypatch.setattr(smoother, "STRETCH", 100_000)
    whole = run_smoother(problem, options)
    assert short.name == whole.name == "fuse/eskf-smoothed/camera"
    np.testing.assert_allclose(short.T_world_imu.translation, whole.T_world_imu.translation, rtol=0, atol=1e-12)
    np.testing.assert_allclose(short.sigmas, whole.sigmas, rtol=1e-9)
    last = run_filter(problem, options)
    np.testing.assert_allclose(short.T_world_imu.translation[-1], last.T_world_imu.translation[-1], atol=1e-12)
    np.testing.assert_allclose(short.pose_covariances[-1], last.pose_covariances[-1], rtol=1e-9, atol=1e-18)


def test_the_stage_smooths_where_asked_to():
    log = simulate(SimulationOptions(duration_s=4.0, camera_poses=True, objects=1))
    smoothed = fuse(log, FuseOptions(measurements="camera", smooth=True))
    assert smoothed.name == "fuse/eskf-smoothed/camera"
    with pytest.raises(InputError, match="eskf"):
        fuse(log, FuseOptions(measurements="camera", estimator="graph", smooth=True))


def test_a_filter_that_never_starts_says_so():
    problem = simulated("camera")
    measured = problem.measurements
    problem = replace(problem, measurements=replace(measured, stamps_ns=measured.stamps_ns + 10**12))
    with pytest.raises(InputError, match="never started"):
        run_smoother(problem, FuseOptions(measurements="camera"))
