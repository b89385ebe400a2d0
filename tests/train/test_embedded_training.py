"""A miniature of the embedded training: it learns, it resumes exactly, its losses mean what they say."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from poet_loc.data.packed import NO_CHANGE, PackedImages, load_models, pack
from poet_loc.data.render import RenderOptions, render
from poet_loc.model.poet import PoET
from poet_loc.model.small_detector import SmallDetector, SmallDetectorOptions
from poet_loc.train.detector import TrainDetectorOptions, batch_numbers, train_detector
from poet_loc.train.embedded import (
    EMBEDDED,
    TrainEmbeddedOptions,
    Truth,
    depth_losses,
    half_sines,
    pose_errors,
    predict,
    robust_likelihood,
    train_embedded,
)
from poet_loc.train.steps import StepOptions, learning_rate_at

TINY = SmallDetectorOptions(widths=(8, 16, 16, 16), blocks=(0, 1, 0, 0), pyramid_dim=12)
TINY_CHANNELS = SmallDetector(TINY).shape().channels
TINY_POET = replace(EMBEDDED, hidden_dim=32, heads=4, feedforward_dim=32, decoder_layers=2, map_channels=TINY_CHANNELS)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("data")
    settings = {"size": (96, 64), "jobs": 1, "progress": False, "images_per_scene": 6}
    render(RenderOptions(out, images=6, **settings))
    render(RenderOptions(out, split="val", images=6, first_scene=900000, **settings))
    return out


def steps(out, count: int, **changes) -> StepOptions:
    settings = {"steps": count, "batch": 3, "warmup": 2, "save_every": 2, "precision": "float32", "learning_rate": 3e-3}
    return StepOptions(out, **(settings | changes))


def rows(folder) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_the_detector_learns_a_handful_of_images_by_heart(data, tmp_path):
    options = TrainDetectorOptions(data, data / "cache", steps(tmp_path, 24), TINY, NO_CHANGE)
    train_detector(options)
    first, last = rows(tmp_path)[0], rows(tmp_path)[-1]
    assert last["heat"] < first["heat"]
    assert last["sides"] < first["sides"]
    assert {"precision", "recall", "val_point_error"} <= set(last)


@pytest.mark.parametrize(("fine_tune", "optimizer"), [(False, "adamw"), (True, "muon")])
def test_an_interrupted_training_ends_as_an_uninterrupted_one(data, tmp_path, fine_tune, optimizer):
    def train(out, most: int | None = None):
        torch.manual_seed(3)
        schedule = steps(out, 4, max_steps=most, optimizer=optimizer)
        options = TrainEmbeddedOptions(data, data / "cache", schedule, TINY_POET, fine_tune=fine_tune, val_images=3)
        return train_embedded(options, SmallDetector(TINY))

    whole = train(tmp_path / "whole")
    train(tmp_path / "halves", 3)
    assert [row["step"] for row in rows(tmp_path / "halves")] == [2, 3]
    resumed = train(tmp_path / "halves")
    for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values()):
        torch.testing.assert_close(a, b, msg=name)
    assert rows(tmp_path / "halves")[-1]["step"] == 4


def test_a_frozen_detector_stays_as_it_is(data, tmp_path):
    torch.manual_seed(0)
    detector = SmallDetector(TINY)
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    options = TrainEmbeddedOptions(data, data / "cache", steps(tmp_path, 2), TINY_POET, val_images=3)
    trained = train_embedded(options, detector)
    for name, value in trained.backbone[0].state_dict().items():
        torch.testing.assert_close(value, before[name])
    assert {"t_cm", "r_deg", "auc_add_s", "coverage_t"} <= set(rows(tmp_path)[-1])


def test_predictions_with_the_detectors_boxes_are_those_with_true_boxes_where_it_finds_them(data):
    """Of image 0 the detector sees everything exactly, and a worse box beside it; of image 1 nothing; of others all."""
    torch.manual_seed(0)
    models = load_models(data / "models")
    images = PackedImages(pack(data / "val", data / "cache" / "val"), models)
    network = PoET(TINY_POET, SmallDetector(TINY))
    samples = [images.sample(n, np.random.default_rng(0)) for n in range(4)]

    def exactly(features):
        rows = []
        for number, sample in enumerate(samples):
            good = np.concatenate([sample.boxes, np.full((len(sample.boxes), 1), 0.9), sample.classes[:, None]], 1)
            worse = good[:1] + [0, 0, 9, 9, -0.4, 0]
            kinds = [np.concatenate([worse, good]) if len(good) < 10 else good, good[:0], good, good]
            rows.append(torch.from_numpy(kinds[number]).float())
        return rows

    network.detector.detect = exactly
    true, seen = (predict(network, images, 4, models, kind) for kind in ("gt", "bb"))
    counts = [len(sample.classes) for sample in samples]
    of_image = np.repeat(np.arange(4), counts)
    kept = np.isin(of_image, [2, 3])
    assert len(seen[0]) == sum(counts) - counts[1]
    found = np.repeat([0, 2, 3], [counts[0], counts[2], counts[3]])
    for one, other in zip(true[:3], seen[:3]):
        np.testing.assert_allclose(other.numpy()[np.isin(found, [2, 3])], one.numpy()[kept], atol=1e-5)
    for one, other in zip(true[3].columns, seen[3].columns):
        np.testing.assert_array_equal(other.numpy(), one.numpy()[of_image != 1])
    near = np.abs(seen[0].numpy() - true[0].numpy()[of_image != 1]).max(axis=1)
    assert near[: counts[0]].max() < 0.05  # one more query changes what the others say a little, a worse box much more


def test_a_pass_shows_every_image_once():
    numbers = np.concatenate([batch_numbers(step, 4, 10, 0) for step in range(5)])
    assert sorted(numbers[:10]) == sorted(numbers[10:]) == list(range(10))
    assert list(numbers[:10]) != list(numbers[10:])


def truth_of(R: np.ndarray, t: np.ndarray, axis=(0.0, 0.0, 0.0)) -> Truth:
    count = len(R)
    tensors = (torch.from_numpy(a).float() for a in (t, R, np.tile(axis, (count, 1)), np.ones((count, 2))))
    return Truth(*tensors, torch.ones(count, dtype=torch.int64))


def test_rotation_errors_are_angles_and_ignore_the_turn_of_symmetric_objects():
    rng = np.random.default_rng(0)
    R, t = Rotation.random(6, rng=rng).as_matrix(), rng.normal(size=(6, 3))
    vectors = rng.normal(size=(6, 3))
    errors = Rotation.from_rotvec(vectors)
    found = torch.from_numpy(errors.as_matrix() @ R).float()
    angles = errors.magnitude()
    np.testing.assert_allclose(half_sines(found, truth_of(R, t)), np.sin(angles / 2), atol=1e-5)
    e = pose_errors(torch.from_numpy(t + 0.01).float(), found, truth_of(R, t)).numpy()
    np.testing.assert_allclose(e, np.concatenate([np.full((6, 3), 0.01), errors.as_rotvec()], 1), atol=2e-4)

    turned = torch.from_numpy(R @ Rotation.from_euler("z", 1.3).as_matrix()).float()
    symmetric = truth_of(R, t, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(half_sines(turned, symmetric), 0, atol=1e-6)
    np.testing.assert_allclose(pose_errors(symmetric.t, turned, symmetric).numpy(), 0, atol=1e-3)
    tilted = Rotation.from_euler("x", 0.2).as_matrix()
    e = pose_errors(symmetric.t, torch.from_numpy(R @ tilted).float() @ torch.eye(3), symmetric)
    np.testing.assert_allclose(e[:, 3:].norm(dim=1), 0.2, atol=1e-4)


def test_the_likelihood_is_best_at_the_true_spread():
    error = torch.from_numpy(np.random.default_rng(0).laplace(scale=0.02 / np.sqrt(2), size=(4000, 6))).float()
    spreads = torch.tensor([0.01, 0.014, 0.02, 0.028, 0.04])
    values = [float(robust_likelihood(error, (2 * sigma.log()).expand(4000, 6))) for sigma in spreads]
    assert int(np.argmin(values)) == 2


def test_the_learning_rate_rises_then_falls_to_its_share(tmp_path):
    options = StepOptions(tmp_path, steps=100, warmup=10, learning_rate=1.0, final_share=0.01)
    rates = [learning_rate_at(step, options) for step in range(101)]
    assert rates[0] == pytest.approx(0.1)
    assert max(rates) == pytest.approx(1.0)
    assert rates[100] == pytest.approx(0.01)
    assert np.all(np.diff(rates[10:]) < 0)


def test_a_depth_behind_the_camera_still_has_a_slope():
    """A directly predicted depth starts anywhere: its logarithm alone would be no number and stop the training."""
    ratio = torch.tensor([-3.0, 0.0, 0.19999, 0.20001, 0.5, 1.0, 4.0], requires_grad=True)
    losses = depth_losses(ratio)
    losses.sum().backward()
    np.testing.assert_allclose(losses[3:].detach(), ratio[3:].detach().log().abs(), rtol=1e-6)
    assert losses[2].item() == pytest.approx(losses[3].item(), abs=1e-3)  # continuous, and so is its slope
    np.testing.assert_allclose(ratio.grad[:4], -5.0, rtol=1e-3)
    np.testing.assert_allclose(ratio.grad[[4, 6]], [-2.0, 0.25])
