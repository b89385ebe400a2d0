"""Runs an exported pose network in onnxruntime or OpenVINO."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Features
from poet_loc.model.poet import PoET, PoseOutput
from poet_loc.model.queries import QueryBoxes

Runner = Callable[[list[Any]], list[Any]]


class ExportedPoses:
    """`PoET.poses` by a graph; detector and query codes stay the network's."""

    def __init__(self, path: str | Path, network: PoET, threads: int | None = None) -> None:
        self.network, self.path = network, Path(path)
        about = self.path.with_suffix(self.path.suffix + ".json")
        try:
            content = json.loads(about.read_text())
            width, height = content["image_size"]
            told = content["config"]["network"]
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"its description cannot be read ({type(error).__name__})", path=about) from None
        if told != json.loads(json.dumps(_network_json(network))):
            raise InputError("was exported from a network with other options", path=path)
        self.image_size = (height, width)
        self.run = load_graph(self.path, threads)

    def poses(
        self, features: Features, image_mask: Tensor, queries: QueryBoxes, intrinsics: Tensor | None = None
    ) -> PoseOutput:
        """Estimate poses, image by image.  Raises InputError for another image size or padded images."""
        if features.image_size != self.image_size or bool(image_mask.any()):
            height, width = self.image_size
            raise InputError(f"the graph is for whole images of {width}x{height}", path=self.path)
        asked, possible = queries.boxes.shape[1], self.network.options.queries
        if asked != possible:
            raise InputError(f"{asked} boxes in an image, the graph is for {possible}", path=self.path)
        position, content = self.network.query_codes(queries)
        if self.network.options.query_features == "roi":
            content = content + self.network.roi_features(features.maps, queries)
        given = torch.zeros(len(image_mask), 4) if intrinsics is None else intrinsics
        rows = []
        for i in range(len(image_mask)):
            one = slice(i, i + 1)
            maps = [m[one] for m in features.maps]
            parts = (position[one], content[one], queries.boxes[one], queries.classes[one], given[one])
            rows.append(self.run(graph_arrays((maps, *parts))))
        found = [torch.from_numpy(np.concatenate(column)) for column in zip(*rows)]
        return PoseOutput(found[0], found[1], queries, *(found[2:4] if len(found) == 4 else (None, None)))


def load_graph(path: Path, threads: int | None = None) -> Runner:
    """Return a function from input arrays to output arrays."""
    threads = threads or torch.get_num_threads()
    if not path.exists():
        raise InputError("no such graph", path=path)
    return _onnx(path, threads) if path.suffix == ".onnx" else _openvino(path, threads)


def run_graph(path: Path, inputs: Sequence[Any]) -> list[Tensor]:
    """Run a graph once on (maps, position, content, boxes, classes, intrinsics)."""
    return [torch.from_numpy(np.array(array)) for array in load_graph(path)(graph_arrays(inputs))]


def graph_arrays(inputs: Sequence[Any]) -> list[Any]:
    """Return (maps, position, content, boxes, classes, intrinsics) as the arrays that a graph takes, in its order."""
    maps, *rest = inputs
    return [np.ascontiguousarray(tensor.detach().numpy()) for tensor in (*maps, *rest)]


def _network_json(network: PoET) -> dict[str, Any]:
    from poet_loc.model.detectors import record_to_dict

    return record_to_dict(network.options)


def _onnx(path: Path, threads: int) -> Runner:
    try:
        import onnxruntime
    except ImportError:
        raise InputError("onnxruntime is not installed", fix="pip install 'poet-loc[export]'") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    wanted = {item.name for item in session.get_inputs()}
    names = _names(len([name for name in wanted if name.startswith("map")]))

    def run(arrays: list[Any]) -> list[Any]:
        return list(session.run(None, {n: a for n, a in zip(names, arrays) if n in wanted}))

    return run


def _openvino(path: Path, threads: int) -> Runner:
    try:
        import openvino
    except ImportError:
        raise InputError("OpenVINO is not installed", fix="pip install 'poet-loc[export]'") from None
    settings = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"}
    compiled = openvino.Core().compile_model(str(path), "CPU", settings)
    wanted = {name for item in compiled.inputs for name in item.names}
    names = _names(len([name for name in wanted if name.startswith("map")]))
    order = [output.get_any_name() for output in compiled.outputs]

    def run(arrays: list[Any]) -> list[Any]:
        found = compiled({n: a for n, a in zip(names, arrays) if n in wanted})
        return [np.array(found[name]) for name in order]

    return run


def _names(maps: int) -> list[str]:
    return [*(f"map{i}" for i in range(maps)), "position", "content", "boxes", "classes", "intrinsics"]
