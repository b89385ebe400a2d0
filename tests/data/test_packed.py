"""Packed scenes and their augmentation: the changed image is one that a real camera could have taken."""

from __future__ import annotations

import numpy as np
import pytest

from poet_loc.data.packed import AugmentOptions, PackedImages, canonical_rotation, load_models, pack
from poet_loc.data.render import RenderOptions, render
from poet_loc.data.world.view import load_assets

STRONG = AugmentOptions(turn_deg=40.0, zoom=0.3, shift=0.1)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    out = tmp_path_factory.mktemp("packed")
    split = render(RenderOptions(out, images=6, images_per_scene=3, size=(160, 120), jobs=1, progress=False))
    models = load_models(out / "models")
    return PackedImages(pack(split, out / "cache"), models, least_visible=0.3)


def project(sample, points):
    fx, fy, cx, cy = sample.intrinsics
    return np.stack([fx * points[..., 0] / points[..., 2] + cx, fy * points[..., 1] / points[..., 2] + cy], -1)


def test_models_know_shape_size_and_symmetry(images):
    assets = load_assets(0)
    for index, thing in enumerate(assets.objects):
        assert images.models.diameters[index] == pytest.approx(thing.diameter, abs=1e-6)
        assert images.models.symmetry_axes[index].any() == (thing.symmetry is not None)
        low, high = images.models.surface[index].min(0), images.models.surface[index].max(0)
        assert np.all(high - low <= thing.extent + 1e-6)
        assert np.all(high - low > 0.85 * thing.extent)


@pytest.mark.parametrize("augment", [None, STRONG])
def test_each_cell_sees_the_point_that_projects_to_it(images, augment):
    checked = 0
    for number in range(len(images)):
        rng = np.random.default_rng([2, number])
        sample = images.sample(number, rng, augment) if augment else images.sample(number, rng)
        rows, columns = np.nonzero(~np.isnan(sample.surface[..., 0]))
        gaps = np.full((len(rows), len(sample.classes)), np.inf)
        R = canonical_rotation(sample.R_cam_obj, sample.t_cam_obj, images.models.symmetry_axes[sample.classes - 1])
        for index, label in enumerate(sample.classes):
            points = sample.surface[rows, columns] * images.models.diameters[label - 1]
            pixels = project(sample, points @ R[index].T + sample.t_cam_obj[index])
            cells = np.stack([columns, rows], -1) * 8 + 3.5
            gaps[:, index] = np.linalg.norm(pixels - cells, axis=1)
        if gaps.shape[1] == 0:
            continue
        best = gaps.min(1)  # cells of objects that were left out as hardly visible fit nobody
        checked += int((best < 2.5).sum())
        assert np.mean(best < 2.5) > 0.6
    assert checked > 60


def test_augmented_pixels_are_the_original_ones_seen_by_the_turned_camera(images):
    """Texture follows the pose: the image around a projected point keeps its colour."""
    gaps = []
    for number in range(len(images)):
        plain = images.sample(number, np.random.default_rng(0))
        changed = images.sample(number, np.random.default_rng(3), AugmentOptions(30.0, 0.2, 0.05, 0.0, 0.0))
        for label, R, t in zip(plain.classes, plain.R_cam_obj, plain.t_cam_obj):
            if label not in changed.classes:
                continue
            index = int(np.flatnonzero(changed.classes == label)[0])
            grid = images.models.surface[label - 1][::10]
            first = project(plain, grid @ R.T + t)
            second = project(changed, grid @ changed.R_cam_obj[index].T + changed.t_cam_obj[index])
            for a, b in zip(np.rint(first).astype(int), np.rint(second).astype(int)):
                if all(0 <= p[0] < 160 and 0 <= p[1] < 120 for p in (a, b)):
                    gaps.append(np.abs(plain.image[a[1], a[0]].astype(float) - changed.image[b[1], b[0]]).mean())
    assert len(gaps) > 200
    assert np.median(gaps) < 12
    assert np.mean(gaps) < 30


def test_boxes_hold_the_whole_object_and_samples_repeat(images):
    for number in range(len(images)):
        sample = images.sample(number, np.random.default_rng(number), STRONG)
        again = images.sample(number, np.random.default_rng(number), STRONG)
        np.testing.assert_array_equal(sample.image, again.image)
        for label, R, t, box in zip(sample.classes, sample.R_cam_obj, sample.t_cam_obj, sample.boxes):
            pixels = project(sample, images.models.surface[label - 1] @ R.T + t)
            inside = np.all((pixels >= box[:2] - 1.5) & (pixels <= box[2:] + 0.5), axis=1)
            clipped = np.any(box <= [0, 0, -1, -1]) or np.any(box[2:] >= [160, 120])
            assert clipped or inside.all()


def test_turning_a_symmetric_object_does_not_change_its_canonical_pose():
    rng = np.random.default_rng(0)
    from scipy.spatial.transform import Rotation

    R = Rotation.random(5, rng=rng).as_matrix()
    t = rng.normal(size=(5, 3)) * 0.1 + [0, 0, 0.8]
    axes = np.tile([0.0, 0.0, 1.0], (5, 1))
    turned = R @ Rotation.from_euler("z", 1.1).as_matrix()
    np.testing.assert_allclose(canonical_rotation(turned, t, axes), canonical_rotation(R, t, axes), atol=1e-12)
    np.testing.assert_array_equal(canonical_rotation(R, t, 0 * axes), R)
    eye = -np.einsum("nji,nj->ni", canonical_rotation(R, t, axes), t)
    np.testing.assert_allclose(eye[:, 1], 0, atol=1e-12)
