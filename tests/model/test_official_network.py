"""Agreement with the official network: tokens, memory, states, poses, losses and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from official_fixture import FixtureA, small_options, without_dropout

from poet_loc.model.losses import LossOptions, PoseLoss
from poet_loc.model.matcher import match
from poet_loc.model.position_encoding import SinePositionEncoding, box_code


def test_tokens(fixture_a: FixtureA) -> None:
    expected, network = fixture_a.intermediates, fixture_a.network()
    with torch.no_grad():
        tokens = network.tokens(fixture_a.features.maps, fixture_a.mask)
    torch.testing.assert_close(tokens.padding, expected["mask_flatten"])
    valid = ~expected["mask_flatten"]
    torch.testing.assert_close(tokens.values[valid], expected["enc_input"][valid], atol=1e-5, rtol=0)
    torch.testing.assert_close(tokens.positions[valid], expected["enc_pos_plus_level"][valid], atol=1e-5, rtol=0)
    torch.testing.assert_close(tokens.valid_ratios, expected["valid_ratios"])


def test_memory_and_decoder_states(fixture_a: FixtureA) -> None:
    expected, network = fixture_a.intermediates, fixture_a.network()
    queries = fixture_a.queries
    with torch.no_grad():
        tokens = network.tokens(fixture_a.features.maps, fixture_a.mask)
        memory = network.transformer.encode(tokens)
        position, content = network.query_codes(queries)
        states = network.transformer.decode(memory, tokens, content, position, queries.boxes)
    valid = ~expected["mask_flatten"]
    torch.testing.assert_close(memory[valid], expected["memory"][valid], atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.cat([position, content], -1), expected["query_embed"], atol=0, rtol=0)
    torch.testing.assert_close(states, expected["hs"], atol=1e-5, rtol=0)


def test_poses_of_every_decoder_layer(fixture_a: FixtureA) -> None:
    expected = fixture_a.outputs
    with torch.no_grad():
        output = without_dropout(fixture_a.network()).poses(fixture_a.features, fixture_a.mask, fixture_a.queries)
    translation = torch.stack([o.translation for o in (*output.auxiliary, output)])
    rotation = torch.stack([o.rotation for o in (*output.auxiliary, output)])
    torch.testing.assert_close(translation, expected["pred_translation_all_layers"], atol=1e-5, rtol=0)
    torch.testing.assert_close(rotation, expected["pred_rotation_all_layers"], atol=1e-5, rtol=0)
    torch.testing.assert_close(output.queries.boxes, expected["pred_boxes"], atol=0, rtol=0)
    torch.testing.assert_close(output.queries.classes, expected["pred_classes"])
    assert output.queries.counts == tuple(expected["n_boxes_per_sample"].tolist())


def test_evaluation_mode_gives_the_last_layer_alone(fixture_a: FixtureA) -> None:
    with torch.no_grad():
        output = fixture_a.network().poses(fixture_a.features, fixture_a.mask, fixture_a.queries)
    assert output.auxiliary == ()
    torch.testing.assert_close(output.translation, fixture_a.outputs["pred_translation"], atol=1e-5, rtol=0)


def test_log_variances(fixture_a: FixtureA) -> None:
    expected = fixture_a.outputs_aleatoric
    with torch.no_grad():
        output = fixture_a.network(aleatoric=True).poses(fixture_a.features, fixture_a.mask, fixture_a.queries)
    torch.testing.assert_close(
        output.translation_uncertainty, expected["pred_translation_aleatoric"], atol=1e-5, rtol=0
    )
    torch.testing.assert_close(output.rotation_uncertainty, expected["pred_rotation_aleatoric"], atol=1e-5, rtol=0)
    torch.testing.assert_close(output.translation, fixture_a.outputs["pred_translation"], atol=1e-5, rtol=0)


def test_matches(fixture_a: FixtureA) -> None:
    matches = match(fixture_a.queries, fixture_a.pose_targets, "backbone")
    expected = [
        [image, query, target]
        for image, (queries, targets) in enumerate(fixture_a.losses["plain"]["matched"])
        for query, target in zip(queries, targets)
    ]
    assert torch.stack([matches.images, matches.queries, matches.targets], 1).tolist() == expected


@pytest.mark.parametrize("kind", ["plain", "aleatoric"])
def test_losses_and_gradients(fixture_a: FixtureA, kind: str) -> None:
    expected = fixture_a.losses[kind]
    aleatoric = kind == "aleatoric"
    network = without_dropout(fixture_a.network(aleatoric))
    options = small_options(uncertainty="aleatoric" if aleatoric else "none")
    output = network.poses(fixture_a.features, fixture_a.mask, fixture_a.queries)
    losses = PoseLoss(options, LossOptions(), "backbone")(output, fixture_a.pose_targets)
    assert losses["total"].item() == pytest.approx(expected["total_loss"], rel=1e-5)
    assert {name: losses[name].item() for name in expected["losses"]} == pytest.approx(expected["losses"], abs=1e-4)
    losses["total"].backward()
    for name, parameter in network.named_parameters():
        reference = expected["grad_norms"][name] or 0.0
        norm = 0.0 if parameter.grad is None else parameter.grad.norm().item()
        assert norm == pytest.approx(reference, rel=1e-4, abs=1e-4), name


def test_box_code_of_the_full_width(shared_fixtures) -> None:
    fixture = np.load(shared_fixtures / "poet_official/bbox_embedding_256.npz")
    code = box_code(torch.from_numpy(fixture["boxes_cxcywh"]), 256).numpy()
    np.testing.assert_allclose(code, fixture["embedding_f64"], atol=1e-6)
    np.testing.assert_allclose(code, fixture["embedding"], atol=1e-6)


def test_position_code_of_a_full_map(shared_fixtures) -> None:
    fixture = np.load(shared_fixtures / "poet_official/pos_encoding_256.npz")
    rows, columns = fixture["rowcol"].T
    mask = torch.zeros(2, 60, 80, dtype=torch.bool)
    height, width = fixture["valid_hw_padded"]
    mask[1, height:], mask[1, :, width:] = True, True
    code = SinePositionEncoding(256)(mask).numpy()
    np.testing.assert_allclose(code[0][:, rows, columns].T, fixture["pos"], atol=1e-5)
    inside = (rows < height) & (columns < width)
    assert inside.sum() >= 3
    np.testing.assert_allclose(code[1][:, rows[inside], columns[inside]].T, fixture["pos_padded"][inside], atol=1e-5)
