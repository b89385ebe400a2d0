"""Steps against numpy's singular values, PyTorch's AdamW, and each other in another layout of memory."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import nn

from poet_loc.core.input_error import InputError
from poet_loc.train.optimizer import Optimizer
from poet_loc.train.steps import StepOptions, train_steps


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Conv2d(3, 64, 3), nn.Conv2d(64, 96, 3), nn.Flatten(), nn.Linear(96, 64), nn.Linear(64, 5))


def with_gradients(module: nn.Module) -> nn.Module:
    torch.manual_seed(1)
    for parameter in module.parameters():
        parameter.grad = torch.randn_like(parameter, memory_format=torch.contiguous_format)
    return module


def moves(module: nn.Module, kind: str, rate: float = 1e-2) -> dict[str, np.ndarray]:
    before = {name: value.detach().clone() for name, value in module.named_parameters()}
    Optimizer(module, kind, 0.0).step(rate)
    return {name: (value.detach() - before[name]).numpy() / rate for name, value in module.named_parameters()}


@pytest.mark.parametrize("name", ["1.weight", "3.weight"])
def test_hidden_matrices_move_along_their_gradients_with_nearly_equal_singular_values(name):
    module = with_gradients(network())
    gradient = module.get_parameter(name).grad.flatten(1).numpy()
    move = -moves(module, "muon")[name].reshape(gradient.shape)
    left, _, right = np.linalg.svd(gradient, full_matrices=False)
    values = left.T @ move @ right.T / (0.2 * np.sqrt(max(gradient.shape)))
    assert np.all(np.abs(np.diag(values) - 1.0) < 0.5)
    assert np.abs(values - np.diag(np.diag(values))).max() < 0.05


def test_everything_else_moves_as_with_adamw():
    mixed, plain = moves(with_gradients(network()), "muon"), moves(with_gradients(network()), "adamw")
    for name in ("0.weight", "0.bias", "1.bias", "4.weight", "4.bias"):
        np.testing.assert_array_equal(mixed[name], plain[name])
    assert np.abs(mixed["1.weight"] - plain["1.weight"]).max() > 0.1


def test_the_layout_of_memory_does_not_matter():
    module = with_gradients(network())
    last = with_gradients(network().to(memory_format=torch.channels_last))
    assert last.get_parameter("1.weight").is_contiguous(memory_format=torch.channels_last)
    np.testing.assert_allclose(moves(last, "muon")["1.weight"], moves(module, "muon")["1.weight"], atol=0.02)


def test_a_run_does_not_go_on_with_another_optimizer(tmp_path):
    def losses(module: nn.Module, step: int) -> dict[str, torch.Tensor]:
        return {"loss": sum(parameter.square().sum() for parameter in module.parameters())}

    train_steps(network(), losses, StepOptions(tmp_path, steps=2, max_steps=1, optimizer="adamw"))
    with pytest.raises(InputError, match=r"this optimizer is adamw \+ muon"):
        train_steps(copy.deepcopy(network()), losses, StepOptions(tmp_path, steps=2, optimizer="muon"))
