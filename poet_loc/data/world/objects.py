"""The ten household objects of the world, and the clutter beside them: meshes and textures from a seed.

Two of them (the cans) have a rotation-symmetric silhouette under a label that is not; the bowl is symmetric
in shape and looks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from poet_loc.core.records import Symmetry
from poet_loc.data.world import labels
from poet_loc.data.world.labels import Color, Image
from poet_loc.data.world.mesh import Array, Mesh, Rect, Section, box, loft, merge, revolve, tube

ATLAS = 512  # texels per side

_WHOLE_SIDE: Rect = (0.0, 0.0, 1.0, 0.6)
_CAP: Rect = (0.02, 0.62, 0.36, 0.98)
_EXTRA: Rect = (0.4, 0.62, 0.98, 0.98)
_UP, _DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
_LYING = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))


@dataclass(frozen=True)
class WorldObject:
    """An object of the world: its shape, its looks and how it may rest on a table."""

    object_id: int
    name: str
    mesh: Mesh
    texture: Image
    symmetry: Symmetry | None = None
    silhouette_symmetric: bool = False
    """The outline does not show the turn about z, the label does."""
    resting: tuple[tuple[float, float, float], ...] = (_UP,)
    """Object axes that may point up when it rests on the table; the first is the usual one."""
    shine: float = 0.15
    """Strength of the highlight, 0..1."""

    @property
    def diameter(self) -> float:
        """Largest distance between two points of the mesh, m."""
        from scipy.spatial import ConvexHull
        from scipy.spatial.distance import pdist

        points = self.mesh.vertices
        return float(pdist(points[ConvexHull(points).vertices]).max())

    @property
    def extent(self) -> Array:
        """(3,) size of the bounding box along object axes, m; its middle is the origin."""
        return np.ptp(self.mesh.vertices, axis=0)


def household_objects(seed: int = 0) -> tuple[WorldObject, ...]:
    """Return the ten objects, ids 1..10 in order; the seed draws labels and pictures."""
    builders: tuple[Callable[[int, np.random.Generator], WorldObject], ...] = (
        _cracker_box, _sugar_box, _soup_can, _coffee_can, _mustard_bottle,
        _cleaner_bottle, _mug, _drill, _bowl, _meat_tin,
    )  # fmt: skip
    return tuple(build(index, np.random.default_rng([seed, 1, index])) for index, build in enumerate(builders, start=1))


def clutter(seed: int = 0, count: int = 40) -> tuple[WorldObject, ...]:
    """Return things that are none of the ten, ids 1001..: boxes, tins and bottles in random sizes and labels."""
    return tuple(_clutter(1000 + index, np.random.default_rng([seed, 2, index])) for index in range(1, count + 1))


def _pixels(rect: Rect) -> tuple[slice, slice]:
    left, top, right, bottom = (round(value * ATLAS) for value in rect)
    return slice(top, bottom), slice(left, right)


def _box_rects() -> dict[str, Rect]:
    """Six patches with a margin, so that a coarse texture level does not bleed."""
    cells = {"+x": (0, 0), "-x": (1, 0), "+y": (2, 0), "-y": (0, 1), "+z": (1, 1), "-z": (2, 1)}
    return {
        name: (c / 3 + 0.01, r / 2 + 0.01, (c + 1) / 3 - 0.01, (r + 1) / 2 - 0.01) for name, (c, r) in cells.items()
    }


def _packet(
    rng: np.random.Generator, rects: dict[str, Rect], title: str, base: Color, second: Color, ink: Color
) -> Image:
    """Return a packet's atlas: a front with title and picture, another back, sides and lids."""
    atlas = labels.plain(ATLAS, ATLAS, base, rng)
    for name, rect in rects.items():
        rows, columns = _pixels(rect)
        face = np.ascontiguousarray(atlas[rows, columns])
        if name == "+x":
            face[: len(face) // 3] = second
            labels.write(face, title, (0.06, 0.04, 0.94, 0.3), ink, 1.6)
            labels.picture(face, (0.1, 0.42, 0.9, 0.92), rng, 12)
        elif name == "-x":
            face[-len(face) // 4 :] = second
            labels.small_print(face, (0.08, 0.06, 0.9, 0.5), rng, ink)
            labels.bar_code(face, (0.5, 0.78, 0.92, 0.95), rng)
            labels.picture(face, (0.08, 0.54, 0.42, 0.74), rng, 6)
        elif name in ("+y", "-y"):
            face[:, : face.shape[1] // 5 if name == "+y" else face.shape[1] // 2] = second
            labels.write(face, labels.word(rng, 5), (0.12, 0.1, 0.9, 0.25), ink)
            labels.picture(face, (0.2, 0.4, 0.8, 0.8), rng, 5)
        else:
            labels.write(face, labels.word(rng, 6), (0.1, 0.3, 0.9, 0.7), ink if name == "+z" else second)
        atlas[rows, columns] = face
    return atlas


def _cracker_box(object_id: int, rng: np.random.Generator) -> WorldObject:
    rects = _box_rects()
    texture = _packet(rng, rects, "CRACKERS", (178, 30, 34), (236, 200, 60), (250, 246, 235))
    mesh = box((0.06, 0.155, 0.205), rects)
    return WorldObject(object_id, "cracker_box", mesh, texture, resting=(_UP, *_LYING, _DOWN))


def _sugar_box(object_id: int, rng: np.random.Generator) -> WorldObject:
    rects = _box_rects()
    texture = _packet(rng, rects, "SUGAR", (238, 236, 225), (244, 206, 40), (20, 50, 130))
    mesh = box((0.043, 0.092, 0.175), rects)
    return WorldObject(object_id, "sugar_box", mesh, texture, resting=(_UP, *_LYING))


def _wrapped_label(rng: np.random.Generator, title: str, base: Color, second: Color, ink: Color, metal: Color) -> Image:
    """Return the atlas of a can: a label around it with one front, metal lids."""
    atlas = labels.plain(ATLAS, ATLAS, metal, rng)
    rows, columns = _pixels(_WHOLE_SIDE)
    side = labels.plain(rows.stop, columns.stop, base, rng)
    side[round(0.08 * len(side)) : round(0.4 * len(side)), round(0.28 * ATLAS) : round(0.72 * ATLAS)] = second
    labels.write(side, title, (0.3, 0.1, 0.7, 0.38), ink, 1.6)
    labels.picture(side, (0.33, 0.45, 0.67, 0.92), rng, 10)
    labels.small_print(side, (0.76, 0.15, 0.96, 0.85), rng, ink)
    labels.bar_code(side, (0.06, 0.5, 0.2, 0.85), rng)
    labels.picture(side, (0.04, 0.12, 0.24, 0.42), rng, 5)
    atlas[rows, columns] = side
    return atlas


def _rings(atlas: Image, rect: Rect, color: Color) -> None:
    rows, columns = _pixels(rect)
    y, x = np.mgrid[rows, columns].astype(float)
    radius = np.hypot(y - (rows.start + rows.stop) / 2, x - (columns.start + columns.stop) / 2)
    ring = (radius % 24 < 6)[..., None]
    atlas[rows, columns] = np.where(ring, np.asarray(color), atlas[rows, columns]).astype(np.uint8)


def _can(radius: float, height: float) -> Mesh:
    rim = 0.003
    profile = [(radius - rim, 0), (radius, rim / 2), (radius, rim), (radius - 0.001, rim + 0.001)]
    profile += [(radius - 0.001, height - rim), (radius, height - rim + 0.001), (radius - rim, height)]
    return revolve(profile, _WHOLE_SIDE, _CAP, 48).centred()


def _soup_can(object_id: int, rng: np.random.Generator) -> WorldObject:
    texture = _wrapped_label(rng, "SOUP", (196, 32, 40), (245, 240, 232), (30, 30, 34), (168, 168, 172))
    _rings(texture, _CAP, (120, 120, 126))
    mesh = _can(0.0338, 0.101)
    return WorldObject(object_id, "soup_can", mesh, texture, None, True, (_UP, *_LYING), 0.3)


def _coffee_can(object_id: int, rng: np.random.Generator) -> WorldObject:
    texture = _wrapped_label(rng, "COFFEE", (28, 62, 140), (240, 236, 226), (150, 24, 28), (196, 174, 120))
    _rings(texture, _CAP, (150, 130, 84))
    mesh = _can(0.051, 0.139)
    return WorldObject(object_id, "coffee_can", mesh, texture, None, True, (_UP, *_LYING), 0.3)


def _bottle_label(rng: np.random.Generator, title: str, base: Color, second: Color, ink: Color, cap: Color) -> Image:
    atlas = labels.plain(ATLAS, ATLAS, base, rng)
    rows, columns = _pixels(_WHOLE_SIDE)
    side = np.ascontiguousarray(atlas[rows, columns])
    front = side[round(0.42 * len(side)) : round(0.92 * len(side)), round(0.3 * ATLAS) : round(0.7 * ATLAS)]
    front[:] = second
    panel = np.ascontiguousarray(front)
    labels.write(panel, title, (0.08, 0.06, 0.92, 0.45), ink, 1.6)
    labels.picture(panel, (0.15, 0.5, 0.85, 0.95), rng, 8)
    front[:] = panel
    labels.small_print(side, (0.03, 0.5, 0.2, 0.9), rng, ink)
    labels.bar_code(side, (0.82, 0.55, 0.95, 0.85), rng)
    atlas[rows, columns] = side
    extra_rows, extra_columns = _pixels(_EXTRA)
    atlas[extra_rows, extra_columns] = cap
    return atlas


def _mustard_bottle(object_id: int, rng: np.random.Generator) -> WorldObject:
    texture = _bottle_label(rng, "MUSTARD", (240, 196, 30), (248, 238, 190), (150, 60, 20), (206, 40, 34))
    outline = [(0, 0.85), (0.006, 1.0), (0.05, 0.97), (0.11, 1.0), (0.132, 0.85), (0.15, 0.5), (0.156, 0.38)]
    body = loft([Section(z, 0.0285 * s, 0.047 * s, 2.4) for z, s in outline], _WHOLE_SIDE, _CAP)
    cap = revolve([(0.0165, 0.154), (0.0165, 0.17), (0.007, 0.178), (0.004, 0.192)], _EXTRA, _EXTRA, 24)
    mesh = merge([body, cap]).centred()
    return WorldObject(object_id, "mustard_bottle", mesh, texture, resting=(_UP, _LYING[0], _LYING[1]))


def _cleaner_bottle(object_id: int, rng: np.random.Generator) -> WorldObject:
    texture = _bottle_label(rng, "BLEACH", (228, 230, 232), (40, 110, 190), (252, 250, 240), (36, 84, 170))
    outline = [
        (0, 0.9, 0),
        (0.008, 1.0, 0),
        (0.12, 1.0, 0),
        (0.165, 0.72, -0.004),
        (0.2, 0.5, -0.012),
        (0.222, 0.4, -0.016),
    ]
    body = loft([Section(z, 0.034 * s, 0.049 * s, 3.0, x) for z, s, x in outline], _WHOLE_SIDE, _CAP)
    cap = revolve([(0.0165, 0.22), (0.0165, 0.25)], _EXTRA, _EXTRA, 24).moved((-0.016, 0, 0))
    handle = tube(_arc((0.0, 0.155), (0.034, 0.07), 14, -0.45, 1.25), 0.008, _EXTRA)
    mesh = merge([body, cap, handle]).centred()
    return WorldObject(object_id, "cleaner_bottle", mesh, texture, resting=(_UP, _LYING[2], _LYING[3]))


def _arc(centre_xz: tuple[float, float], radii_xz: tuple[float, float], count: int, start: float, end: float) -> Array:
    angles = np.linspace(start, end, count)
    x, z = centre_xz[0] + radii_xz[0] * np.cos(angles), centre_xz[1] + radii_xz[1] * np.sin(angles)
    return np.stack([x, np.zeros(count), z], -1)


def _mug(object_id: int, rng: np.random.Generator) -> WorldObject:
    atlas = labels.plain(ATLAS, ATLAS, (196, 48, 44), rng)
    rows, columns = _pixels(_WHOLE_SIDE)
    side = np.ascontiguousarray(atlas[rows, columns])
    labels.picture(side, (0.2, 0.2, 0.42, 0.8), rng, 8)
    labels.write(side, "TEA", (0.6, 0.25, 0.82, 0.75), (250, 240, 225), 2.0)
    atlas[rows, columns] = side
    atlas[_pixels(_EXTRA)] = (232, 222, 206)
    outer = revolve([(0.036, 0), (0.0405, 0.004), (0.0425, 0.02), (0.043, 0.085)], _WHOLE_SIDE, None, 40)
    inner = revolve([(0.0375, 0.006), (0.0385, 0.02), (0.0395, 0.08), (0.043, 0.085)], _EXTRA, None, 40)
    bottom = revolve([(1e-5, 0.0001), (0.036, 0.0)], _CAP, None, 40)
    floor = revolve([(1e-5, 0.006), (0.0375, 0.006)], _EXTRA, None, 40)
    handle = tube(_arc((-0.041, 0.045), (-0.03, 0.028), 16, -1.5, 1.5), 0.0055, (0.02, 0.02, 0.18, 0.1))
    mesh = merge([outer, inner, bottom, floor, handle]).centred()
    return WorldObject(object_id, "mug", mesh, atlas, resting=(_UP, _DOWN, _LYING[2], _LYING[3]), shine=0.45)


def _drill(object_id: int, rng: np.random.Generator) -> WorldObject:
    atlas = labels.plain(ATLAS, ATLAS, (232, 110, 24), rng)
    rows, columns = _pixels(_WHOLE_SIDE)
    side = np.ascontiguousarray(atlas[rows, columns])
    side[:, : round(0.12 * ATLAS)] = side[:, -round(0.12 * ATLAS) :] = (40, 40, 44)
    labels.write(side, "VOLT", (0.2, 0.5, 0.45, 0.8), (24, 24, 28), 1.8)
    labels.write(side, "VOLT", (0.58, 0.5, 0.83, 0.8), (24, 24, 28), 1.8)
    side[: round(0.22 * len(side))] = (44, 44, 48)
    atlas[rows, columns] = side
    atlas[_pixels(_EXTRA)] = (50, 50, 54)
    atlas[_pixels(_CAP)] = (36, 36, 40)
    lying = Rotation.from_euler("y", 90, degrees=True)
    outline = [(0, 0.8), (0.006, 1.0), (0.085, 1.0), (0.1, 0.8), (0.115, 0.75)]
    motor = loft([Section(z, 0.033 * s, 0.028 * s, 2.6) for z, s in outline], _WHOLE_SIDE, _CAP)
    chuck = revolve([(0.019, 0.112), (0.019, 0.132), (0.011, 0.15), (0.004, 0.152), (0.0035, 0.185)], _EXTRA, _CAP, 20)
    head = merge([motor, chuck]).moved((-0.06, 0, 0.155), lying)
    grip = loft([Section(0.03, 0.02, 0.016), Section(0.1, 0.018, 0.015), Section(0.14, 0.024, 0.018)], _EXTRA, _CAP, 20)
    pack = box((0.082, 0.056, 0.034), dict.fromkeys(_box_rects(), (0.22, 0.15, 0.45, 0.45))).moved((0.008, 0, 0.017))
    mesh = merge([head, grip.moved((-0.018, 0, 0)), pack]).centred()
    return WorldObject(object_id, "power_drill", mesh, atlas, resting=(_UP, _LYING[2], _LYING[3]))


def _bowl(object_id: int, rng: np.random.Generator) -> WorldObject:
    atlas = labels.plain(ATLAS, ATLAS, (44, 120, 150), rng, grain=0.0)
    rows, columns = _pixels(_WHOLE_SIDE)
    for top, bottom, color in ((0.0, 0.12, (236, 232, 220)), (0.3, 0.4, (230, 150, 40)), (0.6, 0.66, (236, 232, 220))):
        atlas[round(top * rows.stop) : round(bottom * rows.stop), columns] = color
    atlas[_pixels(_EXTRA)] = (226, 222, 208)
    outer = [(1e-5, 0.0), (0.035, 0.0), (0.04, 0.004), (0.06, 0.02), (0.073, 0.038), (0.08, 0.055)]
    inner = [(1e-5, 0.006), (0.034, 0.006), (0.057, 0.023), (0.07, 0.04), (0.08, 0.055)]
    lining = (0.52, 0.72, 0.86, 0.88)  # far from the patch's rim: no seam tells the turn, at any mip level
    mesh = merge([revolve(outer, _WHOLE_SIDE, None, 48), revolve(inner, lining, None, 48)]).centred()
    symmetry = Symmetry((0.0, 0.0, 1.0), "continuous")
    return WorldObject(object_id, "bowl", mesh, atlas, symmetry, True, (_UP, _DOWN), 0.4)


def _meat_tin(object_id: int, rng: np.random.Generator) -> WorldObject:
    texture = _wrapped_label(rng, "HAM", (30, 70, 60), (240, 220, 90), (140, 20, 60), (176, 176, 180))
    outline = [(0, 0.96), (0.003, 1.0), (0.079, 1.0), (0.082, 0.96)]
    mesh = loft([Section(z, 0.029 * s, 0.0505 * s, 5.0) for z, s in outline], _WHOLE_SIDE, _CAP, 56).centred()
    return WorldObject(object_id, "meat_tin", mesh, texture, resting=(_UP, *_LYING[:2]), shine=0.3)


def _clutter(object_id: int, rng: np.random.Generator) -> WorldObject:
    colors = [tuple(int(value) for value in rng.integers(15, 250, 3)) for _ in range(4)]
    title = labels.word(rng, int(rng.integers(3, 8)))
    kind = rng.integers(3)
    if kind == 0:
        rects = _box_rects()
        mesh = box(tuple(rng.uniform(0.03, 0.2, 3)), rects)
        texture = _packet(rng, rects, title, *colors[:3])
    else:
        count = 2 if kind == 1 else int(rng.integers(3, 7))
        heights = np.concatenate([[0.0], np.cumsum(rng.uniform(0.03, 0.1, count - 1))])
        radii = np.repeat(rng.uniform(0.02, 0.07), count) if kind == 1 else rng.uniform(0.012, 0.06, count)
        power, ratio = rng.choice([2.0, 2.0, 4.0]), rng.uniform(0.6, 1.6) if rng.random() < 0.4 else 1.0
        sections = [Section(z, r, r * ratio, power) for z, r in zip(heights, radii)]
        mesh = loft(sections, _WHOLE_SIDE, _CAP, 24)
        texture = _wrapped_label(rng, title, *colors)
    return WorldObject(object_id, f"clutter_{object_id}", mesh.centred(), texture, shine=float(rng.uniform(0, 0.5)))
