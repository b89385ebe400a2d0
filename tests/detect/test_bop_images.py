"""BOP scenes and splits as images: their cameras, numbers, key frames and true boxes."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))
from tiny_data import FOCAL, SIZE, save_tiny, tiny_network, write_bop_split

from poet_loc.core.input_error import InputError
from poet_loc.data.batches import queries_of_targets
from poet_loc.data.bop_dataset import BopDataset
from poet_loc.data.samples import read_image, targets_of, to_tensor
from poet_loc.detect.estimator import Estimator
from poet_loc.detect.image_source import open_images
from poet_loc.detect.options import DetectOptions
from poet_loc.detect.stage import detect, sightings
from poet_loc.io.bop_results_csv import read_bop_results
from poet_loc.io.boxes_csv import read_boxes
from poet_loc.model.backbone import batch_images
from poet_loc.model.checkpoint import load_model, save_model


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """Two scenes of three images with the same file names; the second scene's camera differs from image to image."""
    for scene in (4, 7):
        write_bop_split(tmp_path / "test", 3, seed=scene, scene=scene)
    cameras = tmp_path / "test/000007/scene_camera.json"
    content = json.loads(cameras.read_text())
    for image, camera in content.items():
        camera["cam_K"][0] = FOCAL + int(image)
    cameras.write_text(json.dumps(content))
    return tmp_path / "test"


def test_true_boxes_are_those_of_training(split: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    out = detect(split, tmp_path / "run", DetectOptions(weights, true_boxes=True, batch=2, overlays=True))
    found = read_bop_results(out / "bop_results.csv")
    assert found.scene_ids.tolist() == [4] * 6 + [7] * 6
    assert found.image_ids.tolist() == [1, 1, 2, 2, 3, 3] * 2
    assert found.object_ids.tolist() == [2, 5] * 6
    network, _ = load_model(weights)
    dataset = BopDataset(split)
    for index in range(6):
        record = dataset.record(index)
        queries = queries_of_targets([targets_of(record)], 4, "gt")
        with torch.no_grad():
            expected = network(batch_images([to_tensor(read_image(record.path))]), queries)
        np.testing.assert_allclose(
            found.T_cam_obj[2 * index : 2 * index + 2].translation, expected.translation[0, :2].numpy(), atol=2e-5
        )
    assert sorted(file.name for file in (out / "overlays").iterdir())[:2] == [
        "000004_rgb_000001.png",
        "000004_rgb_000002.png",
    ]
    boxes = read_boxes(out / "boxes.csv")
    assert len(boxes) == 6
    x, y, w, h = dataset.record(4).boxes_px[1]
    corners = np.clip([x, y, x + w, y + h], 0, [*SIZE, *SIZE])
    np.testing.assert_allclose(boxes["000007/rgb/000002.png"][1, :4], corners, atol=1e-2)
    # its own boxes, given back, give the same poses, scene by scene
    again = detect(split, tmp_path / "again", DetectOptions(weights, boxes=out / "boxes.csv"))
    np.testing.assert_allclose(
        read_bop_results(again / "bop_results.csv").T_cam_obj.translation, found.T_cam_obj.translation, atol=1e-3
    )


def test_every_image_has_its_own_camera(split: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "ray.safetensors", translation="ray")
    options = DetectOptions(weights, true_boxes=True)
    whole, one = list(sightings(split, options)), list(sightings(split / "000007", options))
    assert [s.picture.name for s in one] == ["000001.png", "000002.png", "000003.png"]
    fixed = list(sightings(split / "000007", replace(options, intrinsics=(FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2))))
    for number, (a, b, c) in enumerate(zip(whole[3:], one, fixed), start=1):
        np.testing.assert_allclose(a.translations, b.translations, atol=1e-6)
        assert a.picture.place is not None
        assert a.picture.place.intrinsics[0] == FOCAL + number
        assert np.abs(b.translations - c.translations).max() > 1e-4


@pytest.mark.parametrize("padded", [False, True])
def test_true_boxes_are_shares_of_what_training_had(split: Path, tmp_path: Path, padded: bool) -> None:
    """Of the picture, as published, though the batch is padded; of the batch where the network looks at pixels."""
    for file in (split / "000004/rgb").iterdir():
        Image.fromarray(read_image(file)[:50, :90]).save(file)
    weights = save_tiny(tmp_path / "net.safetensors", query_features="roi" if padded else "none")
    estimator = Estimator(DetectOptions(weights, true_boxes=True), source=split)
    pictures = list(open_images(split))[:1]
    batch, features = estimator.features(pictures)
    assert batch.size == (64, 96)
    queries = estimator.queries(pictures, batch, features)
    expected = targets_of(BopDataset(split).record(0)).boxes
    scale = torch.tensor([90 / 96, 50 / 64] * 2) if padded else torch.ones(4)
    torch.testing.assert_close(queries.boxes[0, :2], expected * scale)
    np.testing.assert_allclose(estimator(pictures)[0].boxes, expected.numpy(), atol=1e-6)


def test_key_frames_restrict_the_images(split: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    (tmp_path / "keyframe.txt").write_text("0004/000002\n0007/000003\n")
    options = DetectOptions(weights, true_boxes=True, keyframes=tmp_path / "keyframe.txt")
    out = detect(split, tmp_path / "run", options)
    found = read_bop_results(out / "bop_results.csv")
    assert list(zip(found.scene_ids.tolist(), found.image_ids.tolist()))[::2] == [(4, 2), (7, 3)]
    (tmp_path / "keyframe.txt").write_text("0009/000002\n")
    with pytest.raises(InputError, match="no image is a key frame"):
        detect(split, tmp_path / "other", options)
    with pytest.raises(InputError, match=r"is no BOP scene.*--keyframes"):
        detect(split / "000004/rgb", tmp_path / "other", options)


def test_objects_that_the_network_does_not_know_are_left_out(split: Path, tmp_path: Path) -> None:
    network, config = tiny_network()
    save_model(tmp_path / "net.safetensors", network, replace(config, object_ids=(5, 9)))
    for sighting in sightings(split, DetectOptions(tmp_path / "net.safetensors", true_boxes=True)):
        assert sighting.object_ids.tolist() == [5]
        assert sighting.labels.tolist() == [1]


def test_scenes_without_truth_and_missing_images(split: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    for name in ("scene_gt.json", "scene_gt_info.json"):
        (split / "000004" / name).unlink()
    (split / "000007/rgb/000002.png").unlink()
    with pytest.warns(UserWarning, match=r"000002\.png: no such image"):
        out = detect(split, tmp_path / "run", DetectOptions(weights))
    assert json.loads((out / "summary.json").read_text())["images"] == 5
    with pytest.warns(UserWarning, match="skipped"):
        found = list(sightings(split, DetectOptions(weights, true_boxes=True)))
    assert [len(sighting.labels) for sighting in found] == [0, 0, 0, 2, 2]


def test_more_objects_than_queries(split: Path, tmp_path: Path) -> None:
    one = save_tiny(tmp_path / "net.safetensors", queries=1)
    assert {len(s.labels) for s in sightings(split, DetectOptions(one, true_boxes=True))} == {2}
    learned = save_tiny(tmp_path / "net.safetensors", queries=1, query_embedding="learned")
    with pytest.raises(InputError, match="2 boxes in an image for 1 learned queries"):
        list(sightings(split, DetectOptions(learned, true_boxes=True)))


def test_mistakes(split: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    options = DetectOptions(weights, true_boxes=True)
    with pytest.raises(InputError, match="has no true boxes"):
        detect(split / "000004/rgb", tmp_path / "run", options)
    (tmp_path / "boxes.csv").write_text("image,x1,y1,x2,y2,score,class\n")
    with pytest.raises(InputError, match="different boxes"):
        detect(split, tmp_path / "run", replace(options, boxes=tmp_path / "boxes.csv"))
    assert not (tmp_path / "run").exists()
