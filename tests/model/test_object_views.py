"""Views of single objects: against projection by hand, and against each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from poet_loc.model.object_views import FILL, VIEW, render_points, seen_in_images, views_of

INTRINSICS = torch.tensor([[310.0, 300.0, 158.0, 121.0], [420.0, 410.0, 150.0, 118.0]])
PLACES = torch.tensor([[0.05, -0.04, 0.6], [-0.2, 0.1, 0.9], [0.0, 0.0, 0.5]])
IMAGE = torch.tensor([1, 0, 1])
DIAMETERS = torch.tensor([0.2, 0.1, 0.15])


def turns(count: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix()).float()


def pixel_of(points: torch.Tensor, number: int) -> torch.Tensor:
    """Pixels (N, 2) of points (N, 3) m in camera axes, pixel centres at integers."""
    focal, centre = INTRINSICS[IMAGE[number], :2], INTRINSICS[IMAGE[number], 2:]
    return focal * points[:, :2] / points[:, 2:] + centre


def test_an_image_whose_colours_tell_the_pixel_is_seen_where_rays_say():
    v, u = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    ramp = torch.stack([u / 320, v / 240, torch.ones_like(u)]).expand(2, -1, -1, -1)
    views = views_of(PLACES, turns(3), DIAMETERS)
    seen = seen_in_images(ramp, INTRINSICS, IMAGE, views)
    for number in range(3):
        for row, column in ((5, 9), (31, 32), (60, 20)):
            if seen[number, 2, row, column] < 0.999:  # at the border or outside
                continue
            focal = VIEW * FILL * PLACES[number].norm() / DIAMETERS[number]
            ray = torch.tensor([(column - 31.5) / focal, (row - 31.5) / focal, 1.0])
            expected = pixel_of((views.ray[number] @ ray)[None], number)[0]
            found = seen[number, :2, row, column] * torch.tensor([320.0, 240.0])
            torch.testing.assert_close(found, expected, atol=0.02, rtol=0)


def test_the_origin_is_in_the_middle_and_the_diameter_fills_its_share():
    views = views_of(PLACES, turns(3), DIAMETERS)
    across = torch.stack([views.rotation.mT @ torch.tensor([x, 0.0, 0.0]) for x in (-0.5, 0.0, 0.5)], 1)
    drawn = render_points(across, torch.ones_like(across), views)[:, 6]
    rows, columns = (torch.nonzero(drawn[0])[:, k].float() for k in range(2))
    assert rows.mean() == pytest.approx(31.5, abs=0.6)
    assert columns.max() - columns.min() == pytest.approx(VIEW * FILL + 1, abs=1)


def test_a_drawn_point_lies_where_its_bright_pixel_is_seen():
    rotation = turns(3, 3)
    views = views_of(PLACES, rotation, DIAMETERS)
    for number in range(3):
        point = torch.tensor([[0.3, -0.2, 0.1]])
        pixel = pixel_of(point * DIAMETERS[number] @ rotation[number].T + PLACES[number], number)[0]
        v, u = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
        glow = torch.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / 8.0).expand(2, 3, -1, -1)
        one = type(views)(views.ray[number, None], views.distance[number, None], views.rotation[number, None])
        seen = seen_in_images(glow, INTRINSICS, IMAGE[number, None], one)[0, 0]
        drawn = render_points(point[None], torch.ones(1, 1, 3), one)[0, 6]
        grid = torch.stack(torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij"), -1)
        middles = [(grid * map_[..., None]).sum((0, 1)) / map_.sum() for map_ in (seen, drawn)]
        assert torch.norm(middles[0] - middles[1]) < 0.8
        assert drawn.sum() == 4


def test_the_nearest_point_stays_as_in_a_depth_buffer_by_hand():
    rng = np.random.default_rng(1)
    points = torch.from_numpy(rng.uniform(-0.5, 0.5, (2, 400, 3))).float()
    colours = torch.from_numpy(rng.random((2, 400, 3))).float()
    views = views_of(PLACES[:2], turns(2, 5), DIAMETERS[:2])
    drawn = render_points(points, colours, views)
    differ = 0
    for number in range(2):
        placed = (points[number] @ views.rotation[number].T).double().numpy()
        distance = float(views.distance[number])
        depth = placed[:, 2] + distance
        corner = np.floor(VIEW * FILL * distance * placed[:, :2] / depth[:, None] + 31.5).astype(int)
        nearest = np.full((VIEW, VIEW), -1)
        for k in np.argsort(-depth):
            for dx in (0, 1):
                for dy in (0, 1):
                    x, y = corner[k] + [dx, dy]
                    if 0 <= x < VIEW and 0 <= y < VIEW:
                        nearest[y, x] = k
        assert np.array_equal(drawn[number, 6].numpy() > 0, nearest >= 0)
        expected = colours[number].numpy()[np.maximum(nearest, 0)] * (nearest >= 0)[..., None]
        differ += int((np.abs(drawn[number, :3].numpy().transpose(1, 2, 0) - expected).max(-1) > 1e-6).sum())
    assert differ <= 8  # two points within a step of the buffer's depth
