"""The checkpoint that comes with the package sees the rendered world, in images that it was not trained on."""

from __future__ import annotations

import numpy as np
import pytest

from poet_loc.data.packed import PackedImages, load_models, pack
from poet_loc.data.render import RenderOptions, render
from poet_loc.model.embedded import EMBEDDED_WEIGHTS, load_embedded
from poet_loc.model.small_detector import SmallDetector
from poet_loc.train.detector import validate_detector
from poet_loc.train.embedded import EMBEDDED, pose_figures, predict


@pytest.fixture(scope="module")
def figures(tmp_path_factory) -> dict[str, float]:
    out = tmp_path_factory.mktemp("unseen")
    split = render(RenderOptions(out, "test", 16, 950000, 16, jobs=1, progress=False))
    models = load_models(out / "models")
    images = PackedImages(pack(split, out / "packed"), models)
    network, _ = load_embedded()
    assert isinstance(network.detector, SmallDetector)
    found = validate_detector(network.detector, images, 16, 10)
    return found | pose_figures(*predict(network, images, 16, models), models)


def test_size_and_contents():
    network, config = load_embedded()
    assert EMBEDDED_WEIGHTS.stat().st_size < 20e6
    assert config.network == EMBEDDED
    assert config.refiner is not None
    assert config.object_ids == tuple(range(1, 11))
    assert all(np.isfinite(p.detach().numpy()).all() for p in network.parameters())


def test_objects_are_found(figures):
    assert figures["recall"] > 0.6
    assert figures["precision"] > 0.6


def test_poses_are_far_better_than_chance(figures):
    assert figures["t_cm"] < 2.0
    assert figures["r_deg"] < 10.0  # of random rotations the median is 126 degrees
    assert figures["auc_add_s"] > 80.0
