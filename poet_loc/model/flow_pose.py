"""The pose change that explains where an object's points moved in its view: weighted least squares, linearised once.

A step is (rotation vector in view axes, rad; shift x and y, diameters; log of the distance's change). Flow is in CELL
pixels of the view.  Source: L. Lipson et al., "Coupled iterative refinement for 6D multi-object pose estimation"
(CVPR 2022), equations 5-7, with a prior on the step in place of damping.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poet_loc.model.object_views import FILL, VIEW, Views

CELL = 4
"""Pixels of the view per cell of the flow."""

_MOST_TURN, _MOST_STRETCH = 1.5, 0.5  # rad and log distance that one step may change


def flow_jacobian(coordinates: Tensor, views: Views) -> Tensor:
    """Return the derivative (K, N, 2, 6) of where object points (K, N, 3) are seen, in cells, by a step."""
    x, y, z = (coordinates @ views.rotation.mT).unbind(-1)
    distance = views.distance[:, None]
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    right = torch.stack([zero, z, -y, one, zero, zero], -1)
    down = torch.stack([-z, zero, x, zero, one, zero], -1)
    away = torch.stack([y, -x, zero, zero, zero, distance.expand_as(x)], -1)
    depth = distance + z
    scale = VIEW * FILL / CELL * distance / depth
    columns = (right - (x / depth)[..., None] * away, down - (y / depth)[..., None] * away)
    return scale[..., None, None] * torch.stack(columns, -2)


def true_flow(coordinates: Tensor, views: Views, translation: Tensor, rotation: Tensor, diameters: Tensor) -> Tensor:
    """Return how far object points (K, N, 3) are seen from where they are at another pose in the camera, in cells."""
    there = coordinates @ (views.ray.mT @ rotation).mT
    there = there + ((views.ray.mT @ translation[..., None])[..., 0] / diameters[:, None])[:, None]
    here = coordinates @ views.rotation.mT
    here_depth = (here[..., 2] + views.distance[:, None])[..., None]
    scale = (VIEW * FILL / CELL * views.distance)[:, None, None]
    return scale * (there[..., :2] / there[..., 2:].clamp(min=0.1) - here[..., :2] / here_depth)


def solve_flow(jacobian: Tensor, flow: Tensor, weight: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Return the step (K, 6) and its variances (K, 6) that explain flow (K, N, 2) of weights (K, N, 2).

    prior (6,) is the information of a step of zero.
    """
    rows, values = jacobian.flatten(1, 2), flow.flatten(1)
    weighted = rows * weight.flatten(1)[..., None]
    information = weighted.mT @ rows + torch.diag(prior)
    root = torch.linalg.cholesky(information)
    step = torch.cholesky_solve(weighted.mT @ values[..., None], root)[..., 0]
    variances = torch.cholesky_inverse(root).diagonal(dim1=1, dim2=2)
    turn, shift, stretch = step[:, :3], step[:, 3:5], step[:, 5:]
    step = torch.cat([turn.clamp(-_MOST_TURN, _MOST_TURN), shift, stretch.clamp(-_MOST_STRETCH, _MOST_STRETCH)], 1)
    return step, variances


def step_pose(step: Tensor, views: Views, diameters: Tensor) -> tuple[Tensor, Tensor]:
    """Return t_cam_obj (K, 3) m and R_cam_obj (K, 3, 3) after a step."""
    depth = views.distance * step[:, 5].exp()
    moved = torch.cat([step[:, 3:5] * (depth / views.distance)[:, None], depth[:, None]], 1) * diameters[:, None]
    return (views.ray @ moved[..., None])[..., 0], views.ray @ rotation_of(step[:, :3]) @ views.rotation


def rotation_of(vector: Tensor) -> Tensor:
    """Return the rotations (K, 3, 3) of rotation vectors (K, 3), rad."""
    angle = vector.square().sum(-1).add(1e-12).sqrt()[:, None, None]
    zero = torch.zeros_like(vector[:, 0])
    x, y, z = vector.unbind(-1)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    skew = torch.stack([torch.stack(row, -1) for row in rows], -2)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + torch.sin(angle) / angle * skew + (1 - torch.cos(angle)) / angle**2 * (skew @ skew)
