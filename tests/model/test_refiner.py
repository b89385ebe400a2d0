"""The refiner inside a network: what it may and may not change, and its place in a checkpoint."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from official_fixture import random_features, small_options
from scipy.spatial.transform import Rotation
from tiny_data import tiny_network

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import batch_images
from poet_loc.model.checkpoint import ModelConfig, load_model, save_model
from poet_loc.model.poet import PoET
from poet_loc.model.queries import stack_queries
from poet_loc.model.refiner import Estimates, PoseRefiner, RefinerOptions
from poet_loc.train.options import DataOptions, TrainOptions
from poet_loc.train.start import starting_network

OPTIONS = RefinerOptions(class_count=3, points=50, widths=(8, 8, 8), rounds=2)


def refiner(options: RefinerOptions = OPTIONS) -> PoseRefiner:
    torch.manual_seed(0)
    made = PoseRefiner(options)
    points = 0.2 * torch.rand(options.class_count, options.points, 3) - 0.1
    made.show(points, torch.randint(0, 255, points.shape, dtype=torch.uint8), torch.full((3,), 0.3))
    torch.nn.init.normal_(made.flow.weight, std=0.5)
    return made.eval()


def scene(count: int = 4) -> tuple[torch.Tensor, torch.Tensor, Estimates]:
    torch.manual_seed(1)
    images, intrinsics = torch.rand(2, 3, 120, 160), torch.tensor([[200.0, 200.0, 80.0, 60.0]] * 2)
    t = torch.tensor([0.0, 0.0, 0.8]) + 0.1 * torch.rand(count, 3)
    R = torch.from_numpy(Rotation.random(count, random_state=1).as_matrix()).float()
    return images, intrinsics, Estimates(torch.arange(count) % 2, 1 + torch.arange(count) % 3, t, R)


def test_objects_are_refined_as_if_each_were_alone():
    images, intrinsics, start = scene()
    model = refiner()
    together = model(images, intrinsics, start)
    assert (together.translation - start.translation).abs().max() > 1e-4
    for k in range(4):
        alone = Estimates(
            start.image[k, None], start.classes[k, None], start.translation[k, None], start.rotation[k, None]
        )
        found = model(images, intrinsics, alone)
        torch.testing.assert_close(found.translation[0], together.translation[k], atol=1e-5, rtol=0)
        torch.testing.assert_close(found.rotation[0], together.rotation[k], atol=1e-5, rtol=0)
        torch.testing.assert_close(found.log_variance[0], together.log_variance[k], atol=1e-4, rtol=0)


def test_rotations_stay_rotations():
    images, intrinsics, start = scene()
    R = refiner()(images, intrinsics, start).rotation
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
    assert (torch.linalg.det(R) > 0).all()


def test_flow_of_nothing_leaves_the_poses():
    images, intrinsics, start = scene()
    model = refiner()
    torch.nn.init.zeros_(model.flow.weight)
    found = model(images, intrinsics, start)
    torch.testing.assert_close(found.translation, start.translation, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.rotation, start.rotation, atol=1e-6, rtol=0)


def test_an_object_that_is_out_of_sight_or_no_object_at_all_does_no_harm():
    images, intrinsics, start = scene()
    start.translation[0] = torch.tensor([3.0, 0.0, 0.5])
    assert torch.isfinite(refiner()(images, intrinsics, start).translation).all()
    empty = Estimates(*(part[:0] for part in (start.image, start.classes, start.translation, start.rotation)))
    assert len(refiner()(images, intrinsics, empty).translation) == 0


def networks() -> tuple[PoET, PoET]:
    torch.manual_seed(2)
    options = replace(small_options(), class_count=3)
    plain = PoET(options).eval()
    with_refiner = PoET(options, refiner=refiner()).eval()
    with_refiner.load_state_dict(plain.state_dict(), strict=False)
    return plain, with_refiner


def test_a_network_refines_its_real_queries_and_needs_intrinsics():
    plain, refined = networks()
    batch = batch_images([torch.rand(3, 64, 96)] * 2, torch.tensor([[90.0, 90.0, 48.0, 32.0]] * 2), 16)
    boxes = [torch.tensor([[0.5, 0.5, 0.3, 0.3]]), torch.tensor([[0.4, 0.5, 0.2, 0.3], [0.6, 0.5, 0.2, 0.2]])]
    queries = stack_queries(boxes, [torch.tensor([1]), torch.tensor([2, 3])], plain.options.queries)
    features = random_features(2, (64, 96))
    with torch.no_grad():
        output = plain.poses(features, batch.mask, queries)
        away = replace(output, translation=output.translation + torch.tensor([0.0, 0.0, 1.0]))
        end = refined.refined(batch, away)
        assert plain.refined(batch, away) is away
    changed = (end.translation - away.translation).abs().amax(-1) > 0
    assert changed.tolist() == [[True] + [False] * 4, [True, True] + [False] * 3]
    assert end.translation_uncertainty.shape == end.rotation_uncertainty.shape == (2, 5, 3)
    with pytest.raises(ValueError, match="intrinsics"):
        refined.refined(replace(batch, intrinsics=None), away)


def test_a_checkpoint_keeps_the_refiner_and_its_models(tmp_path):
    _, network = networks()
    save_model(tmp_path / "with.safetensors", network, ModelConfig(network.options, refiner=OPTIONS))
    loaded, config = load_model(tmp_path / "with.safetensors")
    assert config.refiner == OPTIONS
    assert loaded.refiner is not None
    assert loaded.refiner.colours.dtype == torch.uint8
    images, intrinsics, start = scene()
    assert torch.equal(
        loaded.refiner(images, intrinsics, start).translation, network.refiner(images, intrinsics, start).translation
    )
    network.refiner = None
    save_model(tmp_path / "without.safetensors", network, ModelConfig(network.options))
    assert load_model(tmp_path / "without.safetensors")[0].refiner is None


def test_training_on_other_objects_leaves_the_refiner_behind(tmp_path):
    network, config = tiny_network()
    network.refiner = refiner()
    save_model(tmp_path / "start.safetensors", network, replace(config, refiner=OPTIONS))
    options = TrainOptions(tmp_path / "run", DataOptions(tmp_path), start=tmp_path / "start.safetensors")
    same, told, anew = starting_network(options, config.object_ids)
    assert same.refiner is not None
    assert told.refiner == OPTIONS
    assert torch.equal(same.refiner.points, network.refiner.points)
    assert not anew
    other, told, _ = starting_network(options, (7, 8))
    assert other.refiner is told.refiner is None


@pytest.mark.parametrize("name", ["class_count", "points", "rounds"])
def test_options_that_make_no_sense_are_refused(name):
    with pytest.raises(InputError, match=name.replace("_", "-")):
        RefinerOptions(**{name: 0})
