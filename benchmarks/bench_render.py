"""Depth and masks of the rendered world: our rasteriser beside embree rays, the same scenes in one run."""

from __future__ import annotations

import time
from statistics import median

import numpy as np
import trimesh

from poet_loc.data.world.sampling import random_intrinsics, random_scene, random_view
from poet_loc.data.world.view import depth_and_things, load_assets, place, render_image

SIZE = (320, 240)
SCENES = 12


def embree(geometry, intrinsics) -> np.ndarray:
    """Depth (h, w) by one ray per pixel, m; inf where nothing is."""
    fx, fy, cx, cy = intrinsics
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], -1).reshape(-1, 3)
    mesh = trimesh.Trimesh(geometry.points, geometry.faces, process=False)
    points, ray, _ = mesh.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    depth = np.full(len(rays), np.inf)
    depth[ray] = points[:, 2]
    return depth.reshape(u.shape)


def seconds(work) -> tuple[float, object]:
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def main() -> None:
    assets = load_assets(0)
    times: dict[str, list[float]] = {"rasteriser": [], "embree": [], "whole image": []}
    for number in range(SCENES + 1):
        rng = np.random.default_rng([9, number])
        scene, T_cam_world, intrinsics = random_scene(assets, rng), random_view(rng).inv(), random_intrinsics(SIZE, rng)
        geometry = place(assets, scene, T_cam_world, intrinsics)
        ours, (depth, _) = seconds(lambda g=geometry: depth_and_things(g, SIZE))
        theirs, peer = seconds(lambda g=geometry, k=intrinsics: embree(g, k))
        image, _ = seconds(
            lambda s=scene, T=T_cam_world, k=intrinsics: render_image(assets, s, T, k, SIZE)
        )  # 2x2 samples, textures, light and shadow
        both = np.isfinite(depth) & np.isfinite(peer)
        assert np.median(np.abs(depth[both] - peer[both])) < 1e-5
        if number:  # the first compiles
            for name, value in zip(times, (ours, theirs, image)):
                times[name].append(value)
    base = median(times["rasteriser"])
    print(f"{SCENES} scenes of {SIZE[0]}x{SIZE[1]}, process CPU, median; depths agree to 1e-5 m")
    for name, values in times.items():
        print(f"  {name:12} {1e3 * median(values):7.1f} ms   {median(values) / base:6.1f} x the rasteriser")


if __name__ == "__main__":
    main()
