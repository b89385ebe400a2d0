"""From flow to pose: derivatives against differences, the solve against dense algebra, known motions found again."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from poet_loc.model.flow_pose import flow_jacobian, rotation_of, solve_flow, step_pose, true_flow
from poet_loc.model.object_views import views_of

PLACES = torch.tensor([[0.05, -0.04, 0.6], [-0.2, 0.1, 0.9]], dtype=torch.float64)
TURNS = torch.from_numpy(Rotation.random(2, random_state=2).as_matrix())
DIAMETERS = torch.tensor([0.2, 0.1], dtype=torch.float64)
POINTS = torch.from_numpy(np.random.default_rng(0).uniform(-0.5, 0.5, (2, 40, 3)))


def flow_after(step: torch.Tensor) -> torch.Tensor:
    views = views_of(PLACES, TURNS, DIAMETERS)
    return true_flow(POINTS, views, *step_pose(step, views, DIAMETERS), DIAMETERS)


def test_the_jacobian_is_the_derivative_of_the_flow():
    jacobian = flow_jacobian(POINTS, views_of(PLACES, TURNS, DIAMETERS))
    for axis in range(6):
        step = torch.zeros(2, 6, dtype=torch.float64)
        step[:, axis] = 1e-5
        numeric = (flow_after(step) - flow_after(-step)) / 2e-5
        torch.testing.assert_close(jacobian[..., axis], numeric, atol=1e-6, rtol=1e-6)


def test_no_step_leaves_the_pose_and_gives_no_flow():
    zero = torch.zeros(2, 6, dtype=torch.float64)
    views = views_of(PLACES, TURNS, DIAMETERS)
    t, R = step_pose(zero, views, DIAMETERS)
    torch.testing.assert_close(t, PLACES)
    torch.testing.assert_close(R, TURNS)
    assert flow_after(zero).abs().max() < 1e-12


def test_the_solution_is_that_of_stacked_least_squares():
    rng = np.random.default_rng(3)
    jacobian = flow_jacobian(POINTS, views_of(PLACES, TURNS, DIAMETERS))
    flow, weight = torch.from_numpy(rng.normal(0, 0.3, (2, 40, 2))), torch.from_numpy(rng.random((2, 40, 2)))
    prior = torch.tensor([1.0, 2.0, 3.0, 0.5, 0.6, 0.7], dtype=torch.float64)
    step, variances = solve_flow(jacobian, flow, weight, prior)
    for k in range(2):
        root = np.sqrt(weight[k].numpy().ravel())
        rows = np.concatenate([jacobian[k].numpy().reshape(-1, 6) * root[:, None], np.diag(np.sqrt(prior.numpy()))])
        values = np.concatenate([flow[k].numpy().ravel() * root, np.zeros(6)])
        np.testing.assert_allclose(step[k], np.linalg.lstsq(rows, values, rcond=None)[0], atol=1e-9)
        np.testing.assert_allclose(variances[k], np.diag(np.linalg.inv(rows.T @ rows)), rtol=1e-8)


def test_true_flow_leads_to_the_true_pose_within_a_few_rounds():
    truth_t = PLACES + torch.tensor([[0.02, -0.01, 0.05], [0.01, 0.01, -0.04]], dtype=torch.float64)
    truth_R = torch.from_numpy(Rotation.from_rotvec([[0.3, -0.2, 0.25], [-0.2, 0.3, 0.1]]).as_matrix()) @ TURNS
    t, R = PLACES, TURNS
    weight, prior = torch.ones(2, 40, 2, dtype=torch.float64), torch.full((6,), 1e-9, dtype=torch.float64)
    for _ in range(6):
        views = views_of(t, R, DIAMETERS)
        flow = true_flow(POINTS, views, truth_t, truth_R, DIAMETERS)
        t, R = step_pose(solve_flow(flow_jacobian(POINTS, views), flow, weight, prior)[0], views, DIAMETERS)
    torch.testing.assert_close(t, truth_t, atol=1e-6, rtol=0)
    torch.testing.assert_close(R, truth_R, atol=1e-6, rtol=0)


def test_cells_without_weight_do_not_count():
    views = views_of(PLACES, TURNS, DIAMETERS)
    jacobian, prior = flow_jacobian(POINTS, views), torch.ones(6, dtype=torch.float64)
    flow, weight = flow_after(torch.full((2, 6), 0.01, dtype=torch.float64)), torch.ones(2, 40, 2, dtype=torch.float64)
    weight[:, 20:] = 0.0
    wild = flow.clone()
    wild[:, 20:] = 1e3
    torch.testing.assert_close(
        solve_flow(jacobian, flow, weight, prior)[0], solve_flow(jacobian, wild, weight, prior)[0]
    )


def test_rotation_vectors_are_scipys():
    vectors = np.concatenate([np.random.default_rng(4).normal(0, 1, (20, 3)), np.zeros((1, 3))])
    np.testing.assert_allclose(
        rotation_of(torch.from_numpy(vectors)), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-6
    )
