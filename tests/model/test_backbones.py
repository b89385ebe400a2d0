"""Backbones: Scaled-YOLOv4-CSP against its key table and hand-made boxes, torchvision's, boxes from elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Features, batch_images, mask_of_level
from poet_loc.model.boxes import generalised_iou, iou, suppress
from poet_loc.model.external_boxes import ExternalBoxes, no_boxes
from poet_loc.model.yolov4 import YoloOptions, YoloV4Csp


@pytest.fixture(scope="module")
def yolo() -> YoloV4Csp:
    torch.manual_seed(0)
    return YoloV4Csp(YoloOptions(class_count=2)).eval()


def table(path: Path) -> dict[str, str]:
    rows = [line.split("\t") for line in path.read_text().splitlines() if line.startswith("backbone")]
    return {row[0].removeprefix("backbone.0."): row[1] for row in rows}


def test_yolo_keys(shared_fixtures: Path) -> None:
    with torch.device("meta"):
        weights = YoloV4Csp().state_dict()
    expected = table(shared_fixtures.parent / "reference" / "yolov4_state_dict_keys.txt")
    assert {name: str(tuple(tensor.shape)) for name, tensor in weights.items()} == expected
    assert len(weights) == 678


def test_torchvision_keys(shared_fixtures: Path) -> None:
    from poet_loc.model.torchvision_detector import TorchvisionDetector

    try:
        detector = TorchvisionDetector()
    except InputError as error:
        pytest.skip(str(error))
    expected = table(shared_fixtures.parent / "reference" / "maskrcnn_state_dict_keys.txt")
    assert {name: str(tuple(t.shape)) for name, t in detector.state_dict().items()} == expected


def test_yolo_maps(yolo: YoloV4Csp) -> None:
    with torch.no_grad():
        features = yolo.extract(batch_images([torch.rand(3, 64, 96)], multiple=32))
    assert [tuple(m.shape) for m in features.maps] == [(1, 256, 8, 12), (1, 512, 4, 6), (1, 1024, 2, 3)]
    with pytest.raises(InputError, match="multiples of 32"):
        yolo.extract(batch_images([torch.rand(3, 60, 96)]))


def place_box(
    yolo: YoloV4Csp, raw: list[torch.Tensor], level: int, anchor: int, cell: tuple[int, int], numbers
) -> None:
    """Write raw head outputs for one anchor and cell."""
    columns = 5 + yolo.options.class_count
    raw[level][0, anchor * columns : (anchor + 1) * columns, cell[0], cell[1]] = torch.tensor(numbers)


def detect_raw(yolo: YoloV4Csp, raw: list[torch.Tensor], monkeypatch: pytest.MonkeyPatch) -> torch.Tensor:
    heads = {id(m): value for m, value in zip((yolo.module_list[t + 1] for t in yolo.taps), raw)}
    for tap in yolo.taps:
        module = yolo.module_list[tap + 1]
        monkeypatch.setattr(module, "forward", lambda _, m=module: heads[id(m)])
    return yolo.detect(Features(tuple(raw), (64, 96)))[0]


def test_yolo_boxes_by_hand(yolo: YoloV4Csp, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = [torch.full((1, 21, h, w), -20.0) for h, w in ((8, 12), (4, 6), (2, 3))]
    # level 1 (stride 16), anchor 2 (72 x 146): sigmoid 0.5, 0.5 -> centre of the cell; 0.5 -> the anchor's own size
    place_box(yolo, raw, 1, 2, (3, 4), [0.0, 0.0, 0.0, 0.0, 20.0, -20.0, 20.0])
    # level 0 (stride 8), anchor 0 (12 x 16): sigmoid(ln 3) = 0.75 -> +1.0 cell, 2.25 x the anchor; both classes
    place_box(yolo, raw, 0, 0, (2, 5), [np.log(3.0)] * 4 + [np.log(9.0), np.log(9.0), np.log(4.0)])
    found = detect_raw(yolo, raw, monkeypatch)
    expected = [
        [4.5 * 16 - 36, 3.5 * 16 - 73, 4.5 * 16 + 36, 3.5 * 16 + 73, 1.0, 2.0],
        [6 * 8 - 13.5, 3 * 8 - 18, 6 * 8 + 13.5, 3 * 8 + 18, 0.81, 1.0],
        [6 * 8 - 13.5, 3 * 8 - 18, 6 * 8 + 13.5, 3 * 8 + 18, 0.72, 2.0],
    ]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-4)


def test_yolo_overlap_is_per_class_unless_agnostic(monkeypatch: pytest.MonkeyPatch) -> None:
    for agnostic, count in ((False, 2), (True, 1)):
        yolo = YoloV4Csp(YoloOptions(class_count=2, agnostic_overlap=agnostic)).eval()
        raw = [torch.full((1, 21, h, w), -20.0) for h, w in ((8, 12), (4, 6), (2, 3))]
        place_box(yolo, raw, 0, 1, (2, 5), [0.0, 0.0, 0.0, 0.0, 20.0, 3.0, 2.0])
        assert len(detect_raw(yolo, raw, monkeypatch)) == count


def test_darknet_file(yolo: YoloV4Csp, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    parts = []
    expected = {}
    for number, module in enumerate(yolo.module_list):
        tensors = dict(module.named_parameters()) | dict(module.named_buffers())
        if "Conv2d.weight" not in tensors:
            continue
        order = ["Conv2d.bias", "Conv2d.weight"]
        if "BatchNorm2d.weight" in tensors:
            norm = [f"BatchNorm2d.{name}" for name in ("bias", "weight", "running_mean", "running_var")]
            order = [*norm, "Conv2d.weight"]
        for name in order:
            values = rng.random(tensors[name].numel(), dtype=np.float32)
            parts.append(values)
            expected[f"module_list.{number}.{name}"] = values.reshape(tensors[name].shape)
    header = np.array([0, 2, 5], "<i4").tobytes() + np.array([32_000], "<i8").tobytes()
    data = header + np.concatenate(parts).tobytes()
    (tmp_path / "y.weights").write_bytes(data)
    fresh = YoloV4Csp(YoloOptions(class_count=2))
    fresh.load_darknet(tmp_path / "y.weights")
    loaded = fresh.state_dict()
    for name in list(expected)[:: len(expected) // 20]:
        np.testing.assert_array_equal(loaded[name].numpy(), expected[name])
    (tmp_path / "short.weights").write_bytes(data[:-4])
    with pytest.raises(InputError, match="weights where"):
        fresh.load_darknet(tmp_path / "short.weights")


def test_overlaps_against_shapely_free_brute_force() -> None:
    rng = np.random.default_rng(1)
    lower = rng.integers(0, 12, (20, 2))
    boxes = np.concatenate([lower, lower + rng.integers(1, 10, (20, 2))], axis=1)
    cells = np.zeros((20, 24, 24), bool)
    for mask, (x1, y1, x2, y2) in zip(cells, boxes):
        mask[y1:y2, x1:x2] = True
    shared = np.einsum("nyx,myx->nm", cells.astype(int), cells.astype(int))
    union = cells.sum((1, 2))[:, None] + cells.sum((1, 2))[None] - shared
    hull = np.array([[np.ptp(np.r_[a[::2], b[::2]]) * np.ptp(np.r_[a[1::2], b[1::2]]) for b in boxes] for a in boxes])
    given = torch.from_numpy(boxes).float()
    np.testing.assert_allclose(iou(given, given), shared / union, atol=1e-6)
    np.testing.assert_allclose(generalised_iou(given, given), shared / union - (hull - union) / hull, atol=1e-6)


def test_suppression_keeps_the_best_and_no_overlap() -> None:
    generator = torch.Generator().manual_seed(0)
    lower = torch.rand(60, 2, generator=generator) * 50
    boxes = torch.cat([lower, lower + 5 + torch.rand(60, 2, generator=generator) * 30], dim=1)
    scores = torch.rand(60, generator=generator)
    kept = suppress(boxes, scores, 0.3)
    overlaps = iou(boxes, boxes)
    assert kept[0] == scores.argmax()
    assert (scores[kept].diff() <= 0).all()
    assert (overlaps[kept][:, kept].fill_diagonal_(0) <= 0.3).all()
    gone = sorted(set(range(60)) - set(kept.tolist()))
    for index in gone:  # each has a better kept box above the threshold
        assert ((overlaps[index, kept] > 0.3) & (scores[kept] >= scores[index])).any()
    assert len(suppress(boxes, scores, 0.3, at_most=3)) == 3
    assert len(suppress(torch.zeros(0, 4), torch.zeros(0), 0.5)) == 0


def test_batches_are_padded_at_the_bottom_and_right() -> None:
    batch = batch_images([torch.ones(3, 10, 30), torch.ones(3, 40, 20)], multiple=32)
    assert batch.size == (64, 32)
    assert batch.images[0, :, :10, :30].min() == 1
    assert batch.images[0].sum() == 3 * 10 * 30
    assert (~batch.mask).sum((1, 2)).tolist() == [300, 800]
    assert mask_of_level(batch.mask, (8, 4)).shape == (2, 8, 4)


def test_external_boxes(yolo: YoloV4Csp) -> None:
    adapter = ExternalBoxes(yolo)
    rows = torch.tensor([[1.0, 2, 30, 40, 0.5, 2]])
    adapter.supply([rows, no_boxes()])
    with torch.no_grad():
        features = adapter.extract(batch_images([torch.rand(3, 32, 64)] * 2))
    found = adapter.detect(features)
    torch.testing.assert_close(found[0], rows)
    assert found[1].shape == (0, 6)
    assert adapter.shape() == yolo.shape()
    adapter.supply([rows])
    with pytest.raises(ValueError, match="boxes of 1 images"):
        adapter.detect(features)
