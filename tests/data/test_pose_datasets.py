"""Data sets of images with poses: annotation files as the official loader reads them, BOP splits, augmentations."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "model"))
from tiny_data import FOCAL, OBJECT_IDS, SIZE, write_bop_split

from poet_loc.core.input_error import InputError
from poet_loc.data.annotation_dataset import AnnotationDataset
from poet_loc.data.augmentation import (
    AugmentationOptions,
    augment_colours,
    jitter_boxes,
    maybe_gray,
    paste_over,
    random_stream,
    truncated_normal,
)
from poet_loc.data.batches import EpochBatches, Samples, loader
from poet_loc.data.bop_dataset import BopDataset, read_keyframes
from poet_loc.data.class_lists import CLASSES, SYMMETRIC, read_class_file, write_class_files
from poet_loc.data.open_dataset import open_dataset
from poet_loc.data.samples import read_image, targets_of
from poet_loc.model.losses import quaternion_wxyz


def test_targets_are_those_of_the_official_loader(shared_fixtures: Path) -> None:
    folder = shared_fixtures / "poet_official" / "eval"
    official = json.loads((folder / "dataset_target_example.json").read_text())
    dataset = AnnotationDataset(folder / "annotation_example.json", folder)
    record = dataset.record(0)
    targets = targets_of(record)
    for name, mine in (
        ("boxes", targets.boxes),
        ("labels", targets.labels),
        ("relative_position", targets.translation),
        ("relative_rotation", targets.rotation),
    ):
        kind, shape, values = official[name]
        assert (str(mine.dtype), list(mine.shape)) == (kind, shape)
        torch.testing.assert_close(mine, torch.tensor(values, dtype=mine.dtype).reshape(shape), atol=1e-7, rtol=0)
    quaternions = quaternion_wxyz(targets.rotation)
    expected = torch.tensor(official["relative_quaternions"][2])
    torch.testing.assert_close((quaternions * expected).sum(-1).abs(), torch.ones(2), atol=1e-6, rtol=0)
    assert record.intrinsics == (100.0, 100.0, 64.0, 48.0)
    assert (record.scene_id, record.image_id) == (48, 1)
    assert dataset.names == ("alpha", "beta", "gamma")


def test_bop_split(tmp_path: Path) -> None:
    dataset = BopDataset(write_bop_split(tmp_path / "train_pbr"))
    assert (len(dataset), dataset.object_ids) == (6, OBJECT_IDS)
    record = dataset.record(3)
    raw = json.loads((tmp_path / "train_pbr/000001/scene_gt.json").read_text())["4"]
    np.testing.assert_allclose(record.translations_m * 1000, [row["cam_t_m2c"] for row in raw])
    assert (record.kind, record.size, record.labels.tolist()) == ("pbr", SIZE, [1, 2])
    assert record.intrinsics[0] == FOCAL
    centre = targets_of(record).boxes[:, :2] * torch.tensor(SIZE)
    projected = record.translations_m[:, :2] / record.translations_m[:, 2:] * FOCAL + np.array(SIZE) / 2
    np.testing.assert_allclose(centre.numpy(), projected, atol=1.1)
    image = read_image(record.path)
    x, y = projected[1].astype(int)
    assert image[y, x].tolist() == [250, 90, 0]


def test_bop_choices(tmp_path: Path) -> None:
    split = write_bop_split(tmp_path / "test")
    (tmp_path / "keyframes.txt").write_text("0001/000002\n0001/000005\n")
    chosen = BopDataset(split, object_ids=(5,), keyframes=tmp_path / "keyframes.txt")
    assert [chosen.record(i).image_id for i in range(len(chosen))] == [2, 5]
    assert chosen.record(0).labels.tolist() == [1]
    info = split / "000001/scene_gt_info.json"
    content = json.loads(info.read_text())
    for rows in content.values():
        rows[1]["visib_fract"] = 0.04
    info.write_text(json.dumps(content))
    assert BopDataset(split).record(0).labels.tolist() == [1]
    assert len(BopDataset(split, object_ids=(5,))) == 0
    assert len(BopDataset(split, object_ids=(5,), keep_empty=True)) == 6


def test_mistakes_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folders like 000001"):
        open_dataset(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        open_dataset(tmp_path / "x.json")
    (tmp_path / "broken.json").write_text("{}")
    with pytest.raises(InputError, match="not an annotation file"):
        open_dataset(tmp_path / "broken.json")
    (tmp_path / "k.txt").write_text("0001/000002\nnonsense\n")
    with pytest.raises(InputError, match=r"k\.txt:2"):
        read_keyframes(tmp_path / "k.txt")
    (tmp_path / "bad.png").write_bytes(b"\x89PNG no")
    with pytest.raises(InputError, match="not a readable image"):
        read_image(tmp_path / "bad.png")


def test_boxes_are_clipped_and_empty_ones_dropped(tmp_path: Path) -> None:
    record = BopDataset(write_bop_split(tmp_path / "test")).record(0)
    moved = replace(record, boxes_px=np.array([[-10.0, -10, 30, 20], [200.0, 0, 10, 10]]))
    targets = targets_of(moved)
    assert targets.labels.tolist() == [1]
    torch.testing.assert_close(targets.boxes, torch.tensor([[10 / 96, 5 / 64, 20 / 96, 10 / 64]]))


def test_jitter_stays_in_its_limits(tmp_path: Path) -> None:
    targets = targets_of(BopDataset(write_bop_split(tmp_path / "test")).record(0))
    moved = torch.stack([jitter_boxes(targets, random_stream(0, 0, i), 1.0).jittered_boxes for i in range(300)])
    shift, scale = moved[..., :2] - targets.boxes[:, :2], moved[..., 2:] / targets.boxes[:, 2:] - 1
    assert (shift.abs() <= targets.boxes[:, 2:] / 2).all()
    assert scale.abs().max() <= 0.3
    assert shift.std().item() == pytest.approx(0.02, rel=0.15)
    assert scale.std().item() == pytest.approx(0.02, rel=0.15)
    untouched = jitter_boxes(targets, random_stream(0, 0, 0), 0.0)
    torch.testing.assert_close(untouched.jittered_boxes, targets.boxes, atol=0, rtol=0)
    assert abs(truncated_normal(random_stream(1, 0, 0), 10.0, 0.1)) <= 0.1


def test_colours_keep_shape_and_are_repeatable() -> None:
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    results = [augment_colours(image, random_stream(0, 0, i)) for i in range(30)]
    assert all(r.shape == image.shape and r.dtype == np.uint8 for r in results)
    changed = [not np.array_equal(r, image) for r in results]
    assert 10 < sum(changed) < 30
    np.testing.assert_array_equal(results[3], augment_colours(image, random_stream(0, 0, 3)))
    gray = maybe_gray(image, random_stream(0, 0, 0), 1.0)
    assert (gray == gray[..., :1]).all()


def test_background_shows_where_the_object_is_not() -> None:
    image = np.zeros((20, 30, 4), np.uint8)
    image[5:10, 5:10] = (200, 10, 10, 255)
    behind = np.full((40, 50, 3), 77, np.uint8)
    result = paste_over(image, behind, random_stream(0, 0, 1))
    assert (result[5:10, 5:10] == (200, 10, 10)).all()
    assert (np.delete(result.reshape(-1, 3), [r * 30 + c for r in range(5, 10) for c in range(5, 10)], 0) == 77).all()


def test_epochs_are_shared_without_overlap_and_resumed_without_gap() -> None:
    def keys(**more: int) -> list[tuple[int, int]]:
        return [key for batch in EpochBatches(23, 3, epoch=4, seed=1, **more) for key in batch]

    whole = keys()
    assert len(whole) == len(set(whole)) == 21
    shares = [keys(rank=rank, world=2) for rank in (0, 1)]
    assert len(shares[0]) == len(shares[1]) == 9
    assert not set(shares[0]) & set(shares[1])
    assert keys(first=4) == whole[12:]
    assert EpochBatches(23, 3, epoch=5, seed=1).__iter__().__next__() != whole[:3]
    plain = [key for batch in EpochBatches(23, 3, shuffle=False) for key in batch]
    assert [index for _, index in plain] == list(range(23))


def test_workers_change_nothing(tmp_path: Path) -> None:
    dataset = BopDataset(write_bop_split(tmp_path / "train"))
    options = AugmentationOptions(colour=True, jitter_probability=1.0)
    samples = Samples(dataset, options, seed=3, jitter=True)
    alone, helped = (list(loader(samples, EpochBatches(6, 2, 1, 3), 32, workers)) for workers in (0, 2))
    assert alone[0].images.size == (64, 96)
    for one, other in zip(alone, helped):
        torch.testing.assert_close(one.images.images, other.images.images, atol=0, rtol=0)
        for a, b in zip(one.targets, other.targets):
            torch.testing.assert_close(a.jittered_boxes, b.jittered_boxes, atol=0, rtol=0)


@pytest.mark.parametrize(("name", "count"), [("ycbv", 21), ("lmo", 8)])
def test_class_files(name: str, count: int, tmp_path: Path) -> None:
    classes, symmetries = write_class_files(name, tmp_path)
    assert read_class_file(classes) == CLASSES[name]
    flags = json.loads(symmetries.read_text())
    assert len(flags) == count
    assert {key for key, symmetric in flags.items() if symmetric} == SYMMETRIC[name]
