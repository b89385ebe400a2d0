"""What must hold for any configuration: options, batches, padding, empty input, dummies, the fast path."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from official_fixture import OPTIONS_A, FixtureA, random_features, randomise, small_options, without_dropout
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Backbone, BackboneShape, Features, ImageBatch, batch_images
from poet_loc.model.fast_poses import FastPoses
from poet_loc.model.heads import rotation_matrices
from poet_loc.model.options import ABLATIONS, NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.queries import QueryBoxes, queries_from_detections, stack_queries

OFFICIAL = {
    "fixture": {},
    "learned queries": {"query_embedding": "learned"},
    "learned references": {"reference_points": "learned"},
    "both learned": {"query_embedding": "learned", "reference_points": "learned"},
    "quaternion": {"rotation": "quat"},
    "silhouette": {"rotation": "silho_quat"},
    "agnostic": {"class_mode": "agnostic"},
    "agnostic quaternion": {"class_mode": "agnostic", "rotation": "quat"},
    "aleatoric": {"uncertainty": "aleatoric"},
    "full covariance": {"uncertainty": "full"},
    "learned positions": {"position_encoding": "learned"},
    "one level": {"levels": 1, "map_channels": (16,), "map_strides": (8,)},
    "six levels": {"levels": 6},
}
VARIANTS = {
    "coarse encoder": {"encoder_maps": (1, 2, 3)},
    "no encoder": {"encoder_maps": (), "encoder_layers": 0},
    "box spread": {"reference_spread": "box"},
}


def boxes(counts: list[int], queries: int = 5, seed: int = 3) -> QueryBoxes:
    generator = torch.Generator().manual_seed(seed)
    found = []
    for count in counts:
        lower = torch.rand(count, 2, generator=generator) * torch.tensor([80.0, 60.0])
        upper = lower + 10 + torch.rand(count, 2, generator=generator) * 30
        score = torch.rand(count, 1, generator=generator)
        label = torch.randint(1, 4, (count, 1), generator=generator)
        found.append(torch.cat([lower, upper, score, label], dim=1))
    return queries_from_detections(found, (96, 128), queries)


def features_of(options: NetworkOptions, batch: int = 2) -> Features:
    features = random_features(batch)
    return replace(features, maps=features.maps[: len(options.map_channels)])


def no_padding(batch: int = 2) -> Tensor:
    return torch.zeros(batch, 96, 128, dtype=torch.bool)


def some_padding() -> Tensor:
    mask = no_padding()
    mask[0, 80:] = True
    mask[1, :, 100:] = True
    return mask


@pytest.mark.parametrize("name", [*OFFICIAL, *VARIANTS])
@pytest.mark.parametrize("mask", [no_padding(), some_padding()], ids=["whole", "padded"])
def test_fast_path_is_the_network(name: str, mask: Tensor) -> None:
    options = small_options(**{**OFFICIAL, **VARIANTS}[name])
    network = randomise(PoET(options)).eval()
    features, queries = features_of(options), boxes([3, 5])
    with torch.no_grad():
        slow = network.poses(features, mask, queries)
    fast = FastPoses(network).poses(features, mask, queries)
    torch.testing.assert_close(fast.translation, slow.translation, atol=1e-5, rtol=1e-4)
    # Random weights leave some 6-D rotations nearly parallel, and normalising those magnifies the rounding of float32.
    torch.testing.assert_close(fast.rotation, slow.rotation, atol=1e-4, rtol=1e-4)
    if options.uncertainty != "none":
        torch.testing.assert_close(fast.translation_uncertainty, slow.translation_uncertainty, atol=1e-5, rtol=1e-4)


def test_fast_path_on_the_official_fixture(fixture_a: FixtureA) -> None:
    output = FastPoses(fixture_a.network()).poses(fixture_a.features, fixture_a.mask, fixture_a.queries)
    torch.testing.assert_close(output.translation, fixture_a.outputs["pred_translation"], atol=1e-5, rtol=0)
    torch.testing.assert_close(output.rotation, fixture_a.outputs["pred_rotation"], atol=1e-5, rtol=0)


def test_bfloat16_is_close() -> None:
    network = randomise(PoET(OPTIONS_A)).eval()
    features, queries = random_features(), boxes([5, 2])
    exact = FastPoses(network).poses(features, no_padding(), queries)
    rounded = FastPoses(network, "bfloat16").poses(features, no_padding(), queries)
    assert 0 < (exact.translation - rounded.translation).abs().max() < 0.1


@pytest.mark.parametrize("name", OFFICIAL)
def test_every_option_trains(name: str) -> None:
    options = small_options(**OFFICIAL[name])
    network = without_dropout(randomise(PoET(options)))
    output = network.poses(features_of(options), some_padding(), boxes([3, 0]))
    assert len(output.auxiliary) == options.decoder_layers - 1
    rotation = rotation_matrices(output.rotation)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand_as(rotation), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(2, 5), atol=1e-5, rtol=0)
    total = output.translation.square().sum() + (rotation * torch.arange(9.0).reshape(3, 3)).sum()
    for earlier in output.auxiliary:
        total = total + earlier.translation.square().sum() + earlier.rotation.square().sum()
    total.backward()
    without_gradient = {n.rsplit(".", 1)[0] for n, p in network.named_parameters() if p.grad is None}
    allowed = {"transformer.reference_points"} if options.reference_points == "bbox" else set()
    heads = {n for n in without_gradient if "aleatoric" in n or "covariance" in n}
    assert without_gradient - heads <= allowed


def test_a_batch_is_its_images_one_by_one() -> None:
    network = randomise(PoET(OPTIONS_A)).eval()
    features, queries = random_features(3), boxes([3, 0, 9])
    with torch.no_grad():
        together = network.poses(features, no_padding(3), queries)
        for image in range(3):
            one = Features(tuple(m[image : image + 1] for m in features.maps), features.image_size)
            row = slice(image, image + 1)
            alone_queries = QueryBoxes(
                queries.boxes[row], queries.classes[row], queries.scores[row], queries.counts[row]
            )
            alone = network.poses(one, no_padding(1), alone_queries)
            torch.testing.assert_close(together.translation[row], alone.translation, atol=1e-5, rtol=1e-5)


def test_what_is_padded_does_not_matter_to_attention() -> None:
    """Values of padded tokens change nothing; GroupNorm sees them, so the projection is left out here."""
    network = randomise(PoET(OPTIONS_A)).eval()
    mask, queries = some_padding(), boxes([3, 4])
    with torch.no_grad():
        tokens = network.tokens(random_features().maps, mask)
        noisy = tokens.values + 100 * torch.randn(tokens.values.shape) * tokens.padding[..., None]
        position, content = network.query_codes(queries)
        states = []
        for values in (tokens.values, noisy):
            changed = replace(tokens, values=values)
            memory = network.transformer.encode(changed)
            states.append(network.transformer.decode(memory, changed, content, position, queries.boxes))
    torch.testing.assert_close(states[0], states[1], atol=1e-5, rtol=0)


def test_dummies_are_equal_and_take_slot_zero() -> None:
    network = randomise(PoET(OPTIONS_A)).eval()
    with torch.no_grad():
        output = network.poses(random_features(), no_padding(), boxes([2, 0]))
    torch.testing.assert_close(output.translation[0, 2:3].expand(3, 3), output.translation[0, 2:])
    torch.testing.assert_close(output.translation[1, :1].expand(5, 3), output.translation[1])
    assert output.queries.counts == (2, 0)


def test_too_many_detections_keep_the_best_in_order_of_score() -> None:
    rows = torch.zeros(7, 6)
    rows[:, 2:4] = 10.0
    rows[:, 4] = torch.tensor([0.1, 0.9, 0.3, 0.9, 0.5, 0.2, 0.7])
    rows[:, 5] = torch.arange(1.0, 8.0)
    queries = queries_from_detections([rows, rows[:3], None], (96, 128), 5)
    assert queries.classes.tolist() == [[2, 4, 7, 5, 3], [1, 2, 3, -1, -1], [-1] * 5]
    assert queries.counts == (5, 3, 0)


def test_more_given_boxes_than_queries_widen_the_batch() -> None:
    network = randomise(PoET(OPTIONS_A)).eval()
    queries = stack_queries([torch.rand(7, 4), torch.rand(2, 4)], [torch.ones(7).long(), torch.ones(2).long()], 5)
    with torch.no_grad():
        output = network.poses(random_features(), no_padding(), queries)
    assert output.translation.shape == (2, 7, 3)
    learned = PoET(small_options(query_embedding="learned")).eval()
    with pytest.raises(InputError, match="7 boxes in an image for 5 learned queries"):
        learned.poses(random_features(), no_padding(), queries)


def test_learned_positions_end_at_fifty_cells() -> None:
    network = PoET(small_options(position_encoding="learned", levels=1, map_channels=(16,), map_strides=(8,))).eval()
    features = Features((torch.randn(1, 16, 51, 20),), (408, 160))
    with pytest.raises(InputError, match="50 rows and columns, the map is 51x20"):
        network.poses(
            features,
            torch.zeros(1, 408, 160, dtype=torch.bool),
            stack_queries([torch.rand(1, 4)], [torch.ones(1).long()], 5),
        )


def test_class_beyond_the_heads_is_an_error() -> None:
    network = PoET(OPTIONS_A).eval()
    queries = stack_queries([torch.rand(1, 4)] * 2, [torch.tensor([4])] * 2, 5)
    with pytest.raises((IndexError, RuntimeError)):
        network.poses(random_features(), no_padding(), queries)


@pytest.mark.parametrize(
    "changes", [{"hidden_dim": 70}, {"heads": 5}, {"uncertainty": "full", "rotation": "quat"}, {"levels": 2}], ids=str
)
def test_impossible_options(changes: dict) -> None:
    with pytest.raises(InputError):
        small_options(**changes)


def test_ablations_differ_from_the_published_network_by_what_they_name() -> None:
    published = ABLATIONS["PoET"]
    assert ABLATIONS["RP + Q"] == replace(published, reference_points="learned", query_embedding="learned")
    assert all(options != published for name, options in ABLATIONS.items() if name != "PoET")


class _Detector(Backbone):
    """Averages colours; sees one object of class 2 in every image."""

    def __init__(self) -> None:
        super().__init__()
        self.mix = torch.nn.Conv2d(3, 16, 1)

    def shape(self) -> BackboneShape:
        return BackboneShape((16,), (8,), 3, 8)

    def extract(self, batch: ImageBatch) -> Features:
        return Features((torch.nn.functional.avg_pool2d(self.mix(batch.images), 8),), batch.size)

    def detect(self, features: Features) -> list[Tensor]:
        return [torch.tensor([[8.0, 8.0, 40.0, 48.0, 0.7, 2.0]])] * len(features.maps[0])


def test_images_to_poses_with_any_backbone() -> None:
    options = small_options(map_channels=(16,), map_strides=(8,))
    network = PoET(options, _Detector())
    assert not any(p.requires_grad for p in network.backbone[0].parameters())
    assert not network.train().backbone[0].training
    network.eval()
    batch = batch_images([torch.rand(3, 64, 96), torch.rand(3, 60, 80)], multiple=8)
    with torch.no_grad():
        output = network(batch)
    assert output.queries.counts == (1, 1)
    assert output.queries.classes[:, 0].tolist() == [2, 2]
    torch.testing.assert_close(FastPoses(network)(batch).translation, output.translation, atol=1e-5, rtol=1e-4)
    assert "backbone.0.mix.weight" in network.state_dict()
