"""Every row of the ablation is a network that trains: one step each, on two images."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from poet_loc.data.render import RenderOptions, render
from poet_loc.model.checkpoint import ModelConfig
from poet_loc.model.poet import PoET
from poet_loc.model.small_detector import SmallDetector, SmallDetectorOptions
from poet_loc.train import ablation
from poet_loc.train.ablation import AblationOptions, ablate, ablation_table
from poet_loc.train.embedded import EMBEDDED


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("ablation")
    for split, first in (("train", 0), ("val", 900000)):
        render(RenderOptions(out, split, 3, first, 3, (96, 64), jobs=1, progress=False))
    return out


@pytest.fixture
def miniature(monkeypatch):
    """Every network of the ablation, very small."""
    tiny = SmallDetectorOptions(widths=(8, 16, 16, 16), blocks=(0, 0, 0, 0), pyramid_dim=12)
    channels = SmallDetector(tiny).shape().channels

    def shrunk(rows):
        return {n: replace(o, hidden_dim=32, feedforward_dim=16, map_channels=channels) for n, o in rows.items()}

    monkeypatch.setattr(ablation, "PAPER_ROWS", shrunk(ablation.PAPER_ROWS))
    monkeypatch.setattr(ablation, "OUR_ROWS", shrunk(ablation.OUR_ROWS))
    small = replace(EMBEDDED, hidden_dim=32, heads=4, feedforward_dim=16, map_channels=channels)

    def embedded():
        torch.manual_seed(0)
        return PoET(small, SmallDetector(tiny)), ModelConfig(small, tiny)

    monkeypatch.setattr(ablation, "load_embedded", embedded)


def test_each_row_trains_and_is_measured(data, tmp_path, miniature):
    rows = (*ablation.PAPER_ROWS, *ablation.OUR_ROWS)
    figures = ablate(AblationOptions(data, tmp_path, rows, steps=1, batch=2, val_images=2))
    assert tuple(figures) == rows
    assert len(rows) == 13
    assert len({row["t_cm"] for row in figures.values()}) >= 12  # other networks, but for octaves that are not there
    assert ablation_table(figures).count("\n") == 14


def test_two_stretches_are_one_and_what_is_done_stays(data, tmp_path, miniature, monkeypatch, capsys):
    from poet_loc.cli.main import main

    def run(out, *more):
        words = ["--data", data, "--rows", "Baseline", "RP + Q", "--steps", "2", "--batch", "2", "--val-images", "2"]
        assert main(["ablation", *map(str, words), "--out", str(tmp_path / out), *more]) == 0
        rows = [[cell.strip() for cell in line.split("|")] for line in capsys.readouterr().out.splitlines()]
        return [row[:3] + row[4:] for row in rows]  # without the CPU time

    whole = run("whole")
    half = run("stretches", "--max-steps", "1")
    assert half[2][:3] == ["", "Baseline", "1"]
    again = run("stretches", "--max-steps", "1")
    assert again == whole
    assert half != whole
    monkeypatch.setattr(ablation, "pose_figures", None)  # nothing is measured again
    assert run("stretches") == again
    assert main(["ablation", "--data", str(data), "--out", str(tmp_path), "--rows", "Basline"]) == 1
    assert "no row 'Basline'" in capsys.readouterr().err
