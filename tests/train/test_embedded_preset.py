"""The preset from rendering to a checkpoint that loads, in a miniature of two steps."""

from __future__ import annotations

from dataclasses import replace

import pytest

from poet_loc.core.input_error import InputError
from poet_loc.model.checkpoint import load_model
from poet_loc.train import embedded_preset
from poet_loc.train.embedded import EMBEDDED
from poet_loc.train.embedded_preset import EmbeddedPresetOptions, train_preset
from poet_loc.train.model_card import MeasureOptions, card_table, full_card, measure
from poet_loc.videos import VideoOptions, render_videos


def miniature(out) -> EmbeddedPresetOptions:
    steps = {"detector_steps": 1, "joint_steps": 2, "refiner_steps": 1}
    return EmbeddedPresetOptions(out, 4, 4, **steps, batch=2, jobs=1, precision="float32")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    out = tmp_path_factory.mktemp("preset")
    return train_preset(miniature(out))


def test_the_checkpoint_holds_detector_network_names_and_its_history(checkpoint):
    network, config = load_model(checkpoint)
    assert network.options == config.network == EMBEDDED
    assert config.object_names[8] == "bowl"
    assert config.source["joint"]["step"] == 2
    assert config.source["refiner"]["step"] == 1
    assert network.refiner is not None
    assert network.refiner.options == config.refiner
    assert len(config.source["temperatures"]) == 6
    assert config.source["calibrated_for"] == "gt"  # after two steps the detector finds nothing
    assert all(0.4 < share < 0.9 for share in config.source["coverage"]["gt"])
    assert checkpoint.stat().st_size < 20e6


def test_a_second_call_finds_everything_done(checkpoint, monkeypatch):
    from poet_loc.train import steps

    def fail(*_, **__):
        raise AssertionError("nothing is left to train")

    monkeypatch.setattr(steps.torch.optim.AdamW, "step", fail)
    assert train_preset(miniature(checkpoint.parent)) == checkpoint


def test_a_network_that_is_not_through_gets_no_refiner(checkpoint, tmp_path):
    for name in ("world", "packed", "detector"):
        (tmp_path / name).symlink_to(checkpoint.parent / name)
    network, config = load_model(train_preset(replace(miniature(tmp_path), max_steps=1)))
    assert network.refiner is config.refiner is None
    assert not (tmp_path / "refiner").exists()


def test_the_card_counts_every_object_that_was_asked_for(checkpoint, tmp_path):
    render_videos(VideoOptions(tmp_path, videos=1, duration_s=(2.0, 2.0), jobs=1, progress=False))
    figures = measure(MeasureOptions(tmp_path, checkpoint))
    gt = figures.scores["gt"]
    assert len(gt.object_ids) == len(figures.scores["bb"].object_ids) > 0
    assert (gt.translation_m < 10).all()
    card = full_card(MeasureOptions(tmp_path, checkpoint), figures, checkpoint.parent / "joint" / "log.jsonl")
    assert "joint 2 steps" in card
    assert "refiner 1 steps" in card
    assert "Within one sigma there, gt boxes" in card
    table = card_table(figures)
    assert table in card
    assert "| **all** | gt |" in table
    assert all(f"| {figures.names[int(label)]} | gt |" in table for label in set(gt.object_ids))
    assert (tmp_path / "video_00" / "object_poses_gt.csv").exists()


def test_the_command_refuses_a_split_that_it_would_not_render(tmp_path):
    from poet_loc.cli.train import Arguments, execute
    from poet_loc.train.options import DataOptions, TrainOptions

    with pytest.raises(InputError, match="train"):
        execute(Arguments(TrainOptions(tmp_path, DataOptions(tmp_path / "real")), "embedded"))
    assert embedded_preset.EmbeddedPresetOptions(tmp_path).joint_steps > 0
