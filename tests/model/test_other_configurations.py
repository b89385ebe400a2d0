"""Every official option: checkpoint with its Namespace, converted, loaded and run, against the network in numpy."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from official_fixture import FixtureA, without_dropout
from reference_network import OFFICIAL_ARGUMENTS, Read, Weights, forward
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from poet_loc.model.backbone import Features
from poet_loc.model.checkpoint import load_model
from poet_loc.model.fast_poses import FastPoses
from poet_loc.model.heads import rotation_matrices
from poet_loc.model.losses import LossOptions, PoseLoss
from poet_loc.model.matcher import PoseTargets
from poet_loc.model.official_checkpoint import ConvertCheckpoint, convert_checkpoint
from poet_loc.model.poet import PoET
from poet_loc.model.queries import QueryBoxes, queries_from_detections

CHANNELS = {"yolov4": (16, 24, 32)}
CONFIGURATIONS = {
    "as published": {},
    "learned queries": {"query_embedding": "learned"},
    "learned references": {"reference_points": "learned"},
    "both learned": {"query_embedding": "learned", "reference_points": "learned"},
    "quaternions": {"rotation_representation": "quat"},
    "silhouette quaternions": {"rotation_representation": "silho_quat"},
    "agnostic": {"class_mode": "agnostic"},
    "agnostic, quaternions, all learned": {
        "class_mode": "agnostic", "rotation_representation": "quat", "query_embedding": "learned",
        "reference_points": "learned", "position_embedding": "learned",
    },
    "aleatoric": {"aleatoric": True},
    "aleatoric, agnostic, learned queries": {"aleatoric": True, "class_mode": "agnostic", "query_embedding": "learned"},
    "learned positions": {"position_embedding": "learned"},
    "six levels": {"num_feature_levels": 6},
    "as many levels as maps": {"num_feature_levels": 3},
    "other sizes": {
        "enc_layers": 1, "dec_layers": 3, "nheads": 8, "hidden_dim": 32, "dim_feedforward": 40, "enc_n_points": 2,
        "dec_n_points": 5, "num_queries": 3, "n_classes": 4,
    },
}  # fmt: skip
SIZES = [(96, 128), (80, 112), (96, 96)]


def arguments_of(name: str) -> dict:
    return OFFICIAL_ARGUMENTS | CONFIGURATIONS[name]


def random_weights(a: dict, seed: int = 0) -> dict[str, torch.Tensor]:
    """Every tensor of the official state dict of some arguments, written out by name and shape."""
    d, levels, heads, ffn = a["hidden_dim"], a["num_feature_levels"], a["nheads"], a["dim_feedforward"]
    shapes: dict[str, tuple[int, ...]] = {"transformer.level_embed": (levels, d)}

    def dense(name: str, outputs: int, inputs: int) -> None:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outputs, inputs), (outputs,)

    def attention(name: str, points: int) -> None:
        dense(f"{name}.sampling_offsets", heads * levels * points * 2, d)
        dense(f"{name}.attention_weights", heads * levels * points, d)
        dense(f"{name}.value_proj", d, d)
        dense(f"{name}.output_proj", d, d)

    for level in range(levels):
        maps = CHANNELS["yolov4"]
        inputs, kernel = (maps[level], 1) if level < len(maps) else (maps[-1] if level == len(maps) else d, 3)
        shapes[f"input_proj.{level}.0.weight"] = (d, inputs, kernel, kernel)
        shapes |= {f"input_proj.{level}.{part}": (d,) for part in ("0.bias", "1.weight", "1.bias")}
    dense("transformer.reference_points", 2, d)
    for part, norms in (("encoder", 2), ("decoder", 3)):
        for i in range(a[f"{part[:3]}_layers"]):
            name = f"transformer.{part}.layers.{i}"
            attention(f"{name}.{'self' if part == 'encoder' else 'cross'}_attn", a[f"{part[:3]}_n_points"])
            if part == "decoder":
                shapes[f"{name}.self_attn.in_proj_weight"] = (3 * d, d)
                shapes[f"{name}.self_attn.in_proj_bias"] = (3 * d,)
                dense(f"{name}.self_attn.out_proj", d, d)
            dense(f"{name}.linear1", ffn, d)
            dense(f"{name}.linear2", d, ffn)
            shapes |= {f"{name}.norm{k + 1}.{leaf}": (d,) for k in range(norms) for leaf in ("weight", "bias")}
    slots = a["n_classes"] + 1 if a["class_mode"] == "specific" else 1
    heads_of = {"translation_head": 3, "rotation_head": 6 if a["rotation_representation"] == "6d" else 4}
    if a["aleatoric"]:
        heads_of |= {"translation_head_aleatoric": 3, "rotation_head_aleatoric": 3}
    for head, numbers in heads_of.items():
        for i in range(a["dec_layers"]):
            for k, outputs in enumerate((d, d, numbers * slots)):
                dense(f"{head}.{i}.layers.{k}", outputs, d)
    if a["query_embedding"] == "learned":
        shapes["query_embed.weight"] = (a["num_queries"], 2 * d)
    if a["position_embedding"] == "learned":
        shapes |= {f"backbone.1.{axis}_embed.weight": (50, d // 2) for axis in ("row", "col")}
    generator = torch.Generator().manual_seed(seed)
    weights = {}
    for name, shape in shapes.items():
        scale = 1.0 if "embed" in name or "sampling_offsets.bias" in name else 1.5 / max(shape[1:] or (4,)) ** 0.5
        weights[name] = scale * torch.randn(shape, generator=generator)
        if ".norm" in name or (name.startswith("input_proj") and ".1." in name):
            weights[name] = weights[name] + (1.0 if name.endswith("weight") else 0.0)
    return weights


def inputs(a: dict, seed: int = 1) -> tuple[list[np.ndarray], np.ndarray, list[np.ndarray]]:
    """Maps, mask and detections of three images of different sizes: some, too many, and none."""
    rng = np.random.default_rng(seed)
    maps = [
        rng.normal(size=(3, c, 96 // s, 128 // s)).astype(np.float32) for c, s in zip(CHANNELS["yolov4"], (8, 16, 32))
    ]
    mask = np.ones((3, 96, 128), bool)
    for image, (height, width) in enumerate(SIZES):
        mask[image, :height, :width] = False
    detections = []
    for count in (2, 7, 0):
        corner, side = rng.uniform(0, 60, (count, 2)), rng.uniform(10, 35, (count, 2))
        label = rng.integers(1, a["n_classes"] + 1, (count, 1))
        rows = np.concatenate([corner, corner + side, rng.uniform(size=(count, 1)), label], 1)
        detections.append(rows.astype(np.float32))
    return maps, mask, detections


@pytest.fixture(params=CONFIGURATIONS)
def case(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[dict, Weights, PoET]:
    """Arguments, weights in float64, and the network that `convert checkpoint` made of them."""
    a = arguments_of(request.param)
    weights = random_weights(a)
    optimizer = {"state": {}, "param_groups": [{"lr": 2e-4, "params": [0]}]}
    content = {"model": weights, "optimizer": optimizer, "lr_scheduler": {"last_epoch": 3}, "epoch": 3}
    torch.save({**content, "args": argparse.Namespace(**a)}, tmp_path / "in.pth")
    convert_checkpoint(ConvertCheckpoint(tmp_path / "in.pth", tmp_path / "out.safetensors"))
    network, config = load_model(tmp_path / "out.safetensors")
    assert config.network.rotation == a["rotation_representation"]
    assert config.network.reference_points == a["reference_points"]
    return a, {name: tensor.double().numpy() for name, tensor in weights.items()}, network


def run(network: PoET, a: dict) -> tuple:
    maps, mask, detections = inputs(a)
    features = Features(tuple(map(torch.from_numpy, maps)), mask.shape[1:])
    queries = queries_from_detections(
        [torch.from_numpy(rows) for rows in detections], features.image_size, a["num_queries"]
    )
    return features, torch.from_numpy(mask), queries


def expected_of(a: dict, weights: Weights) -> Read:
    maps, mask, detections = inputs(a)
    return forward(weights, a, [m.astype(float) for m in maps], mask, detections)


def close(found: torch.Tensor, expected: np.ndarray, atol: float = 2e-5) -> None:
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=atol, rtol=0)


def test_every_layer_says_what_the_reference_says(case: tuple[dict, Weights, PoET]) -> None:
    a, weights, network = case
    expected = expected_of(a, weights)
    features, mask, queries = run(network, a)
    np.testing.assert_array_equal(queries.boxes.numpy(), expected.boxes)
    np.testing.assert_array_equal(queries.classes.numpy(), expected.classes)
    assert list(queries.counts) == expected.counts
    with torch.no_grad():
        final = network.poses(features, mask, queries)
        fast = FastPoses(network).poses(features, mask, queries)
        layers = without_dropout(network).poses(features, mask, queries)
    for output in (final, fast):
        close(output.translation, expected.translation[-1])
        close(output.rotation, expected.rotation[-1], 2e-4)
    for layer, output in enumerate((*layers.auxiliary, layers)):
        close(output.translation, expected.translation[layer])
        close(output.rotation, expected.rotation[layer], 2e-4)
        if expected.log_variances is not None:
            close(output.translation_uncertainty, expected.log_variances[0][layer])
            close(output.rotation_uncertainty, expected.log_variances[1][layer])


def test_the_reference_is_the_official_network(fixture_a: FixtureA) -> None:
    a = json.loads((fixture_a.folder / "A_config.json").read_text()) | {"position_embedding": "sine", "aleatoric": True}
    tensors = fixture_a.state_dict | fixture_a.extra_aleatoric
    given = fixture_a.inputs
    maps = [given[f"backbone_feat_{level}"].double().numpy() for level in range(3)]
    detections = [given[f"detections_{image}"].numpy() for image in range(3)]
    weights = {name: tensor.double().numpy() for name, tensor in tensors.items()}
    found = forward(weights, a, maps, given["image_mask"].numpy(), detections)
    close(fixture_a.outputs["pred_translation_all_layers"], found.translation, 1e-5)
    close(fixture_a.outputs["pred_rotation_all_layers"], found.rotation, 2e-5)
    assert found.log_variances is not None
    official = fixture_a.outputs_aleatoric
    for name, values in zip(("translation", "rotation"), found.log_variances):
        close(official[f"pred_{name}_aleatoric_all_layers"], values, 1e-5)


def targets_near(queries: QueryBoxes, seed: int = 5) -> list[PoseTargets]:
    """Objects near the real queries in another order, one far from all, one of a wrong class."""
    rng = np.random.default_rng(seed)
    targets = []
    for image, count in enumerate(queries.counts):
        order = rng.permutation(count)
        boxes = queries.boxes[image, :count].double().numpy()[order] + rng.normal(size=(count, 4)) * 0.002
        labels = queries.classes[image, :count].numpy()[order].copy()
        if count > 2:
            boxes[0, :2] += 0.4
            labels[1] = labels[1] % 3 + 1
        rotation = Rotation.random(max(count, 1), rng=rng).as_matrix()[:count]
        values = boxes, rng.normal(size=(count, 3)), rotation
        tensors = [torch.from_numpy(value).float() for value in values]
        targets.append(PoseTargets(tensors[0], torch.from_numpy(labels), tensors[1], tensors[2]))
    return targets


def reference_losses(a: dict, read: Read, targets: list[PoseTargets], mode: str) -> dict[str, float]:
    """Matching and losses of the published code, pair by pair."""
    pairs = []
    for image, target in enumerate(targets):
        count = read.counts[image]
        if count == 0 or len(target.labels) == 0:
            continue
        boxes, true_boxes = read.boxes[image, :count].astype(float), target.boxes.double().numpy()
        wrong = (read.classes[image, :count, None] != target.labels.numpy()[None]).astype(float)
        gap = np.abs(boxes[:, None] - true_boxes[None])
        cost = gap.sum(-1) if mode == "gt" else gap[..., :2].sum(-1) + wrong
        for i, j in zip(*linear_sum_assignment(cost)):
            if mode == "backbone" and (
                (a["class_mode"] == "specific" and wrong[i, j]) or giou(boxes[i], true_boxes[j]) < 0.5
            ):
                continue
            pairs.append((image, i, j))
    losses = {}
    for layer in range(a["dec_layers"]):
        suffix = "" if layer == a["dec_layers"] - 1 else f"_{layer}"
        t_loss, r_loss = [], []
        for image, i, j in pairs:
            gap = targets[image].translation[j].double().numpy() - read.translation[layer, image, i]
            true_R, found = targets[image].rotation[j].double().numpy(), read.rotation[layer, image, i]
            if read.log_variances is not None:
                s_t, s_r = (s[layer, image, i] for s in read.log_variances)
                v = Rotation.from_matrix(found @ true_R.T).as_rotvec()
                t_loss.append((np.exp(-s_t) * gap**2 + s_t).sum() / 2)
                r_loss.append((np.exp(-s_r) * v**2 + s_r).sum() / 2)
                continue
            t_loss.append(np.linalg.norm(gap))
            if a["rotation_representation"] == "6d":
                cosine = (np.trace(found @ true_R.T) - 1) / 2
                r_loss.append(np.arccos(np.clip(cosine, -1 + 1e-6, 1 - 1e-6)))
                continue
            inner = float(found @ Rotation.from_matrix(true_R).as_quat(scalar_first=True))
            if a["rotation_representation"] == "quat":
                r_loss.append(-np.log(inner**2 + 1e-4))
            else:
                r_loss.append(np.log(1 - abs(inner) + 1e-4))
        losses |= {f"loss_trans{suffix}": np.mean(t_loss), f"loss_rot{suffix}": np.mean(r_loss)}
    return losses


def giou(a: np.ndarray, b: np.ndarray) -> float:
    (al, at, ar, ab), (bl, bt, br, bb) = ((x - w / 2, y - h / 2, x + w / 2, y + h / 2) for x, y, w, h in (a, b))
    shared = max(min(ar, br) - max(al, bl), 0) * max(min(ab, bb) - max(at, bt), 0)
    union = (ar - al) * (ab - at) + (br - bl) * (bb - bt) - shared
    hull = (max(ar, br) - min(al, bl)) * (max(ab, bb) - min(at, bt))
    return shared / union - (hull - union) / hull


@pytest.mark.parametrize("mode", ["gt", "backbone"])
def test_losses_of_every_configuration(case: tuple[dict, Weights, PoET], mode: str) -> None:
    a, weights, network = case
    features, mask, queries = run(network, a)
    targets = targets_near(queries)
    expected = reference_losses(a, expected_of(a, weights), targets, mode)
    loss = PoseLoss(network.options, LossOptions(translation_weight=2.0), mode)  # type: ignore[arg-type]
    network.zero_grad()
    found = loss(without_dropout(network).poses(features, mask, queries), targets)
    total = sum((2.0 if "trans" in name else 1.0) * value for name, value in expected.items())
    for name, value in (expected | {"total": total}).items():
        assert found[name].item() == pytest.approx(value, abs=2e-4, rel=2e-4), name
    found["total"].backward()
    norms = {n: float(p.grad.norm()) for n, p in network.named_parameters() if p.grad is not None}
    assert all(np.isfinite(list(norms.values())))
    for name in ("query_embed.weight", "backbone.1.row_embed.weight"):
        assert name not in weights or norms[name] > 0
    assert ("transformer.reference_points.weight" in norms) == (a["reference_points"] == "learned")


def test_quaternions_leave_as_the_rotations_they_are() -> None:
    quaternion = torch.from_numpy(Rotation.random(20, rng=np.random.default_rng(0)).as_quat(scalar_first=True))
    expected = Rotation.from_quat(quaternion.numpy(), scalar_first=True).as_matrix()
    close(rotation_matrices(quaternion), expected, 1e-12)


def test_a_checkpoint_without_arguments_takes_them_from_the_command(tmp_path: Path) -> None:
    a = arguments_of("other sizes")
    torch.save(random_weights(a), tmp_path / "bare.pth")
    options = ConvertCheckpoint(tmp_path / "bare.pth", tmp_path / "out.safetensors", heads=8, queries=3)
    config = convert_checkpoint(options).network
    named = convert_checkpoint(replace(options, target=tmp_path / "again.safetensors")).network
    assert config == named
    expected = {
        "heads": a["nheads"], "queries": a["num_queries"], "hidden_dim": a["hidden_dim"], "class_count": a["n_classes"],
        "encoder_points": a["enc_n_points"], "decoder_points": a["dec_n_points"], "encoder_layers": a["enc_layers"],
        "decoder_layers": a["dec_layers"], "feedforward_dim": a["dim_feedforward"],
    }  # fmt: skip
    assert {name: getattr(config, name) for name in expected} == expected
