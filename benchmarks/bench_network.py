"""The pose network at its published size on a CPU: ours beside a plain PyTorch one, paired in one run, at equal poses.

    python benchmarks/bench_network.py [--rounds 5] [--threads 1] [--compile] [--no-runtimes] [--no-training]

d 256, 5 + 5 layers, 16 heads, 4 levels of a 640x480 image (6,380 tokens), 10 queries, batch 1, detector not included.
The plain network samples with grid_sample per level and reads out every decoder layer, as the public reference of the
operator and the official code do.  Every round times all rows one after the other; a ratio is the median over the
rounds of plain / row, in CPU time of this process, with its least and largest value.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor, nn

from poet_loc.core.input_error import InputError
from poet_loc.model import deformable_attention
from poet_loc.model.backbone import Features
from poet_loc.model.export import PoseGraph, write_onnx
from poet_loc.model.exported import graph_arrays, load_graph
from poet_loc.model.fast_poses import FastPoses
from poet_loc.model.losses import LossOptions, PoseLoss
from poet_loc.model.matcher import PoseTargets
from poet_loc.model.options import PUBLISHED
from poet_loc.model.poet import PoET, QueryContext
from poet_loc.model.queries import QueryBoxes, queries_from_detections

SIZE = (480, 640)
Poses = tuple[Tensor, Tensor]


@contextmanager
def plain_sampling() -> Iterator[None]:
    """Sample with grid_sample, level by level."""
    fused = deformable_attention.sample
    deformable_attention.sample = deformable_attention.sample_plain
    try:
        yield
    finally:
        deformable_attention.sample = fused


def make_network() -> PoET:
    """Return a network with random weights whose queries look some cells around."""
    torch.manual_seed(0)
    network = PoET(PUBLISHED)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            wide = "sampling_offsets" in name or "attention_weights" in name
            parameter.add_(torch.randn(parameter.shape) * (0.03 if wide else 0.01))
    return network.eval()


def make_input() -> tuple[Features, Tensor, QueryBoxes, PoseTargets]:
    """Return maps, mask and ten boxes across the image, and targets for a training step."""
    generator = torch.Generator().manual_seed(1)
    maps = [
        torch.randn(1, c, SIZE[0] // s, SIZE[1] // s, generator=generator)
        for c, s in zip(PUBLISHED.map_channels, PUBLISHED.map_strides)
    ]
    corner = torch.rand(10, 2, generator=generator) * torch.tensor([480.0, 330.0])
    side = torch.rand(10, 2, generator=generator) * 100 + 50
    label = torch.randint(1, 22, (10, 1), generator=generator).float()
    rows = torch.cat([corner, corner + side, torch.rand(10, 1, generator=generator), label], 1)
    queries = queries_from_detections([rows], SIZE, 10)
    targets = PoseTargets(queries.boxes[0], queries.classes[0], torch.rand(10, 3), torch.eye(3).repeat(10, 1, 1))
    return Features(tuple(maps), SIZE), torch.zeros(1, *SIZE, dtype=torch.bool), queries, targets


def all_heads(network: PoET, features: Features, mask: Tensor, queries: QueryBoxes) -> Poses:
    """Do what the official code does in inference: read out every decoder layer."""
    tokens = network.tokens(features.maps, mask)
    memory = network.transformer.encode(tokens)
    position, content = network.query_codes(queries)
    states = network.transformer.decode(memory, tokens, content, position, queries.boxes)
    for layer, state in enumerate(states[:-1]):
        network.translation_head[layer](state), network.rotation_head[layer](state)
    final = network.read_last(states[-1], queries, QueryContext(queries.boxes, queries.classes, SIZE, None))
    return final.translation, final.rotation


def cpu_seconds(work: Callable[[], object]) -> tuple[float, object]:
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def rows_of(
    network: PoET, features: Features, mask: Tensor, queries: QueryBoxes, arguments: argparse.Namespace, folder: Path
) -> dict[str, Callable[[], Poses]]:
    """Return what is timed, by name; the plain network first."""

    def plain() -> Poses:
        with plain_sampling(), torch.no_grad():
            return all_heads(network, features, mask, queries)

    def of(engine: object) -> Callable[[], Poses]:
        def work() -> Poses:
            with torch.no_grad():
                output = engine.poses(features, mask, queries)  # type: ignore[attr-defined]
            return output.translation, output.rotation

        return work

    rows = {
        "plain PyTorch": plain,
        "ours, eager": of(network),
        "ours, fast": of(FastPoses(network)),
        "ours, fast, bfloat16": of(FastPoses(network, "bfloat16")),
    }
    if arguments.compile:
        compiled = torch.compile(PoseGraph(network, SIZE), dynamic=False)
        inputs = graph_inputs(network, features, queries)

        def work() -> Poses:
            with plain_sampling(), torch.no_grad():
                return compiled(*inputs)[:2]

        rows["torch.compile of the plain graph"] = work
    if arguments.runtimes:
        rows |= runtime_rows(network, features, queries, arguments.threads, folder)
    return rows


def graph_inputs(network: PoET, features: Features, queries: QueryBoxes) -> tuple:
    with torch.no_grad():
        position, content = network.query_codes(queries)
    return list(features.maps), position, content, queries.boxes, queries.classes, torch.zeros(1, 4)


def runtime_rows(
    network: PoET, features: Features, queries: QueryBoxes, threads: int, folder: Path
) -> dict[str, Callable[[], Poses]]:
    """Return onnxruntime and OpenVINO in float32, and onnxruntime with int8 matrix products."""
    arrays = graph_arrays(graph_inputs(network, features, queries))
    path = folder / "poses.onnx"
    try:
        write_onnx(PoseGraph(network, SIZE), path)
        files = {"onnxruntime": path}
        import openvino

        openvino.save_model(openvino.convert_model(str(path)), str(folder / "poses.xml"), compress_to_fp16=False)
        files["OpenVINO, f32"] = folder / "poses.xml"
        from onnxruntime.quantization import QuantType, quantize_dynamic

        quantize_dynamic(str(path), str(folder / "int8.onnx"), weight_type=QuantType.QInt8, per_channel=True)
        files["onnxruntime, int8"] = folder / "int8.onnx"
    except (InputError, ImportError) as error:
        print(f"left out: {error}")
    rows: dict[str, Callable[[], Poses]] = {}
    for name, file in files.items():
        run = load_graph(file, threads)

        def work(run: Callable = run) -> Poses:
            found = run(arrays)
            return torch.from_numpy(found[0]), torch.from_numpy(found[1])

        rows[name] = work
    return rows


def matrix_products() -> list[tuple[int, int, int]]:
    """Return (rows, inputs, outputs) of every matrix product of the plain network."""
    tokens, d, hidden, samples = 6380, 256, 1024, 16 * 4 * 4
    layer = [(tokens, d, d)] * 2 + [(tokens, d, 3 * samples), (tokens, d, hidden), (tokens, hidden, d)]
    projections = [(4800, 256, d), (1200, 512, d), (300, 1024, d), (80, 9216, d)]
    return 5 * layer + 5 * [(tokens, d, d)] + projections


def limit_seconds() -> tuple[float, float]:
    """Return CPU seconds and GFLOP of torch.mm on the shapes of the network."""
    seconds = gflop = 0.0
    for rows, inputs, outputs in matrix_products():
        a, b = torch.randn(rows, inputs), torch.randn(inputs, outputs)
        seconds += cpu_seconds(lambda a=a, b=b: a @ b)[0]
        gflop += 2e-9 * rows * inputs * outputs
    return seconds, gflop


def report(times: dict[str, list[float]], poses: dict[str, Poses], limits: list[tuple[float, float]]) -> None:
    """Print the table."""
    plain = times["plain PyTorch"]
    gflop = limits[0][1]
    mm = statistics.median(seconds for seconds, _ in limits)
    reference = poses["plain PyTorch"]
    scale = reference[0].std().item()
    print(f"\ntorch.mm on the shapes of the plain network's {gflop:.1f} GFLOP: {gflop / mm:.0f} GFLOP/s (float32)")
    print("share of it: that time / the row's time; the fast path leaves products out, bfloat16 is another unit\n")
    print(f"| {'':32} | times faster | min - max | share of torch.mm | translation differs | rotation differs |")
    print(f"|{'-' * 34}|---|---|---|---|---|")
    for name, seconds in times.items():
        ratios = [p / s for p, s in zip(plain, seconds)]
        rate = mm / statistics.median(seconds)
        found = poses[name]
        dt = (found[0] - reference[0]).abs().max().item()
        dr = rotation_difference(found[1], reference[1])
        spread = f"{min(ratios):.2f} - {max(ratios):.2f}"
        print(
            f"| {name:32} | {statistics.median(ratios):.2f} | {spread} | {100 * rate:.0f} % "
            f"| {dt:.1e} ({dt / scale:.1e} of the spread) | {dr:.1e} deg |"
        )


def rotation_difference(a: Tensor, b: Tensor) -> float:
    """Return the largest angle between matrices, degrees."""
    chord = (a.double() - b.double()).flatten(-2).norm(dim=-1) / 8**0.5
    return float(torch.rad2deg(2 * torch.asin(chord.clamp(max=1))).max())


def training_step(
    network: nn.Module, features: Features, mask: Tensor, queries: QueryBoxes, targets: PoseTargets
) -> float:
    network.train()
    torch.manual_seed(0)
    output = network.poses(features, mask, queries)  # type: ignore[operator]
    loss = PoseLoss(PUBLISHED, LossOptions(), "gt")(output, [targets])["total"]
    network.zero_grad(set_to_none=True)
    loss.backward()
    return float(loss)


def bench_training(rounds: int) -> None:
    network = make_network()
    features, mask, queries, targets = make_input()
    work = (network, features, mask, queries, targets)
    ratios, losses = [], []
    training_step(*work)
    for _ in range(rounds):
        with plain_sampling():
            plain, loss = cpu_seconds(lambda: training_step(*work))
        ours, own_loss = cpu_seconds(lambda: training_step(*work))
        ratios.append(plain / ours)
        losses.append((loss, own_loss))
    print(f"\ntraining step (forward, loss, backward; dropout on): {statistics.median(ratios):.2f} times faster")
    print(f"  min - max {min(ratios):.2f} - {max(ratios):.2f}; loss {losses[0][0]:.6f} and {losses[0][1]:.6f}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--runtimes", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--training", action=argparse.BooleanOptionalAction, default=True)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    torch.set_num_threads(arguments.threads)
    network = make_network()
    features, mask, queries, _ = make_input()
    with tempfile.TemporaryDirectory() as folder:
        rows = rows_of(network, features, mask, queries, arguments, Path(folder))
        poses = {name: work() for name, work in rows.items()}  # warms up, too
        times: dict[str, list[float]] = {name: [] for name in rows}
        limits = []
        for _ in range(arguments.rounds):
            for name, work in rows.items():
                times[name].append(cpu_seconds(work)[0])
            limits.append(limit_seconds())
    report(times, poses, limits)
    if arguments.training:
        bench_training(max(arguments.rounds // 2, 2))


if __name__ == "__main__":
    main()
