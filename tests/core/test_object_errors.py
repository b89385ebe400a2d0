"""ADD, ADD-S and areas under the curve against the official evaluator's numbers and brute force."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core import object_errors as oe
from poet_loc.core.geometry import make_pose


def poses_of(matrices: np.ndarray) -> RigidTransform:
    return make_pose(Rotation.from_matrix(matrices[:, :, :3]), matrices[:, :, 3])


@pytest.fixture(scope="module")
def official(shared_fixtures: Path) -> tuple[dict, dict]:
    folder = shared_fixtures / "poet_official" / "eval"
    with np.load(folder / "evaluator_inputs.npz") as archive:
        inputs = dict(archive)
    return inputs, json.loads((folder / "PoseEvaluator_results.json").read_text())


@pytest.mark.parametrize("name", ["alpha", "beta"])
def test_official_errors_and_areas(official: tuple[dict, dict], name: str) -> None:
    inputs, results = official
    points = inputs[f"pts_m_{name}"]
    est, ref = poses_of(inputs[f"pred_{name}"]), poses_of(inputs[f"gt_{name}"])
    error, error_s = oe.add(est, ref, points), oe.add_s(est, ref, points)
    np.testing.assert_allclose(error, inputs[f"err_{name}_add"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(error_s, inputs[f"err_{name}_adi"], rtol=0, atol=1e-9)
    for metric, values in (("add", error), ("adi", error_s)):
        published = results[metric][name]["accuracy"]["auc"]
        assert oe.area_under_curve_published(values) == pytest.approx(published, abs=1e-9)
        assert oe.area_under_curve(values) == pytest.approx(published, abs=0.2)
    assert oe.average_translation_error(est, ref) == pytest.approx(results["avg_t_error"][name], abs=1e-9)
    assert np.degrees(oe.average_rotation_error(est, ref)) == pytest.approx(results["avg_rot_error"][name], abs=1e-6)


def test_add_s_by_brute_force_and_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(0.0, 0.05, (30, 3))
    est, ref = (RigidTransform.from_exp_coords(rng.normal(0.0, 0.3, (7, 6))) for _ in range(2))
    moved_est, moved_ref = (
        np.einsum("nij,pj->npi", T.rotation.as_matrix(), points) + T.translation[:, None] for T in (est, ref)
    )
    brute = np.linalg.norm(moved_ref[:, :, None] - moved_est[:, None], axis=-1).min(axis=2).mean(axis=1)
    np.testing.assert_allclose(oe.add_s(est, ref, points), brute, atol=1e-12)
    whole = oe.add(est, ref, points)
    monkeypatch.setattr(oe, "_POINTS_AT_ONCE", 60)
    np.testing.assert_array_equal(oe.add(est, ref, points), whole)
    np.testing.assert_allclose(oe.add_s(est, ref, points), brute, atol=1e-12)


def test_areas_of_known_errors() -> None:
    assert oe.area_under_curve_published(np.zeros(10)) == pytest.approx(99.858, abs=5e-4)
    assert oe.area_under_curve(np.zeros(10)) == 100.0
    assert oe.area_under_curve([0.05, 0.2]) == pytest.approx(25.0)
    assert oe.area_under_curve([]) == oe.area_under_curve_published([]) == 0.0
    errors = np.random.default_rng(2).gamma(2.0, 0.03, 40)
    integral, _ = quad(lambda limit: np.mean(errors < limit), 0.0, 0.1, points=np.sort(errors[errors < 0.1]), limit=200)
    assert oe.area_under_curve(errors) == pytest.approx(100.0 * integral / 0.1, abs=1e-9)


def test_no_pose_has_no_average() -> None:
    none = RigidTransform.identity(1)[:0]
    assert np.isnan(oe.average_translation_error(none, none))
    assert np.isnan(oe.average_rotation_error(none, none))
    assert len(oe.add(none, none, np.zeros((5, 3)))) == len(oe.add_s(none, none, np.zeros((5, 3)))) == 0
