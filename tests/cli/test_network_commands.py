"""The commands around the pose network, from the command line to their files."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))
from tiny_data import save_tiny, write_bop_split

from poet_loc.cli.main import main


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


OF_NETWORKS = ["detect", "train", "train-refiner", "calibrate", "export", "evaluate-poses"]


@pytest.mark.parametrize("command", [*OF_NETWORKS, "convert checkpoint", "convert classes"])
def test_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*command.split(), "--help") == 0
    assert "usage: poet-loc " + command in capsys.readouterr().out


def test_train_detect_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = save_tiny(tmp_path / "start.safetensors", uncertainty="aleatoric")
    split = write_bop_split(tmp_path / "train", 4)
    arguments = ["--data.train", split, "--start", weights, "--recipe.epochs", 1, "--recipe.batch", 2]
    assert run("train", "--out", tmp_path / "run", *arguments, "--preset", "paper", "--device", "cpu") == 0
    asked = json.loads((tmp_path / "run/options.json").read_text())["options"]
    assert asked["recipe"]["learning_rate"] == 2e-5
    assert asked["recipe"]["batch"] == 2
    network = tmp_path / "run/network.safetensors"
    assert run("calibrate", "--weights", network, "--data", split, "--target", tmp_path / "c.safetensors",
               "--boxes", "gt", "--figure", tmp_path / "f.png") == 0  # fmt: skip
    images = split / "000001/rgb"
    boxes = tmp_path / "boxes.csv"
    info = json.loads((split / "000001/scene_gt_info.json").read_text())
    rows = [
        f"{int(image):06d}.png,{x},{y},{x + w},{y + h},0.9,{label}"
        for image, entries in info.items()
        for label, (x, y, w, h) in enumerate((entry["bbox_obj"] for entry in entries), start=1)
    ]
    boxes.write_text("image,x1,y1,x2,y2,score,class\n" + "\n".join(rows) + "\n")
    assert run("detect", images, "--out", tmp_path / "found", "--weights", tmp_path / "c.safetensors", "--boxes", boxes,
               "--scene", 1) == 0  # fmt: skip
    models = tmp_path / "models"
    models.mkdir()
    sizes = {f"{kind}_{axis}": 1.0 for kind in ("min", "size") for axis in "xyz"}
    (models / "models_info.json").write_text(json.dumps({i: {"diameter": 140.0, **sizes} for i in (2, 5)}))
    for i in (2, 5):
        vertices = "\n".join(f"{x} {y} 0" for x in (-50, 50) for y in (-50, 50))
        header = (
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header"
        )
        (models / f"obj_{i:06d}.ply").write_text(f"{header}\n{vertices}\n")
    capsys.readouterr()
    assert run("evaluate-poses", tmp_path / "found/bop_results.csv", "--truth", split, "--models", models,
               "--out", tmp_path / "tables") == 0  # fmt: skip
    printed = capsys.readouterr().out
    assert "Area under the accuracy curve" in printed
    numbers = json.loads((tmp_path / "tables/poses.json").read_text())[0]
    assert [row["matched"] for row in numbers["classes"]] == [4, 4]


def test_classes_and_hostile_checkpoints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("convert", "classes", "lmo", tmp_path / "lists") == 0
    assert json.loads((tmp_path / "lists/lmo_classes.json").read_text())["12"] == "holepuncher"

    class Hostile:
        def __reduce__(self):
            return exec, (f"open({str(tmp_path / 'gone')!r}, 'w')",)

    torch.save({"model": Hostile()}, tmp_path / "h.pth")
    assert run("convert", "checkpoint", tmp_path / "h.pth", tmp_path / "o.safetensors") == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "refused, nothing was executed" in error
    assert not (tmp_path / "gone").exists()


def test_unknown_options_are_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("detect", tmp_path, "--out", tmp_path / "o", "--wheights", "x") == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_results_are_not_replaced_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("net.onnx", "net.safetensors", "f.png"):
        (tmp_path / name).write_text("mine")
    data = ["--data", tmp_path, "--target", tmp_path / "new.safetensors", "--figure", tmp_path / "f.png"]
    for command in (
        ["export", tmp_path / "net.safetensors", tmp_path / "net.onnx"],
        ["convert", "checkpoint", tmp_path / "net.pth", tmp_path / "net.safetensors"],
        ["calibrate", "--weights", tmp_path / "net.safetensors", *data],
    ):
        assert run(*command) == 1
        assert "is there already; choose another name or pass --overwrite" in capsys.readouterr().err
