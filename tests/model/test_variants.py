"""The embedded network's variants against closed forms and scipy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.nn import functional as F

from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import QueryContext
from poet_loc.model.position_encoding import box_code
from poet_loc.model.queries import stack_queries
from poet_loc.model.variants import (
    ROI_CELLS,
    RoiQueryFeatures,
    box_grid,
    egocentric_rotation,
    ray_rotation,
    translation_along_ray,
)


def test_ray_rotation_is_the_smallest_one_to_the_ray():
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(50, 3)) * [1, 1, 0.5] + [0, 0, 0.6]
    found = ray_rotation(torch.from_numpy(rays)).numpy()
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(found[:, :, 2], directions, atol=1e-12)
    axis = np.cross([0, 0, 1.0], directions)
    angle = np.arccos(directions[:, 2])
    expected = Rotation.from_rotvec(axis / np.linalg.norm(axis, axis=1, keepdims=True) * angle[:, None])
    np.testing.assert_allclose(found, expected.as_matrix(), atol=1e-9)


def test_an_object_that_moves_about_the_camera_keeps_its_allocentric_rotation():
    """Turning camera and ray together leaves what the camera sees along the ray as it was."""
    allocentric = torch.from_numpy(Rotation.random(1, rng=np.random.default_rng(1)).as_matrix())
    ahead = egocentric_rotation(allocentric, torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64))
    torch.testing.assert_close(ahead, allocentric)
    turn = torch.from_numpy(Rotation.from_euler("y", 30, degrees=True).as_matrix())
    aside = egocentric_rotation(allocentric, (turn @ torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))[None])
    torch.testing.assert_close(aside[0], turn @ allocentric[0])


def test_a_sphere_is_put_where_its_box_says():
    """A thing of 0.2 m whose box has that diagonal, with zero numbers, lies at its depth on the box's ray."""
    intrinsics = torch.tensor([[400.0, 410.0, 159.5, 119.5]], dtype=torch.float64)
    t = np.array([0.1, -0.05, 0.9])
    side = 0.2 / np.sqrt(2)
    centre = np.array([400 * t[0] / t[2] + 159.5 + 0.5, 410 * t[1] / t[2] + 119.5 + 0.5])
    size = np.array([400 * side / t[2], 410 * side / t[2]])
    box = torch.from_numpy(np.concatenate([centre / [320, 240], size / [320, 240]]))[None, None]
    context = QueryContext(box, torch.ones(1, 1, dtype=torch.int64), (240, 320), intrinsics)
    zero = torch.zeros(1, 1, 3, dtype=torch.float64)
    np.testing.assert_allclose(translation_along_ray(zero, context)[0, 0], t, atol=1e-12)
    moved = translation_along_ray(torch.tensor([[[0.5, 0.0, np.log(2.0)]]]), context)[0, 0]
    assert float(moved[2]) == pytest.approx(1.8)
    assert float(moved[0] / moved[2]) == pytest.approx(t[0] / t[2] + 0.5 * size[0] / 400)


def test_translation_without_intrinsics_is_refused():
    context = QueryContext(torch.rand(1, 1, 4), torch.ones(1, 1, dtype=torch.int64), (240, 320), None)
    with pytest.raises(ValueError, match="intrinsics"):
        translation_along_ray(torch.zeros(1, 1, 3), context)


def test_box_grid_reads_the_cells_of_a_box():
    image = torch.arange(16 * 24, dtype=torch.float32).reshape(1, 1, 16, 24)
    left, top, cells = 4, 6, ROI_CELLS
    box = torch.tensor([[[(left + cells / 2) / 24, (top + cells / 2) / 16, cells / 24, cells / 16]]])
    read = F.grid_sample(image, box_grid(box, cells)[:, 0], align_corners=False)
    torch.testing.assert_close(read[0, 0], image[0, 0, top : top + cells, left : left + cells])


def test_roi_features_depend_on_their_own_box_and_class_alone():
    options = NetworkOptions(hidden_dim=32, heads=4, levels=2, map_channels=(5, 7), map_strides=(8, 16), class_count=3)
    torch.manual_seed(0)
    features = RoiQueryFeatures(options, width=8, hidden=16)
    maps = (torch.randn(2, 5, 12, 16), torch.randn(2, 7, 6, 8))
    boxes = torch.rand(2, 3, 4) * 0.3 + 0.2
    labels = torch.tensor([[1, 2, 3], [2, 2, 1]])
    queries = stack_queries(list(boxes), list(labels), 5)
    out = features(maps, queries)
    assert out.shape == (2, 5, 32)
    single = features(tuple(m[1:] for m in maps), stack_queries([boxes[1, 1:2]], [labels[1, 1:2]], 1))
    torch.testing.assert_close(single[0, 0], out[1, 1], atol=1e-5, rtol=1e-4)
    other = features(maps, stack_queries(list(boxes), list(labels.flip(1)), 5))
    assert (other[0, 0] - out[0, 0]).abs().max() > 0.1


def test_fewer_octaves_leave_the_upper_channels_out_and_the_lower_as_they_are():
    boxes = torch.rand(5, 4)
    whole = box_code(boxes, 128).unflatten(-1, (4, 2, 16))
    part = box_code(boxes, 128, octaves=5).unflatten(-1, (4, 2, 16))
    torch.testing.assert_close(part[..., :5], whole[..., :5])
    assert float(part[..., 5:].abs().max()) == 0.0
    nearly = box_code(boxes * (1 + 1e-5), 128, octaves=5).unflatten(-1, (4, 2, 16))
    assert float((nearly - part).abs().max()) < 1e-3  # a last digit no longer matters
