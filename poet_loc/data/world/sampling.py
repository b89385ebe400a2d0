"""Random scenes and cameras: what lies on the table, the light, and from where it is seen (domain randomisation)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.data.world.mesh import Array
from poet_loc.data.world.objects import WorldObject
from poet_loc.data.world.view import SURFACES, Assets, Lights, Scene


def resting_pose(thing: WorldObject, rng: np.random.Generator, kind: str) -> tuple[Rotation, float]:
    """Return an orientation in the world and the height (m) of the origin that lets the thing touch the table.

    kind: "usual" stands as one would put it down, "resting" on any side it can rest on, "leaning" tilted by 15 to 70
    degrees against something unseen, "free" any orientation.
    """
    if kind == "free":
        rotation = Rotation.random(rng=rng)
    else:
        sides = thing.resting[:1] if kind == "usual" else thing.resting
        up = np.asarray(sides[rng.integers(len(sides))])
        rotation = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * Rotation.align_vectors([[0, 0, 1.0]], [up])[0]
        if abs(up[2]) < 0.5:  # a thing that lies may have rolled about its own axis, if it is round
            roll = rng.uniform(-np.pi, np.pi) if thing.silhouette_symmetric else 0.0
            rotation = rotation * Rotation.from_euler("z", roll)
        if kind == "leaning":
            heading = rng.uniform(-np.pi, np.pi)
            tilt = np.deg2rad(rng.uniform(15, 70))
            rotation = Rotation.from_rotvec(tilt * np.array([np.cos(heading), np.sin(heading), 0.0])) * rotation
    return rotation, -float(rotation.apply(thing.mesh.vertices)[:, 2].min())


def arrange(
    assets: Assets, numbers: list[int], kinds: list[str], rng: np.random.Generator, reach: float
) -> RigidTransform:
    """Return T_world_thing of things spread over a disc of radius reach (m), side by side where there is room."""
    rotations: list[Rotation] = []
    places: list[Array] = []
    radii: list[float] = []
    for number, kind in zip(numbers, kinds):
        thing = assets.thing(number)
        rotation, height = resting_pose(thing, rng, kind)
        outline = rotation.apply(thing.mesh.vertices)[:, :2]
        radius = float(np.linalg.norm(np.ptp(outline, axis=0))) / 2.0 * 0.85
        spot = _free_spot(places, radii, radius, rng, reach)
        rotations.append(rotation)
        radii.append(radius)
        places.append(np.array([*spot, height]))
    return RigidTransform.from_components(np.stack(places), Rotation.concatenate(rotations))


def _free_spot(places: list[Array], radii: list[float], radius: float, rng: np.random.Generator, reach: float) -> Array:
    for attempt in range(60):
        angle, distance = rng.uniform(-np.pi, np.pi), (reach + 0.004 * attempt) * np.sqrt(rng.random())
        spot = distance * np.array([np.cos(angle), np.sin(angle)])
        if all(np.linalg.norm(spot - place[:2]) > radius + other for place, other in zip(places, radii)):
            return spot
    return spot * 1.5


def random_lights(rng: np.random.Generator) -> Lights:
    """Return a sky, a sun and a fill light of random colours, strengths and directions."""

    def tint(spread: float) -> Array:
        return 1.0 + rng.uniform(-spread, spread, 3)

    def direction(lowest: float) -> Array:
        angle, height = rng.uniform(-np.pi, np.pi), rng.uniform(lowest, 1.0)
        flat = np.sqrt(1 - height**2)
        return np.array([flat * np.cos(angle), flat * np.sin(angle), height])

    sky = rng.uniform(0.25, 0.9)
    return Lights(
        sky=sky * tint(0.15),
        ground=sky * rng.uniform(0.3, 0.9) * tint(0.2),
        towards_sun=direction(0.35),
        sun=rng.uniform(0.1, 1.1) * tint(0.15),
        towards_fill=direction(0.0),
        fill=rng.uniform(0.0, 0.3) * tint(0.3),
    )


def compose(
    assets: Assets, objects: list[int], kinds: list[str], others: int, rng: np.random.Generator, reach: float
) -> Scene:
    """Return a scene of the given objects (numbers 0..9) and some clutter under random light on a random table."""
    strange = list(len(assets.objects) + rng.choice(len(assets.clutter), others, replace=False))
    numbers = [*objects, *(int(number) for number in strange)]
    T_world_thing = arrange(assets, numbers, [*kinds, *["resting"] * others], rng, reach)
    gains = np.clip(1.0 + rng.normal(0.0, 0.06, (len(numbers), 3)) + rng.normal(0.0, 0.08, (len(numbers), 1)), 0.6, 1.4)
    return Scene(
        things=tuple(numbers),
        T_world_thing=T_world_thing,
        gains=gains,
        lights=random_lights(rng),
        table_surface=int(rng.integers(SURFACES)),
        table_half_size=float(rng.uniform(0.35, 1.2)),
        table_repeats=float(rng.uniform(1.0, 5.0)),
        backdrop_surface=int(rng.integers(SURFACES)),
        backdrop_gain=float(rng.uniform(0.2, 1.0)),
        turn=float(rng.uniform(-np.pi, np.pi)),
    )


def random_scene(assets: Assets, rng: np.random.Generator) -> Scene:
    """Return a training scene: 3 to 7 of the objects, each at most once, and up to four other things."""
    count = int(rng.integers(3, 8))
    objects = [int(number) for number in rng.permutation(len(assets.objects))[:count]]
    kinds = [str(rng.choice(["usual", "resting", "leaning", "free"], p=[0.45, 0.27, 0.18, 0.10])) for _ in objects]
    return compose(assets, objects, kinds, int(rng.integers(0, 5)), rng, reach=float(rng.uniform(0.12, 0.26)))


def look_at(eye: Array, target: Array, roll: float = 0.0) -> RigidTransform:
    """Return T_world_cam of a camera at eye (m) that looks at target; x is level but for roll (rad) about the view."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=-1))
    return RigidTransform.from_components(eye, rotation * Rotation.from_euler("z", roll))


def random_view(rng: np.random.Generator) -> RigidTransform:
    """Return T_world_cam somewhere above the table, 0.45 to 1.1 m from its middle, 12 to 75 degrees up."""
    angle, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(12, 75))
    distance = rng.uniform(0.45, 1.1)
    flat = distance * np.cos(elevation)
    eye = np.array([flat * np.cos(angle), flat * np.sin(angle), distance * np.sin(elevation) + 0.05])
    target = np.array([*rng.normal(0.0, 0.05, 2), rng.uniform(0.0, 0.1)])
    return look_at(eye, target, roll=float(rng.normal(0.0, 0.2)))


def random_intrinsics(size: tuple[int, int], rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Return (fx, fy, cx, cy) in pixels near a 43 degree lens, so that no network learns one camera by heart."""
    width, height = size
    focal = width * rng.uniform(1.1, 1.45)
    return (
        float(focal), float(focal * rng.uniform(0.99, 1.01)),
        float(width / 2 - 0.5 + rng.normal(0, 0.01) * width), float(height / 2 - 0.5 + rng.normal(0, 0.01) * width),
    )  # fmt: skip
