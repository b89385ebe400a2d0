"""Each factor's Jacobians against central differences on gtsam's manifold, and what it says against the filter's."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filter_runs import LAYOUTS, simulated
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.graph_builder import GraphBuilder
from fusion.graph_factors import Detection, Model, bias_factor, error_at, measurement_factor, robust
from fusion.graph_model import BIAS_COLUMNS, MOTION_SIZE, TURN, bias_step, seen_at
from fusion.graph_motion import MotionChain
from fusion.graph_rows import Between
from fusion.graph_smoother import joint_covariance
from fusion.graph_variables import (
    GRAVITY_KEY,
    Variable,
    block_diagonal,
    imu_bias,
    joint_prior,
    keyframe_variables,
    object_bias_key,
    object_variable,
    pose3,
    static_variables,
)
from fusion.measurements import CAMERA_POSE, OBJECT_POSE
from fusion.memory import views
from fusion.nav_state import (
    EXTRINSIC_ROTATION,
    GRAVITY,
    OBJECT_SIZE,
    OBJECTS,
    TIME_OFFSET,
    StateLayout,
    nominal_state,
    pose_at,
    retract_state,
)
from fusion.options import FuseOptions, Graph
from fusion.prepare import fill_memory
from fusion.reference_models import residual_and_jacobian

QUIET = Graph(kernel="none")
SIZES = {"x": 6, "v": 3, "b": 6, "e": 6, "d": 1, "g": 3, "o": 6, "c": 6}


def random_poses(rng, count):
    return RigidTransform.from_exp_coords(0.4 * rng.normal(size=(count, 6)))


def random_state(rng, layout):
    x = nominal_state(
        layout,
        T_world_imu=random_poses(rng, 1)[0],
        T_imu_cam=random_poses(rng, 1)[0],
        T_world_obj=RigidTransform.from_translation([0.0, 0.0, 2.0]) * random_poses(rng, max(layout.n_objects, 1)),
    )
    x[12:21] = 0.3 * rng.normal(size=9)
    x[TIME_OFFSET] = 0.02 * rng.normal() if layout.time_offset else 0.0
    for k in range(layout.n_objects):
        for kind in range(layout.bias_kinds):
            x[layout.nominal_bias(k, kind)] = 0.05 * rng.normal(size=6)
    return x


def random_detection(rng, kind, moved, rows=(0, 6)):
    A = 0.03 * rng.normal(size=(6, 6))
    motion = np.zeros(MOTION_SIZE)
    motion[TURN : TURN + 9] = np.eye(3).ravel()
    if moved:
        motion[0] = 0.07
        motion[TURN : TURN + 9] = Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix().ravel()
        motion[10:] = 0.1 * rng.normal(size=6)
    return Detection(
        kind,
        1 if kind == OBJECT_POSE else -1,
        rows[0],
        rows[1],
        random_poses(rng, 1)[0].rotation.as_matrix().ravel(),
        np.array([0.1, -0.1, 1.5]) + 0.1 * rng.normal(size=3),
        A @ A.T + 1e-4 * np.eye(6),
        motion,
        rng.normal(size=3),
        moved,
        np.array([0.1, -0.1, 1.5]),
    )


def variables_of(layout, biases):
    objects = [object_variable(layout, k) for k in range(layout.n_objects)] if layout.objects else []
    chains = [Variable(key, range(6), layout.nominal_bias(1, kind).start) for kind, key in enumerate(biases)]
    return keyframe_variables(0, True) + static_variables(layout) + objects + chains


def values_of(variables, x):
    values = gtsam.Values()
    for variable in variables:
        variable.insert(values, x)
    return values


def assert_jacobians(factor, values, step=1e-6, tolerance=2e-6):
    """Hold every block of a factor's whitened Jacobian against central differences on the manifold."""
    A, at = factor.linearize(values).jacobian()[0], 0
    for key in list(factor.keys()):
        size = SIZES[chr(gtsam.Symbol(key).chr())]
        for column in range(size):
            ends = []
            for end in (step, -step):
                move = gtsam.VectorValues()
                move.insert(key, end * np.eye(size)[column])
                ends.append(factor.linearize(values.retract(move)).jacobian()[1])
            numeric = (ends[1] - ends[0]) / (2.0 * step)
            scale = max(1.0, np.abs(A[:, at + column]).max())
            np.testing.assert_allclose(A[:, at + column] / scale, numeric / scale, atol=tolerance)
        at += size
    assert at == A.shape[1]


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("rows", [(0, 6), (3, 3), (0, 3)])
@pytest.mark.parametrize("kind", [CAMERA_POSE, OBJECT_POSE])
@pytest.mark.parametrize("name", LAYOUTS)
def test_a_measurements_jacobians_are_its_derivatives(name, kind, rows, moved):
    layout = LAYOUTS[name]
    rng = np.random.default_rng(len(name) + 7 * moved)
    x = random_state(rng, layout)
    biases = [object_bias_key(i) for i in range(layout.bias_kinds if kind == OBJECT_POSE else 0)]
    detection = random_detection(rng, kind, moved, rows)
    factor = measurement_factor(detection, 0, biases, Model(layout, x.copy(), True, QUIET))
    assert_jacobians(factor, values_of(variables_of(layout, biases), x))


@pytest.mark.parametrize("kind", [CAMERA_POSE, OBJECT_POSE])
def test_a_measurement_at_a_keyframe_says_what_the_filter_says(kind):
    layout, rng = LAYOUTS["everything"], np.random.default_rng(3)
    x, d = random_state(rng, layout), random_detection(rng, kind, False)
    R_m = d.rotation.reshape(3, 3)
    unbiased = x.copy()
    unbiased[layout.nominal_bias(0, 0).start : layout.nominal_bias(layout.n_objects - 1, 1).stop] = 0.0
    away, _ = residual_and_jacobian(kind, d.object, R_m, d.translation, unbiased, d.rate, 0.0, layout)
    d = replace(d, place=d.translation - away[3:])  # there the biases of filter and graph are the same
    residual, _ = residual_and_jacobian(kind, d.object, R_m, d.translation, x, d.rate, 0.0, layout)
    np.testing.assert_allclose(error_at(d, x, layout)[0], -residual, atol=1e-12)
    biases = [object_bias_key(i) for i in range(layout.bias_kinds if kind == OBJECT_POSE else 0)]
    factor = measurement_factor(d, 0, biases, Model(layout, x.copy(), True, QUIET))
    nis = residual @ np.linalg.solve(d.covariance, residual)
    assert factor.error(values_of(variables_of(layout, biases), x)) == pytest.approx(0.5 * nis, rel=1e-9)


def test_biases_act_where_the_object_was_seen_whatever_becomes_of_it():
    """That place is the object in the camera after the motion, and no later step of pose or object changes it."""
    layout, rng = LAYOUTS["everything"], np.random.default_rng(10)
    x, d = random_state(rng, layout), random_detection(rng, OBJECT_POSE, True)
    x[TIME_OFFSET] = 0.0
    at = OBJECTS + OBJECT_SIZE * d.object
    seconds, turn, shift = d.motion[0], d.motion[TURN : TURN + 9].reshape(3, 3), d.motion[TURN + 9 : TURN + 12]
    T_world_imu, T_imu_cam, T_world_obj = pose_at(x, 0), pose_at(x, EXTRINSIC_ROTATION), pose_at(x, at)
    fall = seconds * x[12:15] + 0.5 * seconds**2 * x[GRAVITY : GRAVITY + 3]
    p_wi = T_world_imu.translation + fall + T_world_imu.rotation.apply(shift)
    moved = RigidTransform.from_components(p_wi, T_world_imu.rotation * Rotation.from_matrix(turn))
    place = ((moved * T_imu_cam).inv() * T_world_obj).translation
    np.testing.assert_allclose(seen_at(d.object, d.motion, x), place, atol=1e-12)

    d = replace(d, place=place)
    biased, stretched = error_at(d, x, layout)
    near = retract_state(x, 0.01 * rng.normal(size=layout.n_error), layout)
    columns = slice(BIAS_COLUMNS + 3, BIAS_COLUMNS + 6)
    np.testing.assert_array_equal(error_at(d, near, layout)[1][3:, columns], stretched[3:, columns])
    bias = sum(x[layout.nominal_bias(d.object, kind)][3:] for kind in range(layout.bias_kinds))
    for kind in range(layout.bias_kinds):
        x[layout.nominal_bias(d.object, kind)] = 0.0
    shift = biased[3:] - error_at(d, x, layout)[0][3:]
    px, py, pz = place
    D = np.array([[pz, 0.0, px], [0.0, pz, py], [-px, -py, pz]])
    np.testing.assert_allclose(shift, D @ bias, atol=1e-12)
    np.testing.assert_allclose(stretched[3:, columns], D, atol=1e-12)


def test_a_camera_pose_prior_weighs_like_the_measurement_it_stands_for():
    """gtsam's own prior and the compiled factor agree to first order, in value and in Jacobian."""
    layout, rng = StateLayout(), np.random.default_rng(4)
    x = random_state(rng, layout)
    near = retract_state(x, np.r_[1e-4 * rng.normal(size=6), np.zeros(9)], layout)
    T_world_cam = pose3(near, 0).compose(pose3(near, 21))
    d = replace(
        random_detection(rng, CAMERA_POSE, False),
        rotation=T_world_cam.rotation().matrix().ravel(),
        translation=T_world_cam.translation(),
    )
    model, values = Model(layout, x.copy(), True, QUIET), values_of(keyframe_variables(0, True), x)
    own = measurement_factor(d, 0, [], model)
    assert isinstance(own, gtsam.PriorFactorPose3)
    compiled = measurement_factor(replace(d, moved=True), 0, [], model)
    assert own.error(values) == pytest.approx(compiled.error(values), rel=1e-2)
    A, B = (f.linearize(values).jacobian()[0] for f in (own, compiled))
    pose = slice(0, 6)
    np.testing.assert_allclose(A[:, pose].T @ A[:, pose], (B.T @ B)[pose, pose], rtol=2e-3, atol=1.0)


def test_a_bias_step_is_the_filters_decay():
    rng = np.random.default_rng(5)
    phi, sigma = rng.uniform(0.5, 1.0, 6), rng.uniform(0.1, 1.0, 6)
    first, second = rng.normal(size=6), rng.normal(size=6)
    values = gtsam.Values()
    values.insert(object_bias_key(0), first)
    values.insert(object_bias_key(1), second)
    factor = bias_factor(object_bias_key(0), object_bias_key(1), phi, sigma)
    assert factor.error(values) == pytest.approx(0.5 * np.sum(((second - phi * first) / sigma) ** 2))
    assert_jacobians(factor, values)


@pytest.mark.parametrize("far", [False, True])
def test_bias_steps_compose(far):
    """Two steps are one long step: Gauss-Markov, and for a gross error a random walk of the jump's size."""
    taus = np.array([3.0, 2.0, 1.0])
    model = np.r_[0.1, 0.01, 0.02, taus, 5.0, 4.0]
    mean = np.repeat([0.5 if far else 0.1, 0.001], 3)
    steps = [(np.empty(6), np.empty(6)) for _ in range(3)]
    for (left, sigma), seconds in zip(steps, (0.4, 0.9, 1.3), strict=True):
        bias_step(model, 0, mean, seconds, left, sigma)
    (phi_1, s_1), (phi_2, s_2), (phi, s) = steps
    np.testing.assert_allclose(phi_1 * phi_2, phi)
    if far:
        np.testing.assert_array_equal(phi[:3], 1.0)
        assert np.all(s[:3] > 5.0 * 0.1 * np.sqrt(1.0 - np.exp(-2.6 / 3.0)) * 0.999)
    np.testing.assert_allclose((phi_2 * s_1)[3:] ** 2 + s_2[3:] ** 2, s[3:] ** 2)
    np.testing.assert_allclose(phi[3:], np.exp(-1.3 / taus[[1, 1, 2]]))


def test_the_joint_prior_is_the_filters_gaussian():
    """Its information, carried back to the filter's errors, is the inverse of the filter's covariance."""
    layout = StateLayout(n_objects=1, extrinsics=True, time_offset=True, gravity=True, objects=True)
    rng = np.random.default_rng(6)
    x = random_state(rng, layout)
    n = layout.n_error
    A = (np.eye(n) + 0.2 * rng.normal(size=(n, n))) * 10.0 ** rng.uniform(-3, 0, n)[:, None]
    P = A @ A.T
    variables = keyframe_variables(0, True) + static_variables(layout) + [object_variable(layout, 0)]
    factor, values = joint_prior(variables, x, P), values_of(variables, x)
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    e = 1e-3 * np.linalg.cholesky(P) @ rng.normal(size=len(P))
    moved = retract_state(x, e, layout)
    expected = 0.5 * e @ np.linalg.solve(P, e)
    assert factor.error(values_of(variables, moved)) == pytest.approx(expected, rel=0.02)


def test_a_graph_that_starts_from_a_filter_on_its_way_knows_all_that_it_knows():
    """Object biases that are tied to the rest come in with it; the others begin with what they have of their own."""
    layout, rng = StateLayout(n_objects=2, objects=True, bias_kinds=1), np.random.default_rng(8)
    problem = replace(simulated(), layout=layout)
    x = random_state(rng, layout)
    n, free = layout.n_error, layout.error_slice("biases", 1)
    A = (np.eye(n) + 0.2 * rng.normal(size=(n, n))) * 10.0 ** rng.uniform(-3, 0, n)[:, None]
    A[free], A[:, free] = 0.0, 0.0
    A[free, free] = np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    P = A @ A.T
    builder = GraphBuilder(layout, x, np.zeros(14), MotionChain.of(problem, FuseOptions()), QUIET)
    builder.start(int(problem.imu.stamps_ns[3]), x, P, np.ones(2))
    graph, values, _ = builder.take()
    tree = graph.linearize(values).eliminateMultifrontal(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR)
    variables = builder.newest
    J = block_diagonal([variable.to_filter(x) for variable in variables])
    found = J @ joint_covariance(tree, [variable.key for variable in variables]) @ J.T
    at = [i for variable in variables for i in variable.errors]
    assert sorted(at) == list(range(free.start))
    scale = np.sqrt(np.diag(P)[at])
    np.testing.assert_allclose(found / np.outer(scale, scale), P[np.ix_(at, at)] / np.outer(scale, scale), atol=1e-4)
    assert not builder.chains[1, 0].begun
    np.testing.assert_allclose(builder.chains[1, 0].sigma, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])


def test_robust_noise_bends_where_it_is_told():
    covariance = np.diag([0.04, 0.04, 0.04])
    values = gtsam.Values()
    values.insert(object_bias_key(0), np.zeros(3))
    for kernel, expected in (("none", 0.5 * 75.0), ("huber", None), ("cauchy", 0.5 * 4.0 * np.log1p(75.0 / 4.0))):
        noise = robust(Graph(kernel=kernel, kernel_width=2.0), covariance)
        factor = gtsam.PriorFactorVector(object_bias_key(0), np.ones(3), noise)
        expected = 2.0 * (np.sqrt(75.0) - 1.0) if expected is None else expected
        assert factor.error(values) == pytest.approx(expected)


@pytest.mark.parametrize("gravity", [False, True])
def test_the_imus_link_predicts_what_the_filter_integrates(gravity):
    """A keyframe that starts where the chain predicts has no error, and its Jacobians are its derivatives."""
    options = FuseOptions()
    problem = simulated(layout=StateLayout(n_objects=3, gravity=gravity))
    chain = MotionChain.of(problem, options)
    x = nominal_state(StateLayout(), T_world_imu=random_poses(np.random.default_rng(8), 1)[0])
    x[12:15] = 0.3, -0.2, 0.1
    stamps = problem.imu.stamps_ns
    factor, predicted = chain.link(0, int(stamps[100] + 3_000_000), int(stamps[120] + 5_000_000), x)
    values = values_of(keyframe_variables(0, True), x)
    for variable in keyframe_variables(1, True):
        variable.insert(values, predicted)
    if gravity:
        values.insert(GRAVITY_KEY, x[GRAVITY : GRAVITY + 3])
    error = factor.unwhitenedError(values)
    np.testing.assert_allclose(error[:9], 0.0, atol=3e-5)
    np.testing.assert_allclose(error[9:], 0.0, atol=1e-12)


@pytest.mark.parametrize("gap", [False, True])
def test_the_imus_noise_is_the_filters(gap):
    """Over a tenth of a second, also where a gap is part of it, the graph's noise of the motion is the filter's."""
    options, problem = FuseOptions(), simulated()
    if gap:
        kept = np.r_[0:105, 120 : len(problem.imu)]
        problem = replace(problem, imu=problem.imu[kept])
    chain, stamps = MotionChain.of(problem, options), problem.imu.stamps_ns
    x = nominal_state(StateLayout())
    noise = views.py_func(*fill_memory(problem, options)).noise
    start, end = int(stamps[100]), int(stamps[110])
    _, _, Q = Between(stamps, chain.values, noise, 15).predict(start, x, np.array([end]))
    own = chain.preintegrate(start, end, imu_bias(x), x[GRAVITY : GRAVITY + 3]).preintMeasCov()
    ratio = (
        np.sqrt(np.diag(own)) / np.sqrt(np.diag(Q[0]))[np.r_[0:9, 12:15, 9:12]]
    )  # gtsam's biases: accelerometer first
    np.testing.assert_allclose(ratio, 1.0, atol=0.4 if gap else 0.05)


def test_odometrys_link_is_its_own_motion():
    options = FuseOptions(motion="odometry")
    problem = simulated(options=options, odometry=True)
    chain = MotionChain.of(problem, options)
    x = nominal_state(StateLayout(), T_world_imu=random_poses(np.random.default_rng(9), 1)[0])
    stamps = problem.imu.stamps_ns
    start, end = int(stamps[10] + 1_000_000), int(stamps[16] + 2_000_000)
    factor, predicted = chain.link(0, start, end, x)
    values = values_of(keyframe_variables(0, False), x)
    keyframe_variables(1, False)[0].insert(values, predicted)
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)
    assert_jacobians(factor, values)
    sigma = np.repeat([np.radians(options.odometry.rotation_walk_deg), options.odometry.translation_walk], 3)
    expected = sigma * np.sqrt((end - start) * 1e-9)
    np.testing.assert_allclose(factor.noiseModel().sigmas(), expected)
