"""The render stage: a BOP data set, the same bytes from the same seed, resumed where it stopped."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from poet_loc.core.input_error import InputError
from poet_loc.data.render import RenderOptions, render
from poet_loc.data.world.sensor import Sensor, expose
from poet_loc.data.world.view import load_assets
from poet_loc.io.bop import read_bop_scene


def options(out: Path, **changes) -> RenderOptions:
    settings = {"images": 4, "images_per_scene": 3, "size": (80, 60), "jobs": 1, "progress": False}
    return RenderOptions(out=out, **(settings | changes))


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("world")
    render(options(out))
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_same_seed_same_bytes_also_on_two_processes(world, tmp_path):
    render(options(tmp_path, jobs=2))
    assert contents(tmp_path) == contents(world)
    assert len(contents(world)) > 4 * 4


def test_another_seed_shows_something_else(world, tmp_path):
    render(options(tmp_path, seed=1, images=1))
    name = "train/000000/rgb/000000.jpg"
    assert (tmp_path / name).read_bytes() != (world / name).read_bytes()


def test_an_interrupted_run_goes_on(world, tmp_path):
    render(options(tmp_path, images=3))
    (tmp_path / "train/000001.partial/rgb").mkdir(parents=True)  # what an interruption leaves
    before = (tmp_path / "train/000000/rgb/000000.jpg").stat().st_mtime_ns
    render(options(tmp_path))
    assert (tmp_path / "train/000000/rgb/000000.jpg").stat().st_mtime_ns == before
    assert contents(tmp_path) == contents(world)


def test_more_images_than_before_are_those_of_one_run(world, tmp_path):
    render(options(tmp_path, images=2))
    render(options(tmp_path))
    assert contents(tmp_path) == contents(world)
    render(options(tmp_path, images=1))
    assert contents(tmp_path) == contents(world)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"seed": 1}, "--seed 0, not 1"),
        ({"size": (96, 64)}, "--size 80 60, not 96 64"),
        ({"masks": False}, "--masks True, not False"),
        ({"split": "other", "world_seed": 2}, "--world-seed 0, not 2"),
    ],
)
def test_images_of_other_options_are_not_mixed(world, change, told):
    before = contents(world)
    with pytest.raises(InputError, match=f"was rendered with {told}"):
        render(options(world, **change))
    assert contents(world) == before


def test_our_own_reader_reads_it_and_things_stand_on_the_table(world):
    scene = read_bop_scene(world / "train/000000")
    assert len(scene) == 3
    found = scene.annotations
    assert len(found) > 0
    np.testing.assert_array_equal(scene.depth_scales, 0.1)
    T_world_cam = scene.T_cam_world.inv()
    objects = load_assets(0).objects
    for row in range(len(found)):
        T_world_obj = T_world_cam[int(found.image_ids[row])] * found.T_cam_obj[row]
        lowest = T_world_obj.apply(objects[found.object_ids[row] - 1].mesh.vertices)[:, 2].min()
        assert lowest == pytest.approx(0.0, abs=1e-6)


def test_projected_models_fill_their_boxes(world):
    import json

    assets = load_assets(0)
    folder = world / "train/000000"
    truth, info, cameras = (
        json.loads((folder / f"{n}.json").read_text()) for n in ("scene_gt", "scene_gt_info", "scene_camera")
    )
    checked = 0
    for number, entries in truth.items():
        K = np.reshape(cameras[number]["cam_K"], (3, 3))
        depth = cv2.imread(str(folder / f"depth/{int(number):06d}.png"), cv2.IMREAD_UNCHANGED)
        for row, (entry, about) in enumerate(zip(entries, info[number])):
            R, t = np.reshape(entry["cam_R_m2c"], (3, 3)), np.array(entry["cam_t_m2c"])
            thing = assets.objects[entry["obj_id"] - 1]
            points = thing.mesh.vertices * 1e3 @ R.T + t
            pixels = points @ K.T
            u, v = pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2]
            if u.min() < -70 or v.min() < -50 or u.max() > 150 or v.max() > 110:
                continue  # reaches beyond the canvas on which BOP counts the whole silhouette
            x, y, w, h = about["bbox_obj"]
            np.testing.assert_allclose([x, y, x + w - 1, y + h - 1], [u.min(), v.min(), u.max(), v.max()], atol=1.5)
            whole = cv2.imread(str(folder / f"mask/{int(number):06d}_{row:06d}.png"), 0) > 0
            seen = cv2.imread(str(folder / f"mask_visib/{int(number):06d}_{row:06d}.png"), 0) > 0
            assert np.all(whole[seen])
            assert about["px_count_visib"] == seen.sum()
            assert about["visib_fract"] == pytest.approx(seen.sum() / about["px_count_all"], abs=1e-4)
            if seen.sum() > 20:
                near, far = points[:, 2].min(), points[:, 2].max()
                assert np.all((depth[seen] * 0.1 > near - 1) & (depth[seen] * 0.1 < far + 1))
                checked += 1
    assert checked >= 4


def test_a_sensor_without_flaws_is_a_tone_curve():
    light = np.random.default_rng(0).random((12, 16, 3)).astype(np.float32)
    image = expose(light, Sensor(noise=0.0), np.random.default_rng(0))
    np.testing.assert_allclose(image, 255 * light ** (1 / 2.2), atol=0.51)


def test_motion_blur_keeps_the_light_and_smears_along_its_way():
    light = np.zeros((21, 21, 3), np.float32)
    light[10, 10] = 1.0
    image = expose(light, Sensor(noise=0.0, gamma=1.0, motion=(6.0, 0.0)), np.random.default_rng(0)).astype(float)
    assert image[..., 0].sum() == pytest.approx(255, rel=0.05)
    assert image[10, 8:13].min() > 20
    assert image[9, 10, 0] < 10


def test_senseless_options_are_refused(tmp_path):
    with pytest.raises(InputError, match="positive"):
        render(options(tmp_path, images=0))
