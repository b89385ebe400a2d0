"""Every row of the ablation is a network that trains: one step each, on two images."""

from __future__ import annotations

from dataclasses import replace

import pytest

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


def test_each_row_trains_and_is_measured(data, tmp_path, monkeypatch):
    tiny = SmallDetectorOptions(widths=(8, 16, 16, 16), blocks=(0, 0, 0, 0), pyramid_dim=12)
    channels = SmallDetector(tiny).shape().channels

    def shrunk(rows):
        return {n: replace(o, hidden_dim=32, feedforward_dim=16, map_channels=channels) for n, o in rows.items()}

    monkeypatch.setattr(ablation, "PAPER_ROWS", shrunk(ablation.PAPER_ROWS))
    monkeypatch.setattr(ablation, "OUR_ROWS", shrunk(ablation.OUR_ROWS))
    small = replace(EMBEDDED, hidden_dim=32, heads=4, feedforward_dim=16, map_channels=channels)
    monkeypatch.setattr(ablation, "load_embedded", lambda: (PoET(small, SmallDetector(tiny)), ModelConfig(small, tiny)))
    figures = ablate(AblationOptions(data, tmp_path, steps=1, batch=2, val_images=2))
    assert len(figures) == 13
    assert len({row["t_cm"] for row in figures.values()}) >= 12  # other networks, but for octaves that are not there
    assert ablation_table(figures).count("\n") == 14
