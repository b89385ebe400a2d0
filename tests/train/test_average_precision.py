"""Average precision against worked examples and a brute force, calibration against known spreads."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poet_loc.model.poet import PoET
from poet_loc.train.average_precision import average_precision, mean_average_precision, overlaps
from poet_loc.train.calibration import coverage, scale_sigmas, temperatures
from poet_loc.train.embedded import EMBEDDED

BOX = np.array([0.0, 0.0, 10.0, 10.0])


def found(*rows) -> np.ndarray:
    return np.array([[*(BOX + shift), score] for shift, score in rows]).reshape(-1, 5)


def test_overlap_counts_cells():
    rng = np.random.default_rng(0)
    corners = np.sort(rng.integers(0, 12, (8, 2, 2)), axis=1).transpose(0, 1, 2).reshape(8, 4).astype(float)
    y, x = np.mgrid[0:12, 0:12] + 0.5
    cells = np.array([(x > b[0]) & (x < b[2]) & (y > b[1]) & (y < b[3]) for b in corners])
    both = np.einsum("iyx,jyx->ij", cells.astype(float), cells.astype(float))
    either = cells.sum((1, 2))[:, None] + cells.sum((1, 2)) - both
    np.testing.assert_allclose(overlaps(corners, corners), both / np.maximum(either, 1e-9), atol=1e-9)


def test_all_found_first_is_perfect_and_a_false_one_later_costs_nothing():
    truth = [BOX[None], BOX[None]]
    assert average_precision([found((0, 0.9)), found((0, 0.8), (50, 0.1))], truth, 0.5) == pytest.approx(1.0)


def test_a_worked_example():
    # by score: right, wrong, right, of three true boxes -> 1/3 * 1 + 1/3 * 2/3
    truth = [BOX[None]] * 3
    detections = [found((0, 0.9)), found((50, 0.8)), found((0, 0.7))]
    assert average_precision(detections, truth, 0.5) == pytest.approx(1 / 3 + 2 / 9)


def test_a_second_box_on_the_same_object_is_wrong():
    assert average_precision([found((0, 0.5), (1, 0.9))], [BOX[None]], 0.5) == pytest.approx(1.0)
    assert average_precision([found((0, 0.9), (1, 0.8))], [np.concatenate([BOX[None], BOX[None] + 90])], 0.5) == 0.5


def test_classes_count_alike_and_nothing_found_is_zero():
    truth = [np.concatenate([np.append(BOX, 1)[None], np.append(BOX + 30, 2)[None]])]
    detections = [np.array([[*BOX, 0.9, 1.0]])]
    assert mean_average_precision(detections, truth) == pytest.approx(0.5)
    assert mean_average_precision([np.zeros((0, 6))], truth) == 0.0
    assert np.isnan(average_precision([found((0, 0.9))], [np.zeros((0, 4))], 0.5))


def test_temperatures_bring_the_coverage_to_one_sigma():
    rng = np.random.default_rng(1)
    sigma = np.array([0.01, 0.01, 0.03, 0.1, 0.1, 0.2])
    claimed = np.log(sigma**2) + np.log(np.array([0.25, 1, 4, 0.1, 1, 9]))
    error = rng.normal(size=(20000, 6)) * sigma
    error[:400] *= 50  # gross errors
    factors = temperatures(error, np.tile(claimed, (20000, 1)))
    np.testing.assert_allclose(factors, np.array([4, 1, 0.25, 10, 1, 1 / 9]) ** 0.5, rtol=0.06)
    np.testing.assert_allclose(coverage(error, claimed + 2 * np.log(factors)), 0.6827, atol=1e-3)


def test_scaled_heads_say_the_scaled_sigmas():
    from dataclasses import replace

    options = replace(EMBEDDED, hidden_dim=32, heads=4, feedforward_dim=32, decoder_layers=2, map_channels=(4, 4, 4))
    torch.manual_seed(0)
    network = PoET(options).eval()
    state = torch.randn(2, 3, 32)
    factors = np.array([1.0, 2.0, 0.5, 3.0, 1.0, 0.1])

    def claimed(layer: int) -> np.ndarray:
        heads = (network.translation_head_aleatoric, network.rotation_head_aleatoric)
        parts = [head[layer](state).unflatten(-1, (options.slots, 3)) for head in heads]
        return torch.cat(parts, -1).detach().numpy()

    before = claimed(0), claimed(1)
    scale_sigmas(network, factors)
    np.testing.assert_allclose(claimed(0), before[0])
    np.testing.assert_allclose(claimed(1) - before[1], np.broadcast_to(2 * np.log(factors), before[1].shape), atol=1e-5)
