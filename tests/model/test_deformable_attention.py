"""The fused sampler against the plain one, values and gradients, and against bilinear interpolation by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from poet_loc.model.deformable_attention import DeformableAttention, sample, sample_plain
from poet_loc.model.fused_sampler import FusedSample


def random_case(batch=2, heads=3, depth=5, points=2, shapes=((5, 7), (3, 4)), queries=11, seed=0, spread=1.6):
    generator = torch.Generator().manual_seed(seed)
    tokens = sum(h * w for h, w in shapes)
    value = torch.randn(batch, tokens, heads, depth, generator=generator)
    locations = (
        torch.rand(batch, queries, heads, len(shapes), points, 2, generator=generator) * spread - (spread - 1) / 2
    )
    weights = torch.rand(batch, queries, heads, len(shapes), points, generator=generator)
    return value, shapes, locations, weights


@settings(max_examples=25, deadline=None)
@given(
    depth=st.sampled_from([1, 4, 5, 16, 32]),
    heads=st.integers(1, 3),
    points=st.integers(1, 4),
    shapes=st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6)), min_size=1, max_size=3),
    queries=st.integers(1, 9),
    spread=st.floats(0.5, 4.0),
    seed=st.integers(0, 1000),
)
def test_fused_is_plain(depth, heads, points, shapes, queries, spread, seed) -> None:
    value, shapes, locations, weights = random_case(1, heads, depth, points, tuple(shapes), queries, seed, spread)
    inputs = [tensor.requires_grad_() for tensor in (value, locations, weights)]
    plain = sample_plain(inputs[0], shapes, inputs[1], inputs[2])
    fused = sample(inputs[0], shapes, inputs[1], inputs[2])
    torch.testing.assert_close(fused, plain, atol=1e-5, rtol=1e-5)
    upstream = torch.randn_like(plain)
    for one, other in zip(torch.autograd.grad(plain, inputs, upstream), torch.autograd.grad(fused, inputs, upstream)):
        torch.testing.assert_close(other, one, atol=2e-4, rtol=1e-4)


def test_plain_gradient_is_numeric() -> None:
    value, shapes, locations, weights = random_case(1, 2, 3, 2, ((4, 5), (2, 3)), 3)
    inputs = [tensor.double().requires_grad_() for tensor in (value, locations, weights)]
    torch.autograd.gradcheck(lambda v, x, w: sample_plain(v, shapes, x, w), inputs, eps=1e-6, atol=1e-5)


def test_bilinear_by_hand() -> None:
    level = torch.arange(12.0).reshape(1, 12, 1, 1)
    where = torch.tensor([[0.5, 0.5], [0.125, 1 / 6], [1.0, 0.5], [-0.2, 0.5]]).reshape(1, 4, 1, 1, 1, 2)
    out = FusedSample.apply(level, ((3, 4),), where, torch.ones(1, 4, 1, 1, 1))
    # centre between cells 5 and 6; the centre of cell 0; half a cell over the right edge; outside
    np.testing.assert_allclose(out.flatten().numpy(), [5.5, 0.0, 3.5, 0.0], atol=1e-6)


def test_undefined_locations_count_as_outside() -> None:
    value, shapes, locations, weights = random_case(1)
    locations[0, 0] = float("nan")
    locations[0, 1] = float("inf")
    locations[0, 2] = -1e30
    out = FusedSample.apply(value, shapes, locations, weights)
    assert out[0, :3].abs().max() == 0
    torch.testing.assert_close(out[0, 3:], sample_plain(value, shapes, locations, weights)[0, 3:], atol=1e-5, rtol=0)


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    value, shapes, locations, weights = random_case(1, 4, 8, 2, ((9, 9), (4, 4)), 300)
    inputs = [tensor.requires_grad_() for tensor in (value, locations, weights)]
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda n=threads: n)
        out = FusedSample.apply(inputs[0], shapes, inputs[1], inputs[2])
        results.append((out, *torch.autograd.grad(out.square().sum(), inputs)))
    for one, three in zip(*results):
        torch.testing.assert_close(one, three, atol=0, rtol=0)


def test_start_of_training_looks_around() -> None:
    attention = DeformableAttention(64, 2, 8, 3)
    shapes = ((8, 8), (4, 4))
    reference = torch.full((1, 1, 2, 2), 0.5)
    locations, weights = attention.where_and_how_much(torch.randn(1, 1, 64), reference, shapes)
    cells = (locations - 0.5) * torch.tensor([8.0, 4.0])[:, None, None]
    steps = cells[0, 0].abs().amax(-1)  # (M, L, P): point k lies k + 1 cells away
    torch.testing.assert_close(steps, torch.tensor([1.0, 2.0, 3.0]).expand(8, 2, 3))
    torch.testing.assert_close(weights, torch.full_like(weights, 1 / 6))


def test_offsets_in_units_of_a_box() -> None:
    attention = DeformableAttention(64, 1, 4, 2)
    box = torch.tensor([0.4, 0.6, 0.2, 0.1]).reshape(1, 1, 1, 4)
    locations, _ = attention.where_and_how_much(torch.zeros(1, 1, 64), box, ((10, 10),))
    offsets = attention.sampling_offsets.bias.reshape(4, 1, 2, 2)
    expected = torch.tensor([0.4, 0.6]) + offsets / 2 * torch.tensor([0.2, 0.1]) / 2
    torch.testing.assert_close(locations[0, 0], expected)
