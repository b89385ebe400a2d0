"""Training: it learns, resumes exactly, shares work between processes, and no empty batch breaks it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from official_fixture import small_options
from tiny_data import save_tiny, write_bop_split

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Symmetry
from poet_loc.model.checkpoint import load_model
from poet_loc.model.device import device_of
from poet_loc.model.losses import (
    LossOptions,
    PoseLoss,
    gaussian_loss,
    nearest_symmetric,
    rotation_angle,
    rotation_vector,
)
from poet_loc.model.matcher import PoseTargets, match
from poet_loc.model.poet import PoseOutput
from poet_loc.model.queries import stack_queries
from poet_loc.train.options import RECIPES, DataOptions, RecipeOptions, TrainOptions
from poet_loc.train.pose_training import train


def random_rotations(count: int, seed: int = 0) -> torch.Tensor:
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix())


def tiny_run(folder: Path, dropout: float = 0.1, **changes: object) -> TrainOptions:
    if not (folder / "start.safetensors").exists():
        save_tiny(folder / "start.safetensors", dropout=dropout)
        write_bop_split(folder / "train", 6)
        write_bop_split(folder / "val", 3, seed=1)
    options = TrainOptions(
        out=folder / "run",
        data=DataOptions(folder / "train", folder / "val"),
        recipe=RecipeOptions(epochs=2, batch=2, learning_rate=1e-3),
        start=folder / "start.safetensors",
        boxes="jitter",
        device="cpu",
    )
    return replace(options, **changes)


def rows(run: Path, kind: str = "train") -> list[dict]:
    lines = (run / "log.jsonl").read_text().splitlines()
    return [row for row in map(json.loads, lines) if row["kind"] == kind]


def test_it_learns(tmp_path: Path) -> None:
    options = tiny_run(tmp_path, boxes="gt")
    recipe = RecipeOptions(epochs=30, batch=6, learning_rate=2e-3, clip=1.0)
    options = replace(options, recipe=recipe, data=DataOptions(tmp_path / "train", tmp_path / "train"))
    run = train(options)
    losses = [row["loss_trans"] for row in rows(run)]
    assert np.mean(losses[-3:]) < 0.4 * np.mean(losses[:3])
    scores = [row["score"] for row in rows(run, "validation")]
    network, config = load_model(run / "best.safetensors")
    assert config.source["validation"]["score"] == pytest.approx(min(scores))
    assert config.object_ids == (2, 5)
    assert config.image_size == (96, 64)
    assert not network.training
    assert list((run / "tensorboard").glob("events*"))


def test_an_interrupted_run_ends_as_the_uninterrupted_one(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path, out=tmp_path / "whole")
    train(whole)
    broken = tiny_run(tmp_path, out=tmp_path / "broken", max_steps=2)
    train(broken)
    assert not (tmp_path / "broken/network.safetensors").exists()
    train(replace(broken, resume=True))
    train(replace(broken, resume=True, max_steps=None))
    a, b = (load_model(tmp_path / name / "network.safetensors")[0].state_dict() for name in ("whole", "broken"))
    for name in a:
        torch.testing.assert_close(a[name], b[name], atol=0, rtol=0)
    assert rows(tmp_path / "whole") == rows(tmp_path / "broken")


def test_resuming_another_run_or_overwriting_one_is_refused(tmp_path: Path) -> None:
    options = tiny_run(tmp_path, max_steps=1)
    train(options)
    with pytest.raises(InputError, match="already holds a run"):
        train(options)
    with pytest.raises(InputError, match="other options: seed"):
        train(replace(options, resume=True, seed=7))
    with pytest.raises(InputError, match="no run to go on with"):
        train(replace(options, resume=True, out=tmp_path / "elsewhere"))


def test_a_batch_that_nothing_fills_leaves_no_run_behind(tmp_path: Path) -> None:
    options = tiny_run(tmp_path)
    with pytest.raises(InputError, match="6 images do not fill one batch of 7"):
        train(replace(options, recipe=replace(options.recipe, batch=7)))
    assert not options.out.exists()
    # nor does one that fails before it was first saved stand in the way of the next
    image = tmp_path / "train/000001/rgb/000002.png"
    content = image.read_bytes()
    image.write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a readable image"):
        train(options)
    image.write_bytes(content)
    train(options)
    assert [row["step"] for row in rows(options.out)] == [1, 2, 3, 4, 5, 6]


def test_the_run_tells_which_network_it_trained(tmp_path: Path) -> None:
    options = tiny_run(tmp_path, max_steps=1, uncertainty="full")
    train(options)
    about = json.loads((options.out / "options.json").read_text())
    assert about["model"]["network"]["hidden_dim"] == 32  # of the file that it started from, not of the options
    assert about["model"]["network"]["uncertainty"] == "full"
    assert about["model"]["detector"]["kind"] == "small"
    assert any("covariance" in name for name in about["started_at_random"])


def test_uncertainty_heads_alone(tmp_path: Path) -> None:
    options = tiny_run(tmp_path, boxes="gt", uncertainty="full", train_only="uncertainty")
    run = train(replace(options, recipe=replace(options.recipe, epochs=1)))
    before, _ = load_model(tmp_path / "start.safetensors")
    after, config = load_model(run / "network.safetensors")
    assert config.network.uncertainty == "full"
    started = json.loads((run / "options.json").read_text())["started_at_random"]
    assert started
    assert all("_covariance" in name for name in started)
    for name, tensor in before.state_dict().items():
        torch.testing.assert_close(after.state_dict()[name], tensor, atol=0, rtol=0)
    with pytest.raises(InputError, match="nothing is left to train"):
        train(tiny_run(tmp_path, out=tmp_path / "none", train_only="uncertainty"))


def test_detector_boxes_that_find_nothing_do_not_break_training(tmp_path: Path) -> None:
    """The detector has random weights: no box overlaps an object well enough."""
    run = train(tiny_run(tmp_path, boxes="backbone", max_steps=2))
    assert all(np.isfinite(row["total"]) for row in rows(run))


def test_two_processes_agree(tmp_path: Path) -> None:
    options = tiny_run(tmp_path, dropout=0.0, boxes="gt", out=tmp_path / "one")
    train(replace(options, recipe=replace(options.recipe, batch=4)))
    script = tmp_path / "work.py"
    script.write_text(
        "import sys\nfrom dataclasses import replace\nfrom pathlib import Path\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from test_training import tiny_run\nimport torch, torch.distributed as dist\n"
        "from poet_loc.train import pose_training as stage\n"
        "folder = Path(sys.argv[1])\n"
        "torch.set_num_threads(1)\n"
        "kept = []\n"
        "step = stage._Run._step\n"
        "stage._Run._step = lambda run, batch, board: (step(run, batch, board), kept.append(run.network))[0]\n"
        "stage.train(tiny_run(folder, out=folder / 'two', boxes='gt'))\n"
        "flat = torch.cat([p.detach().reshape(-1) for p in kept[-1].parameters()])\n"
        "import os\n"
        "torch.save(flat, folder / f'rank{os.environ[\"RANK\"]}.pt')\n"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "--master-port=0"]
    command += ["--rdzv-backend=c10d", "--rdzv-endpoint=localhost:0", str(script), str(tmp_path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    first, second = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in (0, 1))
    torch.testing.assert_close(first, second, atol=0, rtol=0)
    assert len(rows(tmp_path / "two")) == 2  # six images, two processes of two images: one step an epoch
    norms = [[row["gradient_norm"] for row in rows(tmp_path / name)] for name in ("one", "two")]
    assert norms[0] == pytest.approx(norms[1], rel=1e-3)  # the same as one process with both shares of each batch
    start, _ = load_model(tmp_path / "start.safetensors")
    assert not torch.equal(first, torch.cat([p.reshape(-1) for p in start.parameters()]))


def test_a_network_that_needs_intrinsics_asks_for_them(tmp_path: Path) -> None:
    tiny_run(tmp_path)
    save_tiny(tmp_path / "ray.safetensors", translation="ray")
    (tmp_path / "d/annotations").mkdir(parents=True)
    shutil.copytree(tmp_path / "train/000001/rgb", tmp_path / "d/train")
    pose = {"position": [0, 0, 0.5], "rotation": np.eye(3).ravel().tolist()}
    images = [{"file_name": f"{i:06d}.png", "id": i, "width": 96, "height": 64, "type": "real"} for i in range(1, 7)]
    objects = [
        {"id": i, "image_id": i, "relative_pose": pose, "bbox": [9, 9, 20, 20], "category_id": 1 + i % 2}
        for i in range(1, 7)
    ]
    categories = [{"id": i, "name": str(i), "supercategory": ""} for i in range(3)]
    content = {"images": images, "annotations": objects, "categories": categories}
    (tmp_path / "d/annotations/train.json").write_text(json.dumps(content))
    data = DataOptions(tmp_path / "d/annotations/train.json")
    run = train(tiny_run(tmp_path, data=data, max_steps=1))
    assert len(rows(run)) == 1
    with pytest.raises(InputError, match="tells no intrinsics"):
        train(tiny_run(tmp_path, data=data, start=tmp_path / "ray.safetensors", out=tmp_path / "ray"))


def test_published_recipes() -> None:
    assert {name: recipe.learning_rate for name, (recipe, _) in RECIPES.items()} == {
        "paper": 2e-5,
        "code": 2e-4,
        "ycbv": 2e-4,
    }
    assert all(r.batch == 16 and r.epochs == 50 and r.clip == 0.1 for r, _ in RECIPES.values())


# losses and matching


def output_of(targets: PoseTargets, noise: float = 0.0) -> PoseOutput:
    queries = stack_queries([targets.boxes], [targets.labels], 5)
    count = len(targets.labels)
    translation = torch.zeros(1, 5, 3)
    translation[0, :count] = targets.translation + noise
    rotation = torch.eye(3).repeat(1, 5, 1, 1)
    rotation[0, :count] = targets.rotation
    return PoseOutput(translation.requires_grad_(), rotation.requires_grad_(), queries)


def some_targets(count: int = 3) -> PoseTargets:
    generator = torch.Generator().manual_seed(0)
    boxes = torch.rand(count, 4, generator=generator) * 0.3 + 0.2
    return PoseTargets(
        boxes, torch.arange(1, count + 1), torch.randn(count, 3, generator=generator), random_rotations(count).float()
    )


def test_perfect_poses_have_finite_gradients() -> None:
    targets = some_targets()
    output = output_of(targets)
    losses = PoseLoss(small_options(), LossOptions(), "gt")(output, [targets])
    losses["total"].backward()
    assert losses["loss_trans"].item() == 0
    assert losses["loss_rot"].item() == pytest.approx(1.4e-3, abs=1e-4)
    assert torch.isfinite(output.translation.grad).all()
    assert torch.isfinite(output.rotation.grad).all()


@pytest.mark.parametrize("kind", ["none", "aleatoric"])
def test_without_a_match_the_loss_is_zero_and_differentiable(kind: str) -> None:
    targets = some_targets(0)
    output = output_of(targets)
    if kind == "aleatoric":
        output = replace(
            output, translation_uncertainty=torch.zeros(1, 5, 3), rotation_uncertainty=torch.zeros(1, 5, 3)
        )
    losses = PoseLoss(small_options(uncertainty=kind), LossOptions(), "backbone")(output, [targets])
    losses["total"].backward()
    assert losses["total"].item() == 0
    assert output.translation.grad.abs().max() == 0


def test_matching_of_shuffled_boxes_and_of_twins() -> None:
    targets = replace(some_targets(4), labels=torch.tensor([1, 2, 2, 1]))
    order = torch.tensor([2, 0, 3, 1])
    queries = stack_queries([targets.boxes[order] + 0.004], [targets.labels[order]], 5)
    for mode in ("gt", "jitter", "backbone"):
        pairs = match(queries, [targets], mode)
        assert order[pairs.queries].tolist() == pairs.targets.tolist()
    wrong_class = stack_queries([targets.boxes], [torch.tensor([3, 2, 2, 1])], 5)
    assert match(wrong_class, [targets], "backbone").targets.tolist() == [1, 2, 3]
    assert len(match(wrong_class, [targets], "backbone", class_specific=False)) == 4
    away = targets.boxes.clone()
    away[0, :2] += 0.3
    assert match(stack_queries([away], [targets.labels], 5), [targets], "backbone").targets.tolist() == [1, 2, 3]


def test_rotation_vector_is_scipys_at_every_angle() -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    axes = rng.normal(size=(60, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([np.logspace(-9, -1, 20), np.linspace(0.1, 3.1, 20), np.pi - np.logspace(-8, -1, 20)])
    vectors = axes * angles[:, None]
    matrices = torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix())
    np.testing.assert_allclose(rotation_vector(matrices).numpy(), vectors, atol=1e-7)
    torch.testing.assert_close(
        rotation_angle(matrices[25:40], torch.eye(3).double()), torch.from_numpy(angles[25:40]), atol=1e-6, rtol=0
    )


def test_rotation_vector_gradient() -> None:
    tangent = torch.tensor(
        [[0.3, -0.2, 0.5], [2.0, 1.0, -1.5], [1e-3, 0.0, 0.0]], dtype=torch.float64, requires_grad=True
    )

    def log_of_exp(v: torch.Tensor) -> torch.Tensor:
        skew = torch.zeros(3, 3, 3, dtype=torch.float64)
        skew[0, 1, 2], skew[0, 2, 1], skew[1, 2, 0], skew[1, 0, 2], skew[2, 0, 1], skew[2, 1, 0] = -1, 1, -1, 1, -1, 1
        return rotation_vector(torch.matrix_exp(torch.einsum("bi,ijk->bjk", v, skew)))

    torch.autograd.gradcheck(log_of_exp, (tangent,))


@pytest.mark.parametrize("order", [2, 3, 4, "continuous"])
def test_nearest_symmetric_pose_is_the_best_of_all(order) -> None:
    from scipy.spatial.transform import Rotation

    symmetry = Symmetry((0.0, 0.6, 0.8), order)
    rotation, reference = random_rotations(20, 1), random_rotations(20, 2)
    nearest = nearest_symmetric(rotation, reference, symmetry)
    angles = np.linspace(0, 2 * np.pi, 3601) if order == "continuous" else np.arange(order) * 2 * np.pi / order
    turns = Rotation.from_rotvec(angles[:, None] * np.array([0.0, 0.6, 0.8])).as_matrix()
    every = np.einsum("bij,kjl->kbil", reference.numpy(), turns)
    best = np.min([rotation_angle(rotation, torch.from_numpy(r)).numpy() for r in every], axis=0)
    np.testing.assert_allclose(rotation_angle(rotation, nearest).numpy(), best, atol=2e-3)


def test_symmetry_aware_loss_forgives_the_turns_that_nobody_sees() -> None:
    targets = some_targets(2)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    seen = replace(targets, rotation=targets.rotation @ half_turn)
    options = LossOptions(symmetry_aware=True)
    symmetries = {1: Symmetry((0.0, 0.0, 1.0), 2)}
    loss = PoseLoss(small_options(), options, "gt", symmetries)(output_of(seen), [targets])["loss_rot"].item()
    plain = PoseLoss(small_options(), LossOptions(), "gt", symmetries)(output_of(seen), [targets])["loss_rot"].item()
    assert plain == pytest.approx(np.pi, abs=0.01)
    assert loss == pytest.approx(np.pi / 2, abs=0.01)  # one of the two objects is symmetric
    with pytest.raises(InputError, match="rotation 6d"):
        PoseLoss(small_options(rotation="quat"), options, "gt", symmetries)


def test_likelihood_against_scipy() -> None:
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(0)
    error, numbers = rng.normal(size=(4, 3)), rng.normal(size=(4, 6)) * 0.5
    from poet_loc.model.heads import covariance_matrices

    covariance = covariance_matrices(torch.from_numpy(numbers)).numpy()
    expected = -np.mean([multivariate_normal(np.zeros(3), c).logpdf(e) for c, e in zip(covariance, error)])
    constant = 1.5 * np.log(2 * np.pi)
    loss = gaussian_loss(torch.from_numpy(error), torch.from_numpy(numbers))
    assert loss.item() == pytest.approx(expected - constant)
    diagonal = gaussian_loss(torch.from_numpy(error), torch.from_numpy(numbers[:, :3] * 2))
    as_full = np.concatenate([numbers[:, :3], np.zeros((4, 3))], axis=1)
    assert diagonal.item() == pytest.approx(gaussian_loss(torch.from_numpy(error), torch.from_numpy(as_full)).item())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: RecipeOptions(batch=0), "batch is 0; give at least 1"),
        (lambda: RecipeOptions(drop_epochs=0), "drop-epochs is 0"),
        (lambda: RecipeOptions(learning_rate=float("nan")), "learning-rate is nan"),
        (lambda: TrainOptions(Path("run"), DataOptions(Path("data")), validate_every=0), "validate-every is 0"),
        (lambda: TrainOptions(Path("run"), DataOptions(Path("data")), max_steps=0), "max-steps is 0"),
        (lambda: device_of("gpu"), "unknown device 'gpu'"),
        (lambda: device_of("cuda:99"), "there is no GPU 99 here"),
    ],
)
def test_impossible_numbers_and_devices(change: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        change()
    assert device_of("auto").type in ("cpu", "cuda")
