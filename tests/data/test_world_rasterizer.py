"""The rasteriser against rays: trimesh and embreex see the same things at the same depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.data.world.rasterizer import cover
from poet_loc.data.world.sampling import look_at, random_intrinsics, random_scene, random_view
from poet_loc.data.world.view import depth_and_things, load_assets, place, render_image, silhouette

SIZE = (96, 72)


@pytest.fixture(scope="module")
def assets():
    return load_assets(0)


def a_scene(assets, number):
    rng = np.random.default_rng([5, number])
    return random_scene(assets, rng), random_view(rng).inv(), random_intrinsics(SIZE, rng)


def ray_hits(geometry, intrinsics):
    """Depth and thing along the ray of each pixel centre, by embreex."""
    fx, fy, cx, cy = intrinsics
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], -1).reshape(-1, 3)
    mesh = trimesh.Trimesh(geometry.points, geometry.faces, process=False)
    points, ray, face = mesh.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    depth, thing = np.full(len(rays), np.inf), np.full(len(rays), -1)
    depth[ray], thing[ray] = points[:, 2], geometry.face_thing[face]
    return depth.reshape(u.shape), thing.reshape(u.shape)


@pytest.mark.parametrize("number", range(4))
def test_depth_and_things_are_what_rays_meet(assets, number):
    scene, T_cam_world, intrinsics = a_scene(assets, number)
    geometry = place(assets, scene, T_cam_world, intrinsics)
    depth, thing = depth_and_things(geometry, SIZE)
    ray_depth, ray_thing = ray_hits(geometry, intrinsics)
    assert (ray_thing >= 0).mean() > 0.03  # something is in view
    same = thing == ray_thing
    assert same.mean() > 0.998  # an edge may fall to either side
    both = same & (thing >= 0)
    gap = np.abs(depth[both] - ray_depth[both])
    assert np.median(gap) < 1e-5
    assert np.quantile(gap, 0.99) < 1e-3


def test_a_silhouette_is_the_thing_seen_alone(assets):
    scene, T_cam_world, intrinsics = a_scene(assets, 1)
    geometry = place(assets, scene, T_cam_world, intrinsics)
    _, thing = depth_and_things(geometry, SIZE)
    for index in range(len(scene.things)):
        alone = silhouette(geometry, index, (0, 0, *SIZE))
        assert np.all(alone[thing == index])  # what is seen belongs to the outline
        shifted = silhouette(geometry, index, (-7, -3, SIZE[0] + 7, SIZE[1] + 3))
        np.testing.assert_array_equal(shifted[3:, 7:], alone)


def test_the_bowl_looks_the_same_from_all_sides_and_the_can_does_not(assets):
    rng = np.random.default_rng(4)
    scene = random_scene(assets, rng)
    camera = look_at(np.array([0.35, 0.0, 0.3]), np.array([0.0, 0.0, 0.03])).inv()

    def seen(number: int, turns: int) -> np.ndarray:
        turn = Rotation.from_euler("z", turns * 2 * np.pi / 48)  # the mesh has 48 segments
        height = -assets.objects[number].mesh.vertices[:, 2].min()
        T_world_thing = RigidTransform.from_components([[0, 0, height]], Rotation.concatenate([turn]))
        alone = replace(scene, things=(number,), T_world_thing=T_world_thing, gains=np.ones((1, 3)))
        return render_image(assets, alone, camera, (200.0, 200.0, 47.5, 35.5), SIZE)

    for turns in (7, 24, 31):
        assert np.abs(seen(8, turns) - seen(8, 0)).max() < 0.02
        assert np.abs(seen(3, turns) - seen(3, 0)).max() > 0.2


def test_a_triangle_covers_the_samples_inside_it():
    u, v = np.array([1.0, 9.0, 1.0], np.float32), np.array([1.0, 1.0, 9.0], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    triangle, weight = cover(u, v, np.array([1.0, 1.0, 3.0], np.float32), faces, 12, 11)
    y, x = np.mgrid[0:11, 0:12]
    np.testing.assert_array_equal(triangle == 0, (x >= 1) & (y >= 1) & (x + y <= 10))
    assert weight[5, 1] == pytest.approx(2.0)  # halfway along the edge between weights 1 and 3


def test_what_is_in_front_hides_what_is_behind_in_either_order():
    u, v = np.array([0, 20, 0, 0, 20, 0], np.float32), np.array([0, 0, 20, 0, 0, 20], np.float32)
    weight = np.array([1, 1, 1, 2, 2, 2], np.float32)
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 4, 5], [0, 1, 2]]):
        triangle, _ = cover(u, v, weight, np.array(faces, np.int32), 8, 8)
        assert np.all(np.array(faces)[triangle][..., 0] == 3)


def test_more_samples_converge_to_a_finer_image(assets):
    scene, T_cam_world, intrinsics = a_scene(assets, 2)
    images = {s: render_image(assets, scene, T_cam_world, intrinsics, SIZE, samples=s) for s in (1, 2, 6)}
    errors = {s: np.abs(images[s] - images[6]).mean() for s in (1, 2)}
    assert errors[2] < 0.6 * errors[1]
    assert all(np.isfinite(image).all() and image.min() >= 0 for image in images.values())


def test_a_shadow_falls_away_from_the_sun_and_only_darkens(assets):
    rng = np.random.default_rng(3)
    scene = random_scene(assets, rng)
    high = RigidTransform.from_components([0, 0, 1.3], Rotation.from_euler("x", 180, degrees=True))
    box = scene.things.index(next(t for t in scene.things if t < 10))
    lights = replace(scene.lights, towards_sun=np.array([0.8, 0.0, 0.6]), sun=np.ones(3), fill=np.zeros(3))
    alone = replace(
        scene, things=(0,), T_world_thing=RigidTransform.from_translation([[0, 0, 0.1]]), gains=scene.gains[[box]],
        lights=lights, table_half_size=1.0, table_repeats=1.0, turn=0.0,
    )  # fmt: skip
    far = replace(alone, T_world_thing=RigidTransform.from_translation([[0, 0.9, 0.1]]))
    camera = high.inv()
    intrinsics = (110.0, 110.0, SIZE[0] / 2, SIZE[1] / 2)
    with_box, without = (render_image(assets, s, camera, intrinsics, SIZE) for s in (alone, far))
    darker = (without - with_box).mean(-1)
    _, thing = depth_and_things(place(assets, alone, camera, intrinsics), SIZE)
    middle = SIZE[1] // 2
    table = thing[middle] < 0
    columns = np.arange(SIZE[0])
    shaded = table & (darker[middle] > 0.05)
    assert shaded.sum() >= 5
    assert np.all(columns[shaded] < SIZE[0] / 2)  # the sun stands at +x
    assert darker[middle][table].min() > -1e-3
