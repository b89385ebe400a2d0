"""From images to files: every source, every backbone, stamps, covariances, unreadable images."""

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
from poet_loc.detect.image_source import open_images
from poet_loc.detect.options import DetectOptions
from poet_loc.detect.stage import detect, detect_in_log, sightings
from poet_loc.io.bop_results_csv import read_bop_results
from poet_loc.io.boxes_csv import read_boxes
from poet_loc.io.log_folder import read_log
from poet_loc.io.object_poses_csv import read_object_poses
from poet_loc.io.poet_results import read_poet_results
from poet_loc.model.backbone import batch_images
from poet_loc.model.checkpoint import ModelConfig, load_model, save_model
from poet_loc.model.detectors import options_of_kind
from poet_loc.model.heads import covariance_matrices
from poet_loc.model.options import PUBLISHED
from poet_loc.model.poet import PoET
from poet_loc.model.refiner import PoseRefiner, RefinerOptions
from poet_loc.model.yolov4 import YoloOptions, YoloV4Csp

CAMERA = (FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    return write_bop_split(tmp_path / "test", 4) / "000001" / "rgb"


@pytest.fixture
def boxes(images: Path, tmp_path: Path) -> Path:
    """True boxes of both objects of every image, as another program would give them."""
    dataset = BopDataset(images.parents[1])
    lines = ["image,x1,y1,x2,y2,score,class"]
    for index in range(len(dataset)):
        record = dataset.record(index)
        for (x, y, w, h), label in zip(record.boxes_px, record.labels):
            lines.append(f"{record.path.name},{x},{y},{x + w},{y + h},0.{9 - label},{label}")
    (tmp_path / "boxes.csv").write_text("\n".join(lines) + "\n")
    return tmp_path / "boxes.csv"


def test_files_of_a_run(images: Path, boxes: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors", uncertainty="full")
    options = DetectOptions(weights, boxes=boxes, rate=10.0, intrinsics=CAMERA, scene=48, overlays=True, batch=3)
    out = detect(images, tmp_path / "run", options)
    poses = read_object_poses(out / "object_poses.csv")
    assert len(poses) == 8
    assert poses.stamps_ns.tolist() == [
        0,
        0,
        100_000_000,
        100_000_000,
        200_000_000,
        200_000_000,
        300_000_000,
        300_000_000,
    ]
    assert poses.object_ids.tolist() == [2, 5] * 4
    np.testing.assert_allclose(poses.scores, [0.8, 0.7] * 4, atol=1e-6)
    # what the files hold is what the network says
    network, _ = load_model(weights)
    dataset = BopDataset(images.parents[1])
    record = dataset.record(2)
    batch = batch_images([to_tensor(read_image(record.path))])
    with torch.no_grad():
        output = network(batch, queries_of_targets([targets_of(record)], 4, "gt"))
    np.testing.assert_allclose(poses.T_cam_obj[4:6].translation, output.translation[0, :2].numpy(), atol=2e-5)
    np.testing.assert_allclose(poses.T_cam_obj[4:6].rotation.as_matrix(), output.rotation[0, :2].numpy(), atol=2e-5)
    covariance = poses.covariances[4:6]
    expected = covariance_matrices(output.translation_uncertainty[0, :2]).numpy()
    np.testing.assert_allclose(covariance[:, 3:, 3:], expected, rtol=1e-3)
    assert np.abs(covariance[:, :3, 3:]).max() == 0
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    # the other files hold the same
    bop = read_bop_results(out / "bop_results.csv")
    assert bop.scene_ids.tolist() == [48] * 8
    assert bop.image_ids.tolist() == [1, 1, 2, 2, 3, 3, 4, 4]
    assert (bop.times_s > 0).all()
    np.testing.assert_allclose(bop.T_cam_obj.translation, poses.T_cam_obj.translation, atol=1e-9)
    results = read_poet_results(out / "results.json")
    assert results.image_ids == ("000001", "000002", "000003", "000004")
    assert results.classes.tolist() == [1, 2] * 4
    np.testing.assert_allclose(results.boxes[0] * [*SIZE, *SIZE], [*_centre(dataset.record(0).boxes_px[0])], atol=1e-3)
    assert json.loads((out / "summary.json").read_text())["images"] == 4
    overlay = read_image(out / "overlays" / "000001.png")
    assert (overlay != read_image(images / "000001.png")).any()


def test_rounds_of_the_refiner_are_an_option(images: Path, boxes: Path, tmp_path: Path) -> None:
    network, config = tiny_network()
    torch.nn.init.normal_((refiner := PoseRefiner(RefinerOptions(3, points=30, widths=(8, 8, 8)))).flow.weight)
    refiner.show(torch.rand(3, 30, 3) - 0.5, torch.zeros(3, 30, 3), torch.ones(3))
    network.refiner = refiner
    save_model(tmp_path / "with.safetensors", network, replace(config, refiner=refiner.options))
    network.refiner = None
    save_model(tmp_path / "without.safetensors", network, config)

    def found(name: str, rounds: int | None):
        options = DetectOptions(tmp_path / f"{name}.safetensors", boxes=boxes, intrinsics=CAMERA, rounds=rounds)
        return read_object_poses(detect(images, tmp_path / f"{name}_{rounds}", options) / "object_poses.csv")

    plain, none, one, made = found("without", None), found("with", 0), found("with", 1), found("with", None)
    assert np.array_equal(plain.T_cam_obj.as_matrix(), none.T_cam_obj.as_matrix())
    assert np.array_equal(found("with", 3).T_cam_obj.as_matrix(), made.T_cam_obj.as_matrix())
    differ = [np.abs(each.T_cam_obj.translation - plain.T_cam_obj.translation).max() for each in (one, made)]
    assert min(differ) > 1e-4
    with pytest.raises(InputError, match="no refiner"):
        found("without", 2)
    with pytest.raises(InputError, match="rounds is -1"):
        DetectOptions(rounds=-1)


def test_the_boxes_of_a_run_give_the_same_poses_again(images: Path, boxes: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    first = detect(images, tmp_path / "first", DetectOptions(weights, boxes=boxes))
    again = detect(images, tmp_path / "again", DetectOptions(weights, boxes=first / "boxes.csv"))
    one, other = (read_object_poses(out / "object_poses.csv") for out in (first, again))
    np.testing.assert_allclose(other.T_cam_obj.as_matrix(), one.T_cam_obj.as_matrix(), atol=1e-3)
    np.testing.assert_allclose(other.scores, one.scores, atol=1e-5)


@pytest.fixture
def log(images: Path, tmp_path: Path) -> Path:
    """A log of the images whose map has object 5 alone."""
    folder = tmp_path / "log"
    folder.mkdir()
    names = sorted(file.name for file in images.iterdir())
    (folder / "rgb").symlink_to(images)
    rows = [f"{number * 40_000_000},{number},rgb/{name}" for number, name in enumerate(names)]
    (folder / "frames.csv").write_text("\n".join(["timestamp_ns,frame,image", *rows]) + "\n")
    landmark = {"object_id": 5, "instance": 0, "name": "five", "t": [0, 0, 0], "q_xyzw": [0, 0, 0, 1]}
    (folder / "landmarks.json").write_text(
        json.dumps({"landmarks": [landmark | {"covariance": None, "symmetry": None}]})
    )
    return folder


def test_a_log_keeps_what_its_map_has_and_is_told_of_the_rest(log: Path, boxes: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    options = DetectOptions(weights, boxes=boxes, intrinsics=CAMERA)
    with pytest.warns(UserWarning, match=r"left out 4 detections .* 2 \(4\)") as told:
        path = detect_in_log(log, "mine", options)
    assert len(told) == 1
    assert path == log / "object_poses_mine.csv"
    (poses,) = read_log(log).object_poses.values()
    assert poses.object_ids.tolist() == [5] * 4
    assert poses.stamps_ns.tolist() == [0, 40_000_000, 80_000_000, 120_000_000]
    assert {rows[0, 5] for rows in read_boxes(log / "boxes_mine.csv").values()} == {2.0}
    assert {file.name for file in log.iterdir()} == {
        "rgb", "frames.csv", "landmarks.json", "object_poses_mine.csv", "boxes_mine.csv"
    }  # fmt: skip
    with pytest.raises(InputError, match="exists already"):
        detect_in_log(log, "mine", options)
    with pytest.raises(InputError, match="no log with frames"):
        detect_in_log(log / "rgb", options=options)
    everything = detect(log, tmp_path / "all", replace(options, unknown_objects=True))
    assert len(read_object_poses(everything / "object_poses.csv")) == 8


def _centre(box: np.ndarray) -> list[float]:
    return [box[0] + box[2] / 2, box[1] + box[3] / 2, box[2], box[3]]


def test_batches_and_engines_change_nothing(images: Path, boxes: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    runs = [
        list(sightings(images, DetectOptions(weights, boxes=boxes, batch=batch, engine=engine)))
        for batch, engine in ((1, "eager"), (4, "eager"), (3, "fast"))
    ]
    for run in runs[1:]:
        for one, other in zip(runs[0], run):
            np.testing.assert_allclose(other.translations, one.translations, atol=1e-5)
            np.testing.assert_allclose(other.rotations, one.rotations, atol=1e-5)


def test_variance_scale_of_the_file_is_applied(images: Path, boxes: Path, tmp_path: Path) -> None:
    network, config = tiny_network(uncertainty="aleatoric")
    found = []
    for scale in ((1.0, 1.0), (4.0, 9.0)):
        save_model(tmp_path / "net.safetensors", network, replace(config, variance_scale=scale))
        found.append(next(sightings(images, DetectOptions(tmp_path / "net.safetensors", boxes=boxes))).covariances)
    ratio = found[1].diagonal(axis1=1, axis2=2) / found[0].diagonal(axis1=1, axis2=2)
    np.testing.assert_allclose(ratio, [[9, 9, 9, 4, 4, 4]] * 2)


def test_unreadable_images_are_named_and_skipped(images: Path, boxes: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    (images / "000002.png").write_bytes(b"no image")
    with pytest.warns(UserWarning, match=r"000002\.png: not a readable image"):
        out = detect(images, tmp_path / "run", DetectOptions(weights, boxes=boxes))
    summary = json.loads((out / "summary.json").read_text())
    assert summary["images"] == 3
    assert "000002.png" in summary["skipped"][0]
    assert read_object_poses(out / "object_poses.csv").frames.tolist() == [0, 0, 2, 2, 3, 3]
    for file in images.iterdir():
        file.write_bytes(b"")
    with pytest.raises(InputError, match="no image could be read"), pytest.warns(UserWarning, match="skipped"):
        detect(images, tmp_path / "other", DetectOptions(weights, boxes=boxes))
    assert not (tmp_path / "other").exists()


def test_stamps_of_every_source(images: Path, tmp_path: Path) -> None:
    def stamps(path: Path, **more: object) -> list[int]:
        return [picture.stamp_ns for picture in open_images(path, **more)]

    assert stamps(images, rate=4.0) == [0, 250_000_000, 500_000_000, 750_000_000]
    log = tmp_path / "log"
    (log / "rgb").mkdir(parents=True)
    for file in images.iterdir():
        (log / "rgb" / file.name).write_bytes(file.read_bytes())
    rows = [f"{1000 * (4 - k)},{7 * (4 - k)},rgb/{4 - k:06d}.png" for k in range(3, -1, -1)]
    (log / "frames.csv").write_text("timestamp_ns,frame,image\n" + "\n".join(rows) + "\n")
    assert [(p.stamp_ns, p.frame, p.name) for p in open_images(log)][:2] == [
        (1000, 7, "000001.png"),
        (2000, 14, "000002.png"),
    ]
    named = tmp_path / "named"
    named.mkdir()
    for k, file in enumerate(sorted(images.iterdir())):
        (named / f"{1403636579763555584 + k}.png").write_bytes(file.read_bytes())
    assert stamps(named) == [1403636579763555584 + k for k in range(4)]
    assert stamps(images / "000001.png") == [0]


def test_video(images: Path, boxes: Path, tmp_path: Path) -> None:
    import cv2

    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, SIZE)
    for file in sorted(images.iterdir()):
        writer.write(read_image(file)[..., ::-1])
    writer.release()
    pictures = list(open_images(path))
    assert [p.stamp_ns for p in pictures] == [0, 50_000_000, 100_000_000, 150_000_000]
    first = read_image(sorted(images.iterdir())[0]).astype(int)
    assert np.abs(pictures[0].pixels.astype(int) - first).mean() < 25
    out = detect(path, tmp_path / "run", DetectOptions(save_tiny(tmp_path / "net.safetensors")))
    assert json.loads((out / "summary.json").read_text())["images"] == 4
    (tmp_path / "bad.mp4").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a readable video"):
        list(open_images(tmp_path / "bad.mp4"))


def test_images_without_a_detection_leave_readable_files(images: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    out = detect(images, tmp_path / "run", DetectOptions(weights, score=2.0))
    assert json.loads((out / "results.json").read_text()) == {f"{k:06d}": {} for k in range(1, 5)}
    assert (out / "object_poses.csv").read_text().startswith("timestamp_ns,")
    assert len((out / "bop_results.csv").read_text().splitlines()) == 1


def test_mistakes_of_the_user(images: Path, tmp_path: Path) -> None:
    weights = save_tiny(tmp_path / "net.safetensors")
    options = DetectOptions(weights)
    with pytest.raises(InputError, match="no such image"):
        detect(tmp_path / "nowhere", tmp_path / "run", options)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no images"):
        detect(tmp_path / "empty", tmp_path / "run", options)
    (tmp_path / "b.csv").write_text(
        "image,x1,y1,x2,y2,score,class\n000001.png,1,2,3,4,0.5,1\n000001.png,9,2,3,4,0.5,1\n"
    )
    with pytest.raises(InputError, match=r"b\.csv:3"):
        read_boxes(tmp_path / "b.csv")
    (tmp_path / "c.csv").write_text("image,x1,y1,x2,y2,score,class\n000001.png,1,2,30,40,0.5,7\n")
    with pytest.raises(InputError, match="class 7 is beyond the network's 2 classes"):
        detect(images, tmp_path / "run", replace(options, boxes=tmp_path / "c.csv"))
    ray = save_tiny(tmp_path / "ray.safetensors", translation="ray")
    with pytest.raises(InputError, match="needs the camera's intrinsics"):
        detect(images, tmp_path / "run", DetectOptions(ray))
    assert not (tmp_path / "run").exists()


def test_another_image_size_is_told_once(images: Path, boxes: Path, tmp_path: Path) -> None:
    network, config = tiny_network()
    save_model(tmp_path / "net.safetensors", network, replace(config, image_size=(640, 480)))
    with pytest.warns(UserWarning, match="96x64 for a network trained on 640x480") as told:
        list(sightings(images, DetectOptions(tmp_path / "net.safetensors", boxes=boxes)))
    assert len([w for w in told if "640x480" in str(w.message)]) == 1


@pytest.mark.parametrize("kind", ["yolov4", "small", "torchvision"])
def test_full_size_network_on_every_backbone(kind: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    try:
        options = YoloOptions(confidence=0.2) if kind == "yolov4" else options_of_kind(kind)
        detector = YoloV4Csp(options) if kind == "yolov4" else _build(options)
    except InputError as error:
        assert kind == "torchvision"
        pytest.skip(str(error))
    shape = detector.shape()
    network_options = replace(
        PUBLISHED, map_channels=shape.channels, map_strides=shape.strides, class_count=shape.class_count
    )
    save_model(tmp_path / "net.safetensors", PoET(network_options, detector), ModelConfig(network_options, options))
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (256, 320, 3), dtype=np.uint8)).save(tmp_path / "i.png")
    found = next(sightings(tmp_path / "i.png", DetectOptions(tmp_path / "net.safetensors")))
    assert np.isfinite(found.translations).all()
    if kind == "yolov4":
        assert len(found.labels) == network_options.queries


def _build(options: object):
    from poet_loc.model.detectors import build_detector

    return build_detector(options)
