"""What is said to be looked at is what decides: changing anything else changes nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poet_loc.detect.attention_overlay import draw_attention
from poet_loc.model.attention_points import attend
from poet_loc.model.backbone import ImageBatch
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.queries import stack_queries
from poet_loc.model.small_detector import SmallDetector, SmallDetectorOptions

SMALL = SmallDetectorOptions(class_count=3, widths=(8, 8, 16, 16), blocks=(0, 0, 0, 0), pyramid_dim=12)
OPTIONS = NetworkOptions(
    32, 4, 1, 2, 32, levels=3, map_channels=(16, 16, 16), class_count=3, queries=2, reference_spread="box"
)


def image(count: int = 1) -> ImageBatch:
    torch.manual_seed(0)
    return ImageBatch(torch.rand(count, 3, 64, 96), torch.zeros(count, 64, 96, dtype=torch.bool))


@pytest.fixture(scope="module")
def network() -> PoET:
    torch.manual_seed(1)
    return PoET(OPTIONS, SmallDetector(SMALL)).eval()


def queries():
    return stack_queries([torch.tensor([[0.5, 0.5, 0.25, 0.5]])], [torch.tensor([2])], 2)


def test_poses_are_those_of_the_network_and_weights_add_up(network):
    output, attention = attend(network, image(), queries())
    torch.testing.assert_close(output.translation, network(image(), queries()).translation)
    heads, levels, points = OPTIONS.heads, OPTIONS.levels, OPTIONS.decoder_points
    assert attention.points.shape == (2, 2, heads * levels * points, 2)
    per_head = attention.weights.unflatten(-1, (heads, -1)).sum(-1)
    torch.testing.assert_close(per_head, torch.ones_like(per_head))


def test_a_fresh_network_looks_within_the_box(network):
    _, attention = attend(network, image(), queries())
    found = attention.points[0, 0].numpy()
    low, high = np.array([36.0, 16.0]), np.array([60.0, 48.0])
    assert np.all((found >= low - 1e-3) & (found <= high + 1e-3))
    assert np.ptp(found, axis=0).min() > 10


def test_one_image_at_a_time(network):
    with pytest.raises(ValueError, match="one image"):
        attend(network, image(2), None)


def test_the_overlay_is_brightest_where_the_weight_is():
    canvas = draw_attention(
        np.zeros((20, 30, 3), np.uint8), np.array([[5.0, 10.0], [25.0, 10.0]]), np.array([0.1, 0.9]), 2
    )
    assert canvas.shape == (40, 60, 3)
    assert canvas[20, 50].sum() > 200
    assert canvas[20, 30].sum() == 0
    assert (canvas[:, 40:].sum(-1) > 0).sum() > (canvas[:, :20].sum(-1) > 0).sum() > 0
