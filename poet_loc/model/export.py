"""The pose network as an ONNX or OpenVINO graph: the stage behind `poet-loc export`."""

from __future__ import annotations

import json
import logging
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from poet_loc.core.input_error import InputError
from poet_loc.io.whole_folder import not_there
from poet_loc.model.checkpoint import ModelConfig, load_model
from poet_loc.model.poet import PoET, QueryContext
from poet_loc.model.queries import QueryBoxes

SUFFIXES = (".onnx", ".xml")


@dataclass(frozen=True)
class ExportOptions:
    """A network as a graph for another runtime."""

    weights: Path
    """Network (.safetensors)."""
    target: Path
    """File to write: .onnx, or .xml for OpenVINO."""
    image_size: tuple[int, int] | None = None
    """(width, height) px of the images; without it that of the training images.  The graph works for no other size."""
    overwrite: bool = False
    """Replace the file."""


class PoseGraph(nn.Module):
    """The pose network with fixed image size and batch 1: maps, query codes and boxes in, poses out.

    Codes of the boxes come from outside: their sines have arguments up to 2^31, which runtimes compute badly.
    """

    def __init__(self, network: PoET, image_size: tuple[int, int]) -> None:
        super().__init__()
        self.network = network.eval()
        self.image_size = image_size
        self.mask = torch.zeros(1, *image_size, dtype=torch.bool)

    def forward(
        self, maps: list[Tensor], position: Tensor, content: Tensor, boxes: Tensor, classes: Tensor, intrinsics: Tensor
    ) -> tuple[Tensor, ...]:
        """Return translation, rotation and, where the network tells them, their uncertainties."""
        network = self.network
        tokens = network.tokens(maps, self.mask)
        memory = network.transformer.encode(tokens)
        states = network.transformer.decode(memory, tokens, content, position, boxes)
        queries = QueryBoxes(boxes, classes, boxes[..., 0], ())
        context = QueryContext(boxes, classes, self.image_size, intrinsics)
        output = network.read_last(states[-1], queries, context)
        found = output.translation, output.rotation, output.translation_uncertainty, output.rotation_uncertainty
        return tuple(tensor for tensor in found if tensor is not None)


def export(options: ExportOptions) -> Path:
    """Write a network as a graph, compare it with the network on random input, and return the file's path.

    Raises InputError for unknown suffixes, missing runtimes, and a graph whose poses differ by more than 1e-4.
    """
    target = options.target
    if target.suffix not in SUFFIXES:
        raise InputError(f"{target.suffix or 'no suffix'} is neither .onnx nor .xml", path=target)
    not_there(target, options.overwrite)
    network, config = load_model(options.weights)
    size = image_size_of(options, config)
    graph = PoseGraph(network, size)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        draft = Path(folder) / target.name
        write_onnx(graph, draft.with_suffix(".onnx"))
        if target.suffix == ".xml":
            _write_openvino(draft.with_suffix(".onnx"), draft)
            draft.with_suffix(".onnx").unlink()
        about = {"image_size": [size[1], size[0]], "config": config.to_json()}
        draft.with_suffix(target.suffix + ".json").write_text(json.dumps(about, indent=1) + "\n")
        difference = largest_difference(draft, graph)
        if not difference <= 1e-4:
            raise InputError(f"the graph's poses differ by {difference:.1e} from the network's", path=target)
        for file in Path(folder).iterdir():
            file.replace(target.parent / file.name)
    return target


def image_size_of(options: ExportOptions, config: ModelConfig) -> tuple[int, int]:
    """Return (height, width) of the images that the graph is for."""
    size = options.image_size or config.image_size
    if size is None:
        raise InputError("does not say the size of its images", path=options.weights, fix="give --image-size W H")
    return size[1], size[0]


def example_inputs(network: PoET, image_size: tuple[int, int], seed: int = 0) -> tuple[Any, ...]:
    """Return random maps, query codes, boxes, classes and intrinsics of the right shapes."""
    generator = torch.Generator().manual_seed(seed)
    options = network.options
    maps = []
    for channels, stride in zip(options.map_channels, options.map_strides):
        cells = [-(-side // stride) for side in image_size]
        maps.append(torch.randn(1, channels, *cells, generator=generator))
    boxes = torch.rand(1, options.queries, 4, generator=generator) * 0.3 + 0.2
    classes = torch.randint(1, options.class_count + 1, (1, options.queries), generator=generator)
    queries = QueryBoxes(boxes, classes, boxes[..., 0], (options.queries,))
    with torch.no_grad():
        position, content = network.query_codes(queries)
    intrinsics = torch.tensor([[image_size[1] * 1.0, image_size[1] * 1.0, image_size[1] / 2, image_size[0] / 2]])
    return maps, position.contiguous(), content.contiguous(), boxes, classes, intrinsics


def write_onnx(graph: PoseGraph, path: Path) -> None:
    """Write a graph as one ONNX file.  Raises InputError where the exporter is not installed."""
    inputs = example_inputs(graph.network, graph.image_size)
    names = [*(f"map{i}" for i in range(len(inputs[0]))), "position", "content", "boxes", "classes", "intrinsics"]
    outputs = ["translation", "rotation", "translation_uncertainty", "rotation_uncertainty"]
    known = 2 if graph.network.options.uncertainty == "none" else 4
    try:
        with _quiet(), torch.no_grad():
            torch.onnx.export(
                graph,
                inputs,
                str(path),
                input_names=names,
                output_names=outputs[:known],
                dynamo=True,
                external_data=False,
                verbose=False,
            )
    except (ImportError, torch.onnx.errors.OnnxExporterError) as error:
        if isinstance(error, ImportError) or "onnxscript" in str(error):
            raise InputError("exporting needs onnx and onnxscript", fix="pip install 'poet-loc[export]'") from None
        raise


def _write_openvino(onnx_file: Path, target: Path) -> None:
    try:
        import openvino
    except ImportError:
        raise InputError("OpenVINO is not installed", fix="pip install 'poet-loc[export]'") from None
    openvino.save_model(openvino.convert_model(str(onnx_file)), str(target), compress_to_fp16=False)


def largest_difference(path: Path, graph: PoseGraph, seed: int = 1) -> float:
    """Return the largest difference between the poses of a written graph and of the network, on random input."""
    from poet_loc.model.exported import run_graph

    inputs = example_inputs(graph.network, graph.image_size, seed)
    with torch.no_grad():
        expected = graph(*inputs)
    found = run_graph(path, inputs)
    return max(float((a - b).abs().max()) for a, b in zip(expected, found))


@contextmanager
def _quiet() -> Iterator[None]:
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels):
                logger.setLevel(level)
