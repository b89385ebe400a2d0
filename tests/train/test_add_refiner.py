"""A refiner for a network of one's own: a miniature data set with its own object numbers, PNG images, no depth."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))
from tiny_data import OBJECT_IDS, save_tiny, tiny_network, write_bop_split

from poet_loc.cli.main import main
from poet_loc.core.input_error import InputError
from poet_loc.model.checkpoint import load_model, read_weights, save_model
from poet_loc.train.add_refiner import AddRefinerOptions, add_refiner

DIAMETERS_MM = {1: 50.0, 2: 140.0, 5: 150.0}  # object 1 is not the network's
SQUARE = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
end_header
-50 -50 0 {colour}
50 -50 0 {colour}
50 50 0 {colour}
-50 50 0 {colour}
3 0 1 2
3 0 2 3
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("own")
    write_bop_split(out / "train", 6)
    write_bop_split(out / "val", 3, seed=1)
    models, sizes = out / "models", {f"{kind}_{axis}": 1.0 for kind in ("min", "size") for axis in "xyz"}
    models.mkdir()
    (models / "models_info.json").write_text(json.dumps({i: {"diameter": d, **sizes} for i, d in DIAMETERS_MM.items()}))
    for number, colour in {1: "9 9 9", 2: "0 90 250", 5: "250 90 0"}.items():
        (models / f"obj_{number:06d}.ply").write_text(SQUARE.format(colour=colour))
    save_tiny(out / "start.safetensors")
    return out


def asked(data: Path, out: Path, **changes) -> AddRefinerOptions:
    given = {"steps": 4, "batch": 2, "points": 200, "rounds": 1, "precision": "float32", "val_images": 2}
    return AddRefinerOptions(data / "start.safetensors", data / "train", data / "val", out, **given | changes)


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    assert add_refiner(asked(data, out)) == 4
    return out / "network.safetensors"


def test_the_network_stays_and_its_refiner_knows_its_objects(data, whole):
    before, _ = read_weights(data / "start.safetensors")
    network, config = load_model(whole)
    after = network.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert config.object_ids == OBJECT_IDS
    assert config.refiner.class_count == 2
    np.testing.assert_allclose(network.refiner.diameters, [0.14, 0.15])  # class 1 is object 2
    assert network.refiner.colours[:, 0].tolist() == [[0, 90, 250], [250, 90, 0]]
    assert config.source["refiner"]["step"] == 4
    assert config.source["images"] == 2
    rows = [json.loads(line) for line in (whole.parent / "log.jsonl").read_text().splitlines()]
    assert {"flow", "t_cm", "r_deg", "auc_add_s"} <= set(rows[-1])


def test_an_interrupted_run_ends_as_the_whole_one(data, whole, tmp_path, capsys):
    arguments = ["train-refiner", "--weights", data / "start.safetensors", "--train", data / "train"]
    arguments += ["--validation", data / "val", "--out", tmp_path / "run", "--steps", 4, "--batch", 2, "--points", 200]
    arguments += ["--rounds", 1, "--precision", "float32", "--val-images", 2]
    assert main([*map(str, arguments), "--max-steps", "3"]) == 0
    assert "3 of 4 steps" in capsys.readouterr().out
    assert not (tmp_path / "run" / "network.safetensors").exists()
    assert main([*map(str, arguments)]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "run" / "network.safetensors")
    weights, config = read_weights(tmp_path / "run" / "network.safetensors")
    expected, other = read_weights(whole)
    assert all(torch.equal(weights[name], value) for name, value in expected.items())
    assert config.source["temperatures"] == other.source["temperatures"]


def test_another_run_and_other_data_are_refused(data, whole, tmp_path):
    with pytest.raises(InputError, match="the run had other options: batch"):
        add_refiner(asked(data, whole.parent, batch=3))
    save_tiny(tmp_path / "other.safetensors", uncertainty="aleatoric")
    with pytest.raises(InputError, match="the run had other options: network"):
        add_refiner(replace(asked(data, whole.parent), weights=tmp_path / "other.safetensors"))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("")
    with pytest.raises(InputError, match="holds something else"):
        add_refiner(asked(data, tmp_path / "full"))
    with pytest.raises(InputError, match="no BOP split"):
        add_refiner(replace(asked(data, tmp_path / "new"), train=data / "models"))
    assert not (tmp_path / "new").exists()  # so that the right one may follow
    network, config = tiny_network()
    save_model(tmp_path / "seven.safetensors", network, replace(config, object_ids=(2, 7)))
    with pytest.raises(InputError, match="no model of object 7"):
        add_refiner(replace(asked(data, tmp_path / "ids"), weights=tmp_path / "seven.safetensors"))
