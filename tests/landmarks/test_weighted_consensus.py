"""The weighted consensus against scipy's least squares, its covariance against Monte Carlo, its memory by cases."""

from __future__ import annotations

import numpy as np
import pytest
from per_frame_solver import residual
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors

from landmarks.camera_pose import CameraPoseEstimates, Memory, SolverOptions, solve
from poet_loc.core.geometry import make_pose, retract
from poet_loc.core.records import Landmark, LandmarkMap, ObjectPoses, Symmetry
from poet_loc.core.trajectory import Trajectory

NO_MEMORY = Memory(evidence_s=0.0)
CAN = Symmetry((0.0, 0.0, 1.0), "continuous")


def detection_covariance(rng: np.random.Generator) -> np.ndarray:
    """Correlated, unequal, about 1 degree and 1 cm."""
    root = rng.standard_normal((6, 6)) * np.repeat([0.01, 0.006], 3)[:, None]
    return root @ root.T + np.diag(np.repeat([0.01, 0.005], 3) ** 2)


def pose_errors(estimates: CameraPoseEstimates, truth: Trajectory) -> np.ndarray:
    """[e_r, e_t] with R = R_true Exp(e_r), t = t_true + e_t, (F, 6)."""
    T, T_true = estimates.camera_poses.T_world_cam, truth.T_world_body
    turned = (T_true.rotation.inv() * T.rotation).as_rotvec()
    return np.hstack([turned, T.translation - T_true.translation])


def nees(estimates: CameraPoseEstimates, truth: Trajectory) -> float:
    e = pose_errors(estimates, truth)
    return float(np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(estimates.camera_poses.covariances), e)) / 6.0)


def same_view(frames: int) -> Trajectory:
    """The same camera pose again and again: every frame is a draw of the same experiment."""
    one = fly_around(np.random.default_rng(0), 1)
    stamps = one.stamps_ns[0] + np.arange(frames, dtype=np.int64) * 33_333_333
    return Trajectory(stamps, one.T_world_body[np.zeros(frames, np.intp)])


def drawn(rng: np.random.Generator, covariance: np.ndarray, frames: int) -> np.ndarray:
    """(F, L, 6) errors with the covariances (L, 6, 6)."""
    roots = np.linalg.cholesky(covariance)
    return np.einsum("lij,flj->fli", roots, rng.standard_normal((frames, len(covariance), 6)))


def test_the_result_minimises_the_robust_loss() -> None:
    rng = np.random.default_rng(1)
    landmarks, truth = make_map(rng, range(4)), fly_around(rng, 10)
    covariances = np.array([[detection_covariance(rng) for _ in range(4)] for _ in range(10)])
    errors = small_errors(rng, 10, 4)
    errors[::2, 3] = gross_errors(rng, 5)
    poses = detect(truth, landmarks, errors, covariances=covariances)
    found = solve(poses, landmarks, SolverOptions(memory=NO_MEMORY)).camera_poses.T_world_cam
    gate = chi2.ppf(0.99, 6)
    roots = np.linalg.cholesky(np.linalg.inv(covariances + 1e-12 * np.eye(6)))

    for frame in range(10):

        def weighted(change: np.ndarray, frame: int = frame) -> np.ndarray:
            # squares sum to the loss of Geman and McClure: sum of gate m / (gate + m)
            pose, rows = retract(found[frame], change), []
            for place, landmark in enumerate(landmarks):
                e = roots[frame, place].T @ residual(pose, landmark.T_world_obj, poses.T_cam_obj[4 * frame + place])
                rows.append(np.sqrt(gate / (gate + e @ e)) * e)
            return np.concatenate(rows)

        best = least_squares(weighted, 0.003 * rng.standard_normal(6), x_scale=0.01, xtol=1e-12, ftol=1e-12, gtol=1e-12)
        np.testing.assert_allclose(best.x, 0.0, atol=1e-5)


@pytest.mark.parametrize("objects", [1, 2, 4])
def test_covariance_by_monte_carlo(objects: int) -> None:
    rng = np.random.default_rng(2)
    frames, landmarks, truth = 4000, make_map(rng, range(objects)), same_view(4000)
    covariance = np.array([detection_covariance(rng) for _ in range(objects)])
    poses = detect(truth, landmarks, drawn(rng, covariance, frames), covariances=np.tile(covariance, (frames, 1, 1, 1)))
    estimates = solve(poses, landmarks, SolverOptions(memory=NO_MEMORY))
    e = pose_errors(estimates, truth)
    reported, sample = estimates.camera_poses.covariances.mean(axis=0), e.T @ e / frames
    whiten = np.linalg.inv(np.linalg.cholesky(sample))
    np.testing.assert_allclose(np.linalg.eigvalsh(whiten @ reported @ whiten.T), 1.0, atol=0.12)
    assert nees(estimates, truth) == pytest.approx(1.0, abs=0.07)


@pytest.mark.parametrize("mode", ["all", "out", "prev"])
def test_covariance_of_the_means_by_monte_carlo(mode: str) -> None:
    rng = np.random.default_rng(3)
    frames, landmarks, truth = 3000, make_map(rng, range(3)), same_view(3000)
    covariance = np.array([detection_covariance(rng) for _ in range(3)])
    poses = detect(truth, landmarks, drawn(rng, covariance, frames), covariances=np.tile(covariance, (frames, 1, 1, 1)))
    estimates = solve(poses, landmarks, SolverOptions(mode=mode, distance=1.0, angle_deg=90.0))
    assert nees(estimates, truth) == pytest.approx(1.0, abs=0.06)


def drawn_landmark(true: Landmark, sigma: np.ndarray, rng: np.random.Generator) -> Landmark:
    pose = retract(true.T_world_obj, -sigma * rng.standard_normal(6))
    return Landmark(true.object_id, pose, covariance=np.diag(sigma**2))


def test_uncertain_landmarks_make_uncertain_poses() -> None:
    """Maps drawn from the landmarks' covariances, exact detections."""
    rng = np.random.default_rng(4)
    sigma = np.repeat([np.radians(1.0), 0.01], 3) * rng.uniform(0.5, 2.0, 6)
    true_map, truth = make_map(rng, range(3)), fly_around(rng, 1)
    squares = []
    for _ in range(250):
        believed = LandmarkMap(tuple(drawn_landmark(each, sigma, rng) for each in true_map))
        poses = detect(truth, true_map, covariances=np.tile(1e-10 * np.eye(6), (1, 3, 1, 1)))
        squares.append(nees(solve(poses, believed, SolverOptions(memory=NO_MEMORY)), truth))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


def test_precise_detections_weigh_more() -> None:
    rng = np.random.default_rng(5)
    frames, landmarks, truth = 500, make_map(rng, range(2)), same_view(500)
    covariance = np.array([np.diag(np.repeat([0.002, 0.002], 3) ** 2), np.diag(np.repeat([0.06, 0.06], 3) ** 2)])
    errors = drawn(rng, covariance, frames)
    poses = detect(truth, landmarks, errors, covariances=np.tile(covariance, (frames, 1, 1, 1)))
    rmse = {}
    for mode in ("all", "robust"):
        e = pose_errors(solve(poses, landmarks, SolverOptions(mode=mode, memory=NO_MEMORY)), truth)
        rmse[mode] = np.sqrt(np.mean(e[:, 3:] ** 2))
    assert rmse["robust"] < 0.2 * rmse["all"]


def test_rows_without_a_covariance_get_the_law_of_the_options() -> None:
    rng = np.random.default_rng(6)
    landmarks, truth = make_map(rng, range(2)), fly_around(rng, 3)
    covariances = np.tile(detection_covariance(rng), (3, 2, 1, 1))
    covariances[:, 1] = np.nan
    poses = detect(truth, landmarks, covariances=covariances)
    plain = detect(truth, landmarks)

    def of(poses: ObjectPoses, place: int) -> np.ndarray:
        alone = poses[poses.object_ids == place]
        return solve(alone, landmarks).camera_poses.covariances

    np.testing.assert_allclose(of(poses, 1), of(plain, 1))
    assert not np.allclose(of(poses, 0), of(plain, 0))


def test_noise_lies_along_the_ray() -> None:
    """One object straight ahead at 2 m."""
    landmarks = LandmarkMap((Landmark(1, make_pose(Rotation.identity(), np.zeros(3))),))
    truth = Trajectory(np.array([0]), make_pose(Rotation.identity(), np.zeros((1, 3)) - [[0.0, 0.0, 2.0]]))
    options = SolverOptions()
    covariance = solve(detect(truth, landmarks), landmarks, options).camera_poses.covariances[0]
    across, along = 2.0 * options.noise.across, 2.0 * options.noise.along
    angle = np.radians(options.noise.rotation_deg)
    np.testing.assert_allclose(np.diag(covariance)[:3], angle**2, rtol=1e-6)
    least = options.noise.least**2
    expected = [across**2 + (2.0 * angle) ** 2 + least, across**2 + (2.0 * angle) ** 2 + least, along**2 + least]
    np.testing.assert_allclose(np.diag(covariance)[3:], expected, rtol=1e-6)
    # turned about y by a, the camera at lever 2 m in front moves by 2 a along x
    assert covariance[1, 3] ** 2 == pytest.approx((2.0 * angle**2) ** 2, rel=1e-6)


def test_the_spin_of_a_round_object_says_nothing() -> None:
    rng = np.random.default_rng(7)
    landmarks, truth = make_map(rng, [1, 2], {1: CAN}), fly_around(rng, 100)
    clean = detect(truth, landmarks, small_errors(rng, 100, 2))
    spin = np.zeros((200, 3))
    spin[1::2, 2] = rng.uniform(-3, 3, 100)
    T_cam_obj = make_pose(clean.T_cam_obj.rotation * Rotation.from_rotvec(spin), clean.T_cam_obj.translation)
    spun = ObjectPoses(**{**vars(clean), "T_cam_obj": T_cam_obj})
    options = SolverOptions(memory=NO_MEMORY)
    one, other = solve(clean, landmarks, options), solve(spun, landmarks, options)
    np.testing.assert_allclose(
        other.camera_poses.T_world_cam.translation, one.camera_poses.T_world_cam.translation, atol=2e-4
    )
    alone = solve(spun[spun.object_ids == 2], landmarks, options)
    sigma = np.sqrt(np.linalg.eigvalsh(alone.camera_poses.covariances[:, :3, :3]))
    assert sigma[:, 2].min() > 1.0  # rad: about the axis it does not know
    assert sigma[:, 1].max() < 0.1


def test_disagreement_beyond_the_covariances_shows_in_the_covariance() -> None:
    rng = np.random.default_rng(8)
    landmarks, truth = make_map(rng, range(5)), fly_around(rng, 200)
    errors = small_errors(rng, 200, 5)
    sure = np.tile(np.diag(np.repeat([np.radians(1.0), 0.004], 3) ** 2), (200, 5, 1, 1))  # half of the truth
    estimates = solve(detect(truth, landmarks, errors, covariances=sure), landmarks)
    trusting = solve(detect(truth, landmarks, 0.1 * errors, covariances=sure), landmarks)
    ratio = estimates.camera_poses.covariances[:, 3, 3] / trusting.camera_poses.covariances[:, 3, 3]
    assert np.median(ratio) > 1.7


def test_a_gross_error_of_a_lone_object_is_held_over_and_said_so() -> None:
    rng = np.random.default_rng(9)
    landmarks, truth = make_map(rng, [1]), fly_around(rng, 120)
    errors = small_errors(rng, 120, 1, 0.2)
    errors[60:75, 0] = gross_errors(rng, 15)
    estimates = solve(detect(truth, landmarks, errors), landmarks)
    e = np.linalg.norm(pose_errors(estimates, truth)[:, 3:], axis=1)
    np.testing.assert_array_equal(estimates.held[60:75], True)
    assert estimates.held.mean() < 0.2
    np.testing.assert_array_equal(estimates.voted, ~estimates.held)
    assert e.max() < 0.3  # the camera moved 0.15 m in those half seconds
    sigma = np.sqrt(estimates.camera_poses.covariances[60:75, 3, 3])
    assert np.all(np.diff(sigma) > 0.0)


def test_what_stays_is_believed_in_the_end() -> None:
    """After hold_s a lone object that says something else for good is right."""
    rng = np.random.default_rng(10)
    landmarks, truth = make_map(rng, [1]), fly_around(rng, 300)
    errors = small_errors(rng, 300, 1, 0.2)
    errors[:90, 0] += gross_errors(rng, 1)  # wrong and steady from the start
    estimates = solve(detect(truth, landmarks, errors), landmarks)
    e = np.linalg.norm(pose_errors(estimates, truth)[:, 3:], axis=1)
    hold = Memory().hold_s
    after = truth.stamps_ns > truth.stamps_ns[90] + int((hold + 0.1) * 1e9)
    assert e[after].max() < 0.1


def test_without_memory_every_frame_stands_alone() -> None:
    rng = np.random.default_rng(11)
    landmarks, truth = make_map(rng, range(3)), fly_around(rng, 40)
    errors = small_errors(rng, 40, 3)
    errors[::4, 0] = gross_errors(rng, 10)
    poses = detect(truth, landmarks, errors)
    options = SolverOptions(memory=NO_MEMORY)
    together = solve(poses, landmarks, options).camera_poses.T_world_cam
    for frame in range(40):
        alone = solve(poses[poses.frames == frame], landmarks, options).camera_poses.T_world_cam
        np.testing.assert_allclose(together[frame].as_matrix(), alone[0].as_matrix(), atol=1e-12)
