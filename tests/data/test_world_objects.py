"""The household objects: closed shapes, right sizes, symmetries that hold, the same from the same seed."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from poet_loc.data.world.bop_writer import write_models
from poet_loc.data.world.objects import clutter, household_objects
from poet_loc.data.world.sampling import look_at, resting_pose
from poet_loc.io.bop_models import read_models_info

OBJECTS = household_objects(0)


def test_ten_objects_with_two_hidden_symmetries_and_a_true_one():
    assert [thing.object_id for thing in OBJECTS] == list(range(1, 11))
    assert len({thing.name for thing in OBJECTS}) == 10
    assert sum(thing.silhouette_symmetric and thing.symmetry is None for thing in OBJECTS) >= 2
    assert [thing.name for thing in OBJECTS if thing.symmetry is not None] == ["bowl"]


@pytest.mark.parametrize("thing", [*OBJECTS, *clutter(0, 6)], ids=lambda thing: thing.name)
def test_meshes_are_centred_with_unit_normals_outside(thing):
    mesh = thing.mesh
    np.testing.assert_allclose(mesh.vertices.min(0), -mesh.vertices.max(0), atol=1e-12)
    assert mesh.uv.min() >= 0
    assert mesh.uv.max() <= 1
    used = np.unique(mesh.faces)
    lengths = np.linalg.norm(mesh.normals[used], axis=1)
    assert np.mean(np.abs(lengths - 1) < 1e-6) > 0.85  # but for the tips of surfaces of revolution
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    face_normal = np.cross(b - a, c - a)
    agree = np.einsum("ij,ij->i", face_normal, mesh.normals[mesh.faces].sum(1))
    assert np.mean(agree >= -1e-12) > 0.98


@pytest.mark.parametrize("number", [1, 3, 4, 10])
def test_simple_bodies_are_closed_and_have_their_volume(number):
    thing = OBJECTS[number - 1]
    body = trimesh.Trimesh(thing.mesh.vertices, thing.mesh.faces)
    body.merge_vertices(merge_tex=True, merge_norm=True)
    assert body.is_watertight
    x, y, z = thing.extent
    full = {1: x * y * z, 3: np.pi / 4 * x * y * z, 4: np.pi / 4 * x * y * z, 10: x * y * z}[number]
    assert 0.85 * full < body.volume <= full * (1 + 1e-9)


def test_diameter_is_the_largest_distance():
    for thing in OBJECTS[:3]:
        points = thing.mesh.vertices
        brute = max(np.linalg.norm(points - point, axis=1).max() for point in points)
        assert thing.diameter == pytest.approx(brute, rel=1e-9)


def test_the_bowl_looks_the_same_after_any_turn():
    bowl = OBJECTS[8]
    columns = bowl.texture[: round(0.6 * 512)]
    assert np.all(columns == columns[:, :1])
    turned = Rotation.from_euler("z", 2 * np.pi / 48).apply(bowl.mesh.vertices)
    gaps = np.linalg.norm(turned[:, None] - bowl.mesh.vertices, axis=-1).min(1)
    assert gaps.max() < 1e-9


def test_the_cans_silhouette_hides_the_turn_and_the_label_shows_it():
    for can in (OBJECTS[2], OBJECTS[3]):
        radius = np.hypot(can.mesh.vertices[:, 0], can.mesh.vertices[:, 1])
        outer = radius[radius > 0.9 * radius.max()]
        assert np.ptp(outer) < 0.12 * radius.max()
        label = can.texture[: round(0.6 * 512)].astype(float)
        for shift in range(64, 512, 64):
            assert np.abs(label - np.roll(label, shift, axis=1)).mean() > 8


def test_same_seed_same_objects_other_seed_other_labels():
    again, other = household_objects(0), household_objects(1)
    for thing, same in zip(OBJECTS, again):
        np.testing.assert_array_equal(thing.texture, same.texture)
        np.testing.assert_array_equal(thing.mesh.vertices, same.mesh.vertices)
    assert sum(not np.array_equal(a.texture, b.texture) for a, b in zip(OBJECTS, other)) >= 9


def test_models_are_written_as_bop_wants_them(tmp_path):
    write_models(tmp_path, OBJECTS)
    info = read_models_info(tmp_path / "models_info.json")
    for thing in OBJECTS:
        assert info[thing.object_id].diameter_m == pytest.approx(thing.diameter, abs=1e-6)
        assert (info[thing.object_id].symmetry is not None) == (thing.symmetry is not None)
        loaded = trimesh.load(tmp_path / f"obj_{thing.object_id:06d}.ply", process=False)
        np.testing.assert_allclose(np.asarray(loaded.vertices), thing.mesh.vertices * 1e3, atol=1e-4)
        assert len(loaded.faces) == len(thing.mesh.faces)
    assert json.loads((tmp_path / "names.json").read_text())["9"] == "bowl"


@pytest.mark.parametrize("kind", ["usual", "resting", "leaning", "free"])
def test_things_touch_the_table(kind):
    rng = np.random.default_rng(0)
    for thing in OBJECTS:
        rotation, height = resting_pose(thing, rng, kind)
        lowest = rotation.apply(thing.mesh.vertices)[:, 2].min() + height
        assert lowest == pytest.approx(0.0, abs=1e-12)
        if kind == "usual":
            assert rotation.apply(thing.resting[0])[2] == pytest.approx(1.0)


def test_look_at_keeps_the_target_on_the_axis_and_the_horizon_level():
    eye, target = np.array([0.6, -0.4, 0.5]), np.array([0.05, 0.02, 0.0])
    T_world_cam = look_at(eye, target)
    seen = T_world_cam.inv().apply(target)
    np.testing.assert_allclose(seen, [0, 0, np.linalg.norm(target - eye)], atol=1e-12)
    assert T_world_cam.rotation.apply([1.0, 0, 0])[2] == pytest.approx(0.0, abs=1e-12)
    assert T_world_cam.rotation.apply([0, 1.0, 0])[2] < 0  # the image's y points down
