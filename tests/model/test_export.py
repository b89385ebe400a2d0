"""Exported graphs compute the network's poses."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from official_fixture import random_features, randomise, small_options

from poet_loc.core.input_error import InputError
from poet_loc.model.checkpoint import ModelConfig, save_model
from poet_loc.model.export import ExportOptions, PoseGraph, export, largest_difference, write_onnx
from poet_loc.model.exported import ExportedPoses
from poet_loc.model.poet import PoET
from poet_loc.model.queries import queries_from_detections

pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def network() -> PoET:
    return randomise(PoET(small_options(encoder_layers=1, decoder_layers=1, uncertainty="aleatoric"))).eval()


@pytest.fixture(scope="module")
def onnx_file(network: PoET, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("onnx") / "graph.onnx"
    write_onnx(PoseGraph(network, (96, 128)), path)
    return path


@pytest.mark.parametrize("suffix", [".onnx", ".xml"])
def test_graph_is_the_network(
    suffix: str, network: PoET, onnx_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxruntime" if suffix == ".onnx" else "openvino")
    monkeypatch.setattr("poet_loc.model.export.write_onnx", lambda graph, path: shutil.copy(onnx_file, path))
    save_model(tmp_path / "n.safetensors", network, ModelConfig(network.options, image_size=(128, 96)))
    path = export(ExportOptions(tmp_path / "n.safetensors", tmp_path / f"graph{suffix}"))
    assert largest_difference(path, PoseGraph(network, (96, 128)), seed=5) < 1e-4
    engine = ExportedPoses(path, network)
    rows = torch.tensor([[5.0, 6, 50, 60, 0.9, 2], [30, 20, 90, 80, 0.5, 3]])
    queries = queries_from_detections([rows, rows[:1]], (96, 128), 5)
    mask = torch.zeros(2, 96, 128, dtype=torch.bool)
    features = random_features()
    with torch.no_grad():
        expected = network.poses(features, mask, queries)
    found = engine.poses(features, mask, queries)
    torch.testing.assert_close(found.translation, expected.translation, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.rotation, expected.rotation, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.translation_uncertainty, expected.translation_uncertainty, atol=1e-4, rtol=0)
    with pytest.raises(InputError, match="whole images of 128x96"):
        engine.poses(random_features(size=(64, 64)), mask[:, :64, :64], queries)
    with pytest.raises(InputError, match="other options"):
        ExportedPoses(path, PoET(small_options()))


def test_mistakes(tmp_path: Path) -> None:
    save_model(tmp_path / "n.safetensors", PoET(small_options()), ModelConfig(small_options()))
    with pytest.raises(InputError, match="size of its images"):
        export(ExportOptions(tmp_path / "n.safetensors", tmp_path / "g.onnx"))
    with pytest.raises(InputError, match=r"neither \.onnx nor \.xml"):
        export(ExportOptions(tmp_path / "n.safetensors", tmp_path / "g.pt", (64, 64)))
