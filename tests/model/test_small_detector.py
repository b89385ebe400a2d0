"""The small detector: decoding against hand-made maps, and the backbone's promises."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poet_loc.data.packed import Sample
from poet_loc.model.backbone import Features, ImageBatch
from poet_loc.model.small_detector import DetectorHeads, SmallDetector, SmallDetectorOptions
from poet_loc.train.detector import detector_losses, targets_of

TINY = SmallDetectorOptions(class_count=3, widths=(8, 8, 16, 16), blocks=(0, 1, 0, 1), pyramid_dim=8)


def batch(height: int, width: int, count: int = 1) -> ImageBatch:
    torch.manual_seed(1)
    return ImageBatch(torch.rand(count, 3, height, width), torch.zeros(count, height, width, dtype=torch.bool))


@pytest.mark.parametrize("size", [(240, 320), (96, 64), (64, 80)])
def test_maps_have_the_promised_channels_and_strides(size):
    detector = SmallDetector(TINY).eval()
    shape = detector.shape()
    features = detector.extract(batch(*size))
    assert size[0] % shape.multiple == 0
    for level, channels, stride in zip(features.maps, shape.channels, shape.strides):
        assert level.shape[1:] == (channels, -(-size[0] // stride), -(-size[1] // stride))


def test_batched_equals_single():
    detector = SmallDetector(TINY).eval()
    both = batch(64, 96, 2)
    together = detector.extract(both)
    alone = detector.extract(ImageBatch(both.images[1:], both.mask[1:]))
    for a, b in zip(together.maps, alone.maps):
        torch.testing.assert_close(a[1:], b, atol=1e-5, rtol=1e-4)


def sample_with(boxes: np.ndarray, classes: list[int]) -> Sample:
    count = len(classes)
    surface = np.full((12, 16, 3), np.nan)
    return Sample(
        np.zeros((96, 128, 3), np.uint8), np.array([100.0, 100, 64, 48]), np.array(classes),
        np.tile(np.eye(3), (count, 1, 1)), np.tile([0, 0, 1.0], (count, 1)), boxes, np.ones(count), surface,
        np.arange(count), np.eye(3),
    )  # fmt: skip


BOXES = np.array([[10.0, 20.0, 50.0, 60.0], [70.0, 8.0, 120.0, 90.0], [3.0, 70.0, 33.0, 95.0]])


def perfect_heads() -> tuple[DetectorHeads, object]:
    targets = targets_of([sample_with(BOXES, [1, 3, 2])], (12, 16), 3)
    heat = torch.logit(targets.heat.clamp(1e-4, 1 - 1e-4))
    return DetectorHeads(heat, targets.sides, targets.points, torch.full_like(targets.seen, -9.0)), targets


def test_what_the_targets_say_is_what_detection_reads():
    heads, _ = perfect_heads()
    detector = SmallDetector(TINY)
    (rows,) = detector.detect(Features((), (96, 128), heads))
    order = np.argsort(rows[:, 5].numpy())
    np.testing.assert_array_equal(rows[order, 5], [1, 2, 3])
    np.testing.assert_allclose(rows[order, :4], BOXES[[0, 2, 1]], atol=1e-3)
    assert rows[:, 4].min() > 0.99


def test_perfect_heads_cost_next_to_nothing_and_a_shifted_box_more():
    heads, targets = perfect_heads()
    losses = detector_losses(heads, targets)
    assert float(losses["sides"]) < 1e-5
    assert float(losses["heat"]) < 0.5
    worse = DetectorHeads(heads.heat, heads.sides + 0.2, heads.points, heads.seen)
    assert float(detector_losses(worse, targets)["sides"]) > 0.1


def test_several_instances_of_a_class_where_the_options_allow_it():
    from dataclasses import replace

    targets = targets_of([sample_with(BOXES, [1, 1, 1])], (12, 16), 3)
    heads = DetectorHeads(torch.logit(targets.heat.clamp(1e-4, 1 - 1e-4)), targets.sides, targets.points, targets.seen)
    features = Features((), (96, 128), heads)
    assert len(SmallDetector(TINY).detect(features)[0]) == 1
    many = SmallDetector(replace(TINY, one_per_class=False)).detect(features)[0]
    assert len(many) == 3


def test_an_empty_image_has_no_detections():
    heat = torch.full((1, 3, 12, 16), -8.0)
    heads = DetectorHeads(heat, torch.zeros(1, 4, 12, 16), torch.zeros(1, 3, 12, 16), torch.zeros(1, 1, 12, 16))
    (rows,) = SmallDetector(TINY).detect(Features((), (96, 128), heads))
    assert rows.shape == (0, 6)
