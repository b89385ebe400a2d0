"""Checkpoints: official ones converted without executing them, ours loaded strictly."""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from official_fixture import FixtureA, random_features, randomise, small_options

from poet_loc.core.input_error import InputError
from poet_loc.model.checkpoint import ModelConfig, load_model, read_weights, save_model, save_weights
from poet_loc.model.official_checkpoint import ConvertCheckpoint, convert_checkpoint, options_of_weights
from poet_loc.model.options import ABLATIONS, NetworkOptions
from poet_loc.model.poet import PoET
from poet_loc.model.torchvision_detector import TorchvisionOptions, current_names
from poet_loc.model.yolov4 import YoloOptions


def official_arguments(options: NetworkOptions, **more: object) -> argparse.Namespace:
    return argparse.Namespace(
        hidden_dim=options.hidden_dim,
        nheads=options.heads,
        enc_layers=options.encoder_layers,
        dec_layers=options.decoder_layers,
        dim_feedforward=options.feedforward_dim,
        num_feature_levels=options.levels,
        enc_n_points=options.encoder_points,
        dec_n_points=options.decoder_points,
        num_queries=options.queries,
        n_classes=options.class_count,
        class_mode=options.class_mode,
        rotation_representation=options.rotation,
        query_embedding=options.query_embedding,
        reference_points=options.reference_points,
        position_embedding=options.position_encoding,
        dropout=options.dropout,
        **{"backbone": "yolov4", **more},
    )


def write_official(path: Path, network: PoET, arguments: argparse.Namespace) -> None:
    content = {"model": network.state_dict(), "optimizer": {}, "lr_scheduler": {}, "epoch": 49, "args": arguments}
    torch.save(content, path)


def test_official_weights_give_the_same_poses_after_conversion(fixture_a: FixtureA, tmp_path: Path) -> None:
    source = fixture_a.folder / "A_state_dict.pth"
    convert_checkpoint(ConvertCheckpoint(source, tmp_path / "a.safetensors", heads=4, queries=5))
    network, config = load_model(tmp_path / "a.safetensors")
    assert config.network == small_options()
    with torch.no_grad():
        output = network.poses(fixture_a.features, fixture_a.mask, fixture_a.queries)
    torch.testing.assert_close(output.translation, fixture_a.outputs["pred_translation"], atol=1e-5, rtol=0)


def test_the_wrapper_of_real_checkpoints_is_read_and_its_missing_tensors_told(shared_fixtures: Path, tmp_path) -> None:
    source = shared_fixtures / "poet_official/checkpoint_wrapper_example.pth"
    with pytest.raises(InputError, match="no weights of a PoET network"):
        convert_checkpoint(ConvertCheckpoint(source, tmp_path / "x.safetensors"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "changes",
    [
        {"rotation": "silho_quat"},
        {"rotation": "quat", "class_mode": "agnostic"},
        {"query_embedding": "learned", "reference_points": "learned"},
        {"position_encoding": "learned"},
        {"uncertainty": "aleatoric"},
        {"heads": 8, "encoder_points": 2},
    ],
    ids=str,
)
def test_every_official_option_survives_conversion(changes: dict, tmp_path: Path) -> None:
    options = small_options(**changes)
    network = PoET(options)
    write_official(tmp_path / "c.pth", network, official_arguments(options, aleatoric=True))
    config = convert_checkpoint(ConvertCheckpoint(tmp_path / "c.pth", tmp_path / "c.safetensors"))
    assert config.network == options
    assert config.source["epoch"] == 49
    loaded, _ = load_model(tmp_path / "c.safetensors")
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], tensor, atol=0, rtol=0)


def test_published_sizes() -> None:
    def count(options: NetworkOptions) -> tuple[int, int]:
        with torch.device("meta"):
            network = PoET(options)
        return len(network.state_dict()), sum(p.numel() for p in network.parameters())

    published = replace(ABLATIONS["PoET"], map_channels=(256, 256, 256))
    assert count(published) == (269, 12_235_232)
    assert count(replace(published, class_mode="agnostic"))[1] == 11_992_367
    assert count(ABLATIONS["PoET"])[1] == 14_266_848


def test_official_key_table(shared_fixtures: Path) -> None:
    table = shared_fixtures.parent / "reference" / "poet_state_dict_keys.txt"
    rows = [line.split("\t") for line in table.read_text().splitlines() if line and not line.startswith("#")]
    with torch.device("meta"):
        network = PoET(replace(ABLATIONS["PoET"], map_channels=(256, 256, 256)))
    shapes = {name: str(tuple(tensor.shape)) for name, tensor in network.state_dict().items()}
    assert shapes == {row[0]: row[1] for row in rows}


@pytest.mark.parametrize("command", [os.system, eval, Path.unlink])
def test_a_hostile_pickle_is_refused_in_one_line(command: object, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.touch()

    class Hostile:
        def __reduce__(self):
            argument = victim if command is Path.unlink else f"__import__('os').remove({str(victim)!r})"
            return command, (f"rm {victim}" if command is os.system else argument,)

    torch.save({"model": {"a": torch.zeros(1)}, "args": Hostile()}, tmp_path / "hostile.pth")
    with pytest.raises(InputError, match="refused, nothing was executed") as error:
        convert_checkpoint(ConvertCheckpoint(tmp_path / "hostile.pth", tmp_path / "x.safetensors"))
    assert "\n" not in str(error.value)
    assert victim.exists()
    assert not (tmp_path / "x.safetensors").exists()


def test_damaged_files_are_told_in_one_line(tmp_path: Path) -> None:
    network = PoET(small_options())
    write_official(tmp_path / "good.pth", network, official_arguments(small_options()))
    whole = (tmp_path / "good.pth").read_bytes()
    (tmp_path / "short.pth").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.pth").write_bytes(b"")
    (tmp_path / "text.pth").write_text("hello")
    torch.save([1, 2], tmp_path / "list.pth")
    for name in ("short", "empty", "text", "list", "missing"):
        with pytest.raises(InputError) as error:
            convert_checkpoint(ConvertCheckpoint(tmp_path / f"{name}.pth", tmp_path / "x.safetensors"))
        assert "\n" not in str(error.value)


def test_wrong_arguments_are_refused(tmp_path: Path) -> None:
    options = small_options()
    network = PoET(options)
    wrong = official_arguments(options)
    wrong.enc_layers = 5
    write_official(tmp_path / "wrong.pth", network, wrong)
    with pytest.raises(InputError, match="encoder_layers is 2 by the weights and 5 by args"):
        convert_checkpoint(ConvertCheckpoint(tmp_path / "wrong.pth", tmp_path / "x.safetensors"))
    with pytest.raises(InputError, match="give --heads"):
        options_of_weights(network.state_dict(), {})
    extra = {**network.state_dict(), "class_head.weight": torch.zeros(2)}
    torch.save({"model": extra, "args": official_arguments(options)}, tmp_path / "extra.pth")
    with pytest.raises(InputError, match=r"unexpected: class_head\.weight"):
        convert_checkpoint(ConvertCheckpoint(tmp_path / "extra.pth", tmp_path / "x.safetensors"))


def test_our_file_round_trip(tmp_path: Path) -> None:
    options = small_options(uncertainty="full")
    network = randomise(PoET(options)).eval()
    config = ModelConfig(options, object_ids=(2, 5, 9), image_size=(640, 480), intrinsics=(600.0, 600.0, 320.0, 240.0))
    digest = save_model(tmp_path / "net.safetensors", network, config)
    weights, read = read_weights(tmp_path / "net.safetensors")
    assert read == config
    assert len(digest) == 64
    assert set(weights) == set(network.state_dict())
    loaded, _ = load_model(tmp_path / "net.safetensors")
    assert not loaded.training
    features = random_features()
    from poet_loc.model.queries import queries_from_detections

    queries = queries_from_detections([torch.tensor([[5.0, 6, 50, 60, 0.9, 2]])] * 2, (96, 128), 5)
    mask = torch.zeros(2, 96, 128, dtype=torch.bool)
    with torch.no_grad():
        a, b = (n.poses(features, mask, queries) for n in (network, loaded))
    torch.testing.assert_close(a.translation, b.translation, atol=0, rtol=0)
    assert read.object_id(3) == 9


def test_half_precision_file_loads_as_float32(tmp_path: Path) -> None:
    network = PoET(small_options())
    save_model(tmp_path / "half.safetensors", network, ModelConfig(small_options()), half=True)
    loaded, _ = load_model(tmp_path / "half.safetensors")
    assert all(p.dtype == torch.float32 for p in loaded.parameters())
    torch.testing.assert_close(loaded.input_proj[0][0].weight, network.input_proj[0][0].weight, atol=1e-3, rtol=1e-3)


def test_weights_that_do_not_fit_are_listed(tmp_path: Path) -> None:
    network = PoET(small_options())
    weights = network.state_dict()
    config = ModelConfig(small_options())
    del weights["transformer.level_embed"]
    weights["something.else"] = torch.zeros(1)
    weights["input_proj.0.0.bias"] = torch.zeros(3)
    save_weights(tmp_path / "wrong.safetensors", weights, config)
    with pytest.raises(InputError) as error:
        load_model(tmp_path / "wrong.safetensors")
    for part in (
        "missing: transformer.level_embed",
        "unexpected: something.else",
        "misshapen: input_proj.0.0.bias (3,)",
    ):
        assert part in str(error.value)


def test_changed_and_foreign_files_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "net.safetensors"
    save_model(path, PoET(small_options()), ModelConfig(small_options()))
    data = bytearray(path.read_bytes())
    data[-3] ^= 0xFF
    (tmp_path / "changed.safetensors").write_bytes(data)
    (tmp_path / "short.safetensors").write_bytes(path.read_bytes()[:1000])
    save_file({"a": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    for name, message in (("changed", "checksum"), ("short", "whole"), ("foreign", "no configuration")):
        with pytest.raises(InputError, match=message):
            load_model(tmp_path / f"{name}.safetensors")


def test_unknown_configuration_is_refused() -> None:
    values = ModelConfig(small_options()).to_json()
    with pytest.raises(InputError, match="no field headss"):
        ModelConfig.from_json({**values, "network": {**values["network"], "headss": 3}})
    with pytest.raises(InputError, match="unknown backbone"):
        ModelConfig.from_json({**values, "detector": {"kind": "resnet"}})


@pytest.mark.parametrize("detector", [YoloOptions(class_count=3), TorchvisionOptions(labels=((1, 1), (5, 2)))])
def test_detector_options_round_trip(detector: object) -> None:
    config = ModelConfig(small_options(), detector)
    assert ModelConfig.from_json(config.to_json()) == config
    assert asdict(config.detector) == asdict(detector)


def test_old_torchvision_names() -> None:
    old = [
        "backbone.0.backbone.fpn.inner_blocks.0.weight",
        "backbone.0.backbone.fpn.layer_blocks.3.bias",
        "backbone.0.rpn.head.conv.weight",
        "backbone.0.roi_heads.mask_head.mask_fcn4.bias",
        "backbone.0.backbone.fpn.inner_blocks.0.0.weight",
    ]
    new = list(current_names({name: torch.zeros(index) for index, name in enumerate(old)}))
    assert new == [
        "backbone.0.backbone.fpn.inner_blocks.0.0.weight",
        "backbone.0.backbone.fpn.layer_blocks.3.0.bias",
        "backbone.0.rpn.head.conv.0.0.weight",
        "backbone.0.roi_heads.mask_head.3.0.bias",
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"args": argparse.Namespace(nheads="four", num_queries=5)}, "its args do not describe a network"),
        ({"args": argparse.Namespace(nheads=4, num_queries=None)}, "does not say the number of queries"),
        ({"args": argparse.Namespace(nheads=4, num_queries=0)}, "queries is 0"),
        ({"args": argparse.Namespace(nheads=4, num_queries=5, dropout="little")}, "its args do not describe a network"),
        ({"args": argparse.Namespace(nheads=4, num_queries=5, reference_points="grid")}, "reference_points is 'grid'"),
        ({"args": "nheads=4"}, "its args are a str"),
    ],
)
def test_arguments_that_describe_no_network(fixture_a: FixtureA, tmp_path: Path, changes: dict, message: str) -> None:
    torch.save({"model": fixture_a.state_dict, "epoch": 1, **changes}, tmp_path / "in.pth")
    with pytest.raises(InputError, match=message) as error:
        convert_checkpoint(ConvertCheckpoint(tmp_path / "in.pth", tmp_path / "out.safetensors"))
    assert "in.pth" in str(error.value)
    assert not (tmp_path / "out.safetensors").exists()


def test_a_file_that_is_there_is_not_replaced_unasked(fixture_a: FixtureA, tmp_path: Path) -> None:
    torch.save(fixture_a.state_dict, tmp_path / "in.pth")
    options = ConvertCheckpoint(tmp_path / "in.pth", tmp_path / "out.safetensors", heads=4, queries=5)
    convert_checkpoint(options)
    before = options.target.read_bytes()
    with pytest.raises(InputError, match="is there already"):
        convert_checkpoint(replace(options, queries=6))
    assert options.target.read_bytes() == before
    assert convert_checkpoint(replace(options, queries=6, overwrite=True)).network.queries == 6
    with pytest.raises(InputError, match="is a folder"):
        convert_checkpoint(replace(options, target=tmp_path))


def test_the_same_weights_are_the_same_bytes(tmp_path: Path) -> None:
    weights = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(2, dtype=torch.int64)}
    config = ModelConfig(small_options())
    files = set()
    for number in range(8):  # the order of three entries differs from call to call, if left to chance
        save_weights(tmp_path / f"{number}.safetensors", weights, config)
        files.add((tmp_path / f"{number}.safetensors").read_bytes())
    assert len(files) == 1
    read, read_config = read_weights(tmp_path / "0.safetensors")
    assert read_config == config
    assert all(torch.equal(read[name], tensor) for name, tensor in weights.items())
