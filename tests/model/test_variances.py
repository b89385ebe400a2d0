"""Calibration: honest covariances stay, wrong ones are mended."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_data import save_tiny, tiny_network, write_bop_split

from poet_loc.core.input_error import InputError
from poet_loc.core.reliability import LEVELS, reliability, squared_mahalanobis, variance_factor
from poet_loc.model.checkpoint import load_model, save_model
from poet_loc.report.reliability_figure import reliability_figure
from poet_loc.train.variances import CalibrateOptions, calibrate


def errors_and_covariances(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    factor = np.tril(rng.normal(size=(count, 3, 3))) + 2 * np.eye(3)
    return np.einsum("nij,nj->ni", factor, rng.normal(size=(count, 3))), factor @ factor.transpose(0, 2, 1)


def test_honest_covariances_are_on_the_diagonal() -> None:
    error, covariance = errors_and_covariances(20_000)
    squared = squared_mahalanobis(error, covariance)
    np.testing.assert_allclose(reliability(squared, 3), LEVELS, atol=0.012)
    assert variance_factor(squared, 3) == pytest.approx(1.0, abs=0.03)
    assert variance_factor(squared, 3, robust=False) == pytest.approx(1.0, abs=0.03)


def test_the_factor_is_what_was_wrong_and_robust_to_gross_errors() -> None:
    error, covariance = errors_and_covariances(20_000)
    squared = squared_mahalanobis(error, covariance / 4.0)
    assert variance_factor(squared, 3) == pytest.approx(4.0, rel=0.03)
    squared[:1000] = 1e6
    assert variance_factor(squared, 3) == pytest.approx(4.0, rel=0.1)
    assert variance_factor(squared, 3, robust=False) > 1000
    with pytest.raises(ValueError, match="no error"):
        variance_factor([], 3)


@pytest.mark.parametrize("kind", ["aleatoric", "full"])
def test_a_network_is_calibrated_on_data(kind: str, tmp_path: Path) -> None:
    network, config = tiny_network(uncertainty=kind)
    save_model(tmp_path / "n.safetensors", network, config)
    split = write_bop_split(tmp_path / "val", 8)
    options = CalibrateOptions(tmp_path / "n.safetensors", split, tmp_path / "c.safetensors", boxes="gt", robust=False)
    found = calibrate(options)
    assert found.objects == 16
    loaded, mended = load_model(tmp_path / "c.safetensors")
    assert mended.variance_scale == found.factors
    assert replace(mended, variance_scale=(1.0, 1.0)) == config
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], tensor, atol=0, rtol=0)
    with pytest.raises(InputError, match="is there already"):
        calibrate(options)
    robust = calibrate(replace(options, robust=True, overwrite=True))
    at_half = found.levels.index(0.5)
    assert robust.after["translation"][at_half] == pytest.approx(0.5, abs=0.01)
    assert robust.after["rotation"][at_half] == pytest.approx(0.5, abs=0.01)
    reliability_figure(found.levels, found.before, found.after).savefig(tmp_path / "r.png")
    assert (tmp_path / "r.png").stat().st_size > 5000


def test_mistakes(tmp_path: Path) -> None:
    save_tiny(tmp_path / "n.safetensors")
    split = write_bop_split(tmp_path / "val", 2)
    with pytest.raises(InputError, match="tells no uncertainty"):
        calibrate(CalibrateOptions(tmp_path / "n.safetensors", split, tmp_path / "c.safetensors"))
    save_tiny(tmp_path / "u.safetensors", uncertainty="aleatoric")
    with pytest.raises(InputError, match="no detection matches"):
        calibrate(CalibrateOptions(tmp_path / "u.safetensors", split, tmp_path / "c.safetensors"))
