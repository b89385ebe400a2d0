"""A miniature of the refiner's training: its starts, its losses, and that it learns and resumes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from poet_loc.data.packed import AugmentOptions, PackedImages, load_models, pack
from poet_loc.data.render import RenderOptions, render
from poet_loc.model.poet import PoET
from poet_loc.model.refiner import RefinerOptions
from poet_loc.model.small_detector import SmallDetector, SmallDetectorOptions
from poet_loc.train import refiner as stage
from poet_loc.train.detector import image_batch
from poet_loc.train.embedded import EMBEDDED, Truth, half_sines
from poet_loc.train.refiner import (
    StartOptions,
    TrainRefinerOptions,
    nearest_rotation,
    network_estimates,
    refiner_losses,
    train_refiner,
    truth_of,
)
from poet_loc.train.steps import StepOptions

TINY = SmallDetectorOptions(widths=(8, 16, 16, 16), blocks=(0, 1, 0, 0), pyramid_dim=12)
TINY_POET = replace(
    EMBEDDED, hidden_dim=32, heads=4, feedforward_dim=32, decoder_layers=1,
    map_channels=SmallDetector(TINY).shape().channels,
)  # fmt: skip
REFINER = RefinerOptions(points=500, widths=(16, 16, 16), rounds=2)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("refiner")
    settings = {"size": (160, 120), "jobs": 1, "progress": False, "images_per_scene": 3}
    render(RenderOptions(out, images=6, **settings))
    render(RenderOptions(out, split="val", images=3, first_scene=900000, **settings))
    return out


@pytest.fixture(scope="module")
def network() -> PoET:
    torch.manual_seed(0)
    return PoET(TINY_POET, SmallDetector(TINY)).eval()


def options(data, out, count: int, **starts) -> TrainRefinerOptions:
    steps = StepOptions(
        out, steps=count, batch=3, warmup=2, save_every=2, learning_rate=4e-3, precision="float32", optimizer="muon"
    )
    splits = data / "train", data / "val", data / "models"
    return TrainRefinerOptions(*splits, data / "cache", steps, REFINER, val_images=3, starts=StartOptions(**starts))


@pytest.fixture(scope="module")
def images(data) -> PackedImages:
    models = load_models(data / "models")
    return PackedImages(pack(data / "train", data / "cache" / "train"), models, stride=None)


def test_estimates_turn_with_the_augmented_image(data, images, tmp_path):
    asked = options(data, tmp_path, 1, estimated=1.0)
    for number in range(len(images)):
        rng = np.random.default_rng(number)
        sample = images.sample(number, rng, AugmentOptions(turn_deg=40.0))
        truth = images.scenes[images.index[number][0]].poses  # an estimator that is always right
        R, t = stage._start(sample, truth, rng, asked.starts)
        np.testing.assert_allclose(R, sample.R_cam_obj, atol=1e-9)
        np.testing.assert_allclose(t, sample.t_cam_obj, atol=1e-9)


def test_starts_beside_the_truth_are_as_wrong_as_they_should_be(data, images, tmp_path):
    asked = options(data, tmp_path, 1, estimated=0.0)
    sample = next(s for s in (images.sample(n, np.random.default_rng(0)) for n in range(6)) if len(s.rows))
    nothing = np.full((100, 3, 4), np.nan)
    starts = [stage._start(sample, nothing, np.random.default_rng(k), asked.starts) for k in range(400)]
    turns = [(Rotation.from_matrix(R) * Rotation.from_matrix(sample.R_cam_obj).inv()).as_rotvec() for R, _ in starts]
    shares = np.linspace(0.25, 2.5, 100001)
    log_uniform = np.sum(shares) / np.sum(1 / shares)  # mean square of the drawn size
    assert np.sqrt(np.mean(np.square(turns))) == pytest.approx(np.deg2rad(8.0) * np.sqrt(log_uniform), rel=0.1)
    ratio = np.log([t[:, 2] / sample.t_cam_obj[:, 2] for _, t in starts])
    assert np.std(ratio) == pytest.approx(0.02 * np.sqrt(log_uniform), rel=0.1)


def test_estimates_are_kept_scene_by_scene(images, network, tmp_path, monkeypatch):
    models = images.models
    first = network_estimates(network, images, models, tmp_path, 0.04, batch=2)
    assert [len(poses) for poses in first] == [len(scene.object_ids) for scene in images.scenes]
    asked = np.concatenate([images.sample(n, np.random.default_rng(0)).rows for n in range(3)])
    assert np.array_equal(np.flatnonzero(~np.isnan(first[0][:, 0, 0])), np.sort(asked))
    (tmp_path / "000001.npy").unlink()
    monkeypatch.setattr(stage, "_estimate", lambda *arguments: None)
    second = network_estimates(network, images, models, tmp_path, 0.04)
    np.testing.assert_array_equal(first[0], second[0])
    assert np.isnan(second[1]).all()


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 2.0, -2.0)])
def test_the_nearest_of_equal_rotations_is_that_of_the_axis_error(axis):
    rng = np.random.default_rng(0)
    R = torch.from_numpy(Rotation.random(30, random_state=1).as_matrix())
    tilt = Rotation.from_rotvec(rng.normal(0, 0.3, (30, 3))).as_matrix()
    axis = np.array(axis) / np.linalg.norm(axis)
    about = Rotation.from_rotvec(np.outer(rng.uniform(-3, 3, 30), axis)).as_matrix()
    estimate = torch.from_numpy(tilt @ R.numpy() @ about)
    axes = torch.from_numpy(axis).repeat(30, 1)
    truth = Truth(torch.zeros(30, 3), R, axes, torch.ones(30, 2), torch.ones(30))
    nearest = nearest_rotation(truth, estimate)
    torch.testing.assert_close(nearest @ axes[0], R @ axes[0])
    best = half_sines(estimate, replace(truth, R=nearest, axes=0 * axes))
    for angle in np.linspace(-np.pi, np.pi, 61):
        turn = torch.from_numpy(Rotation.from_rotvec(angle * axis).as_matrix())
        other = half_sines(estimate, replace(truth, R=R @ turn, axes=0 * axes))
        assert (other > best - 1e-9).all()
    plain = replace(truth, axes=0 * axes)
    assert torch.equal(nearest_rotation(plain, estimate), R)


def test_it_learns_a_correction_by_heart(data, images, tmp_path):
    asked = options(data, tmp_path, 1, estimated=0.0)
    samples = [images.sample(n, np.random.default_rng(0)) for n in range(3)]
    nothing = np.full((100, 3, 4), np.nan)
    starts = [stage._start(s, nothing, np.random.default_rng(k), asked.starts) for k, s in enumerate(samples)]
    start, truth, batch = stage._estimates(samples, starts), truth_of(samples, images.models), image_batch(samples)
    refiner = stage._blank_refiner(asked).train()
    optimizer, rows = torch.optim.AdamW(refiner.parameters(), 5e-3), []
    for _ in range(40):
        found = refiner.compare(batch.images, batch.intrinsics, start)
        losses = refiner_losses(found, truth, refiner.diameters[start.classes - 1], asked.loss)
        rows.append({name: float(value.detach()) for name, value in losses.items()})
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
    first, last = rows[0], rows[-1]
    assert all(last[name] < 0.5 * first[name] for name in ("flow", "centre", "rotation"))
    assert last["likelihood"] < first["likelihood"]


def test_a_resumed_run_is_the_uninterrupted_one_and_the_network_stays_as_it_was(data, network, tmp_path):
    before = {name: value.clone() for name, value in network.state_dict().items()}
    whole = train_refiner(options(data, tmp_path / "whole", 6), network)
    row = json.loads((tmp_path / "whole" / "log.jsonl").read_text().splitlines()[-1])
    assert {"flow", "centre", "depth", "rotation", "likelihood", "t_cm", "r_deg", "auc_add_s"} <= set(row)
    assert network.refiner is None
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    half = options(data, tmp_path / "half", 6)
    train_refiner(replace(half, steps=replace(half.steps, max_steps=3)), network)
    resumed = train_refiner(half, network)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_truths_are_those_of_the_samples(images):
    samples = [images.sample(n, np.random.default_rng(0)) for n in range(6)]
    truth = truth_of(samples, images.models)
    assert len(truth.classes) == sum(len(sample.rows) for sample in samples)
    np.testing.assert_allclose(truth.R, np.concatenate([sample.R_cam_obj for sample in samples]), atol=1e-6)
