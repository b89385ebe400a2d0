"""What the evaluation of object poses reads: results files, the true poses of a BOP split, object models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.input_error import InputError
from poet_loc.io.bop import read_bop_scene
from poet_loc.io.bop_models import BopModel, read_models_info
from poet_loc.io.bop_results_csv import BopResults, read_bop_results
from poet_loc.io.input_text import read_json
from poet_loc.io.ply import read_model_points
from poet_loc.io.poet_results import read_poet_results
from poet_loc.report.visible_surface import SurfaceSource, image_size

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EvaluatePosesOptions:
    """What is compared with what."""

    models: Path
    """Folder of models_info.json and obj_000001.ply, ... (BOP, e.g. models_eval)."""
    least_visible: float = 0.1
    """True objects below this visible share do not count."""
    keyframes: Path | None = None
    """File of lines like 0048/000001 that restricts the images."""
    symmetric: tuple[int, ...] = ()
    """Object ids that ADD(-S) measures by the nearest point; empty: those with a symmetry in models_info.json."""
    names: Path | None = None
    """Classes file, object id to name."""
    points: int = 1000
    """Model points per object, evenly picked."""
    scene: int | None = None
    """Scene of a results.json, which does not tell it."""
    vsd: SurfaceSource = "none"
    """Measure the visible surface, too (slow): against the split's depth images, or, where it has none, against the
    true objects rendered together."""


@dataclass(frozen=True)
class ObjectModel:
    """What the errors of one object need."""

    name: str
    points: Array
    """(P, 3) m."""
    info: BopModel
    symmetric: bool
    """Measured by ADD-S in ADD(-S)."""


@dataclass(frozen=True)
class Truth:
    """The objects that are there, G rows."""

    scene_ids: NDArray[np.int64]
    image_ids: NDArray[np.int64]
    object_ids: NDArray[np.int64]
    T_cam_obj: RigidTransform
    cameras: Array
    """(G, 3, 3) of each object's image."""
    image_width: int


def read_results(path: Path, options: EvaluatePosesOptions) -> BopResults:
    """Read BOP results, or PoET's results.json: the image is the number in its id, the object that of the class."""
    if path.suffix != ".json":
        return read_bop_results(path)
    if options.scene is None:
        raise InputError("does not tell its scene", path=path, fix="give --scene")
    found = read_poet_results(path)
    numbers = np.array([int("".join(c for c in image if c.isdigit()) or -1) for image in found.image_ids])
    objects = found.classes if options.names is None else np.array(list(_names(options)))[found.classes - 1]
    count = len(found)
    return BopResults(
        np.full(count, options.scene, np.int64),
        numbers[found.image_indices],
        objects.astype(np.int64),
        np.ones(count),
        found.T_cam_obj,
        np.full(count, -1.0),
    )


def _names(options: EvaluatePosesOptions) -> dict[int, str]:
    if options.names is None:
        return {}
    content = read_json(options.names)
    try:
        return {int(number): str(name) for number, name in content.items()}
    except (AttributeError, ValueError):
        raise InputError('is no classes file like {"1": "name"}', path=options.names) from None


def read_truth(split: str | Path, options: EvaluatePosesOptions) -> Truth:
    """Read the true poses of a BOP split."""
    folders = sorted(p for p in Path(split).glob("*") if p.name.isdigit()) if Path(split).is_dir() else []
    if not folders:
        raise InputError("no BOP split: it has no folders like 000001", path=split)
    wanted = None if options.keyframes is None else _keyframes(options.keyframes)
    columns = [found for folder in folders if len((found := _true_poses(folder, options, wanted))[0])]
    if not columns:
        raise InputError("no object is visible enough", path=split)
    scenes, images, objects, poses, cameras = zip(*columns, strict=True)
    return Truth(
        np.concatenate(scenes),
        np.concatenate(images),
        np.concatenate(objects),
        RigidTransform.concatenate(list(poses)),
        np.concatenate(cameras),
        image_size(folders[0])[0],
    )


def _true_poses(
    folder: Path, options: EvaluatePosesOptions, wanted: set[tuple[int, int]] | None
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], RigidTransform, Array]:
    """Return the first five columns of `Truth` for one scene."""
    scene = read_bop_scene(folder)
    rows = scene.annotations
    if rows is None:
        raise InputError("has no scene_gt.json", path=folder)
    number = int(folder.name)
    keep = np.ones(len(rows), bool)
    if rows.visible_fractions is not None:
        keep &= rows.visible_fractions >= options.least_visible
    if wanted is not None:
        keep &= np.array([(number, image) in wanted for image in rows.image_ids.tolist()])
    place = np.searchsorted(scene.image_ids, rows.image_ids[keep])
    ids = np.full(int(keep.sum()), number)
    return ids, rows.image_ids[keep], rows.object_ids[keep], rows.T_cam_obj[keep], scene.camera_matrices[place]


def read_models(options: EvaluatePosesOptions, object_ids: Sequence[int]) -> dict[int, ObjectModel]:
    """Read points, diameters and symmetries of the objects."""
    infos = read_models_info(options.models / "models_info.json")
    names = _names(options)
    models = {}
    for number in object_ids:
        if number not in infos:
            raise InputError(f"does not know object {number}", path=options.models / "models_info.json")
        points = read_model_points(options.models / f"obj_{number:06d}.ply")
        picked = np.linspace(0, len(points) - 1, min(options.points, len(points))).astype(int)
        info = infos[number]
        symmetric = bool(info.symmetries_continuous) or info.symmetries_discrete is not None
        chosen = number in options.symmetric if options.symmetric else symmetric
        models[number] = ObjectModel(names.get(number, f"{number:03d}"), points[picked], info, chosen)
    return models


def _keyframes(path: Path) -> set[tuple[int, int]]:
    pairs = set()
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        scene, _, image = line.strip().partition("/")
        if line.strip() and not (scene.isdigit() and image.isdigit()):
            raise InputError(f"{line.strip()!r} is no key frame", path=path, line=number, fix="write 0048/000001")
        if line.strip():
            pairs.add((int(scene), int(image)))
    return pairs
