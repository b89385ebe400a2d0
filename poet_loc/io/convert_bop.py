"""BOP scenes become logs: ground truth, calibration, a map derived from the ground truth, and object poses."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, Camera, Landmark, LandmarkMap, ObjectPoses, Stamps
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.bop import BopAnnotations, BopScene, read_bop_scene
from poet_loc.io.bop_models import BopModel, read_models_info
from poet_loc.io.bop_results_csv import BopResults, read_bop_results
from poet_loc.io.bop_world import Placement, Sightings, fit_camera_offset, place_objects
from poet_loc.io.frames_csv import Frames, read_frames
from poet_loc.io.log_folder import Log, write_log
from poet_loc.io.object_poses_csv import count_instances
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class ConvertBopOptions:
    """How BOP scenes become logs."""

    scenes: tuple[int, ...] = ()
    """Scene numbers to convert; none: every scene below ROOT."""
    frame_rate: float = 30.0
    """Hz; an image's stamp is its number over this rate, unless --stamps tells it."""
    stamps: Path | None = None
    """A frames.csv (timestamp_ns,frame,image) whose frame is the image number, or a folder with one per scene,
    named as the scene is (000048.csv)."""
    results: Path | None = None
    """BOP results csv to take the object poses from; without it the ground truth becomes object_poses_gt.csv."""
    min_visible: float = 0.1
    """Ground-truth objects with a smaller visible share do not become detections (where scene_gt_info.json is)."""
    max_spread_mm: float = 5.0
    """A scene is refused where an object's world position spreads more over the frames (90th percentile), mm."""
    max_spread_deg: float = 1.0
    """The same for its orientation, degrees."""
    fit_camera_offset: bool = False
    """Fit one rigid offset between the camera of the trajectory and the camera of the annotations over all scenes
    (YCB-V's trajectory is the depth camera's), and move the trajectory to the annotations' camera."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Upward direction in the dataset's world axes; the log's world has it as z."""
    models_info: Path | None = None
    """models_info.json with the symmetries; without it the one of the dataset that ROOT belongs to, if there."""
    overwrite: bool = False
    """Replace an output folder that holds something."""


@dataclass(frozen=True)
class ConvertedScene:
    """One log that was made, and how well its ground truth holds together."""

    log: Path
    frames: int
    detections: int
    dropped: int
    """Estimates of objects that the scene's map does not have."""
    placements: tuple[Placement, ...]


@dataclass(frozen=True)
class BopConversion:
    """What a conversion made."""

    scenes: tuple[ConvertedScene, ...]
    T_trajectory_annotation: RigidTransform | None = None
    """Pose of the annotations' camera in the trajectory's, where it was fitted."""


@dataclass(frozen=True)
class _Source:
    """One scene folder as it was read."""

    folder: Path
    scene: BopScene
    annotations: BopAnnotations
    sightings: Sightings

    @property
    def T_world_cam(self) -> RigidTransform:
        assert self.scene.T_cam_world is not None
        return self.scene.T_cam_world.inv()

    def moved(self, T_cam_other: RigidTransform) -> _Source:
        """Return the source with the trajectory of another frame fixed to the camera."""
        assert self.scene.T_cam_world is not None
        scene = replace(self.scene, T_cam_world=T_cam_other.inv() * self.scene.T_cam_world)
        return replace(self, scene=scene, sightings=self.sightings.moved(T_cam_other))


def convert_bop(root: str | Path, out: str | Path, options: ConvertBopOptions | None = None) -> BopConversion:
    """Write one log per BOP scene below root: T_world_cam.tum, calibration, landmarks.json, object poses, frames.csv.

    A landmark is the robust mean over the frames of T_world_cam T_cam_obj. Raises InputError for a scene without
    world poses, and for one whose frames do not agree on where the objects stand; out then stays as it was.
    """
    options = options or ConvertBopOptions()
    root, out = Path(root), Path(out)
    sources = [_read_source(folder) for folder in _scene_folders(root, options.scenes)]
    offset = None
    if options.fit_camera_offset:
        offset = fit_camera_offset([source.sightings for source in sources])
        if offset is None:
            fix = "convert more scenes together, or without --fit-camera-offset"
            raise InputError("the camera turns too little to fit its offset", path=root, fix=fix)
        sources = [source.moved(offset) for source in sources]
    placements = [_placed(source, options) for source in sources]
    turn = _turn_to_z_up(options.up)
    models = _models(root, options.models_info)
    results = None if options.results is None else read_bop_results(options.results)
    inputs = [path for path in (root, options.results, options.stamps, options.models_info) if path is not None]
    converted = []
    with whole_folder(out, options.overwrite, inputs=inputs) as folder:
        for source, placed in zip(sources, placements, strict=True):
            path = out / source.folder.resolve().name
            poses, dropped = _object_poses(source, results, options)
            log = Log(
                path=path,
                object_poses={"gt" if results is None else "": poses},
                landmark_map=_landmark_map(placed, models, turn),
                calibration=Calibration(camera=_camera(source)),
                T_world_cam=Trajectory(_stamps(source, options), turn * source.T_world_cam),
                frames=_frames(source, options, path),
            )
            (folder / path.name).mkdir()
            write_log(folder / path.name, log)
            converted.append(ConvertedScene(path, len(source.scene), len(poses), dropped, placed))
    return BopConversion(tuple(converted), offset)


def _scene_folders(root: Path, scenes: Sequence[int]) -> list[Path]:
    if not root.is_dir():
        raise InputError("is no folder", path=root, fix="give a BOP dataset, a split of it or a scene")
    patterns = ("scene_camera.json", "*/scene_camera.json", "*/*/scene_camera.json")
    folders = sorted(file.parent for pattern in patterns for file in root.glob(pattern))
    if not folders:
        raise InputError("has no scene_camera.json", path=root, fix="give a BOP dataset, a split of it or a scene")
    names = [folder.resolve().name for folder in folders]
    twice = [folder for folder in folders if names.count(folder.resolve().name) > 1]
    if twice:
        what = f"has two scenes named {twice[0].name}: {twice[0]} and {twice[1]}"
        raise InputError(what, path=root, fix="give one split of the dataset")
    if not scenes:
        return folders
    by_number = {_scene_number(folder): folder for folder in folders}
    missing = [scene for scene in scenes if scene not in by_number]
    if missing:
        raise InputError(f"has no scene {missing[0]}", path=root, fix="choose among those there, or leave --scenes out")
    return [by_number[scene] for scene in scenes]


def _scene_number(folder: Path) -> int:
    name = folder.resolve().name
    return int(name) if name.isdigit() else -1


def _read_source(folder: Path) -> _Source:
    scene = read_bop_scene(folder)
    if scene.T_cam_world is None:
        fix = "only scenes with a known world become logs"
        raise InputError("has images without cam_R_w2c and cam_t_w2c", path=folder / "scene_camera.json", fix=fix)
    annotations = scene.annotations
    if annotations is None:
        fix = "the map is derived from the ground truth"
        raise InputError("does not exist", path=folder / "scene_gt.json", fix=fix)
    rows = _rows_of(annotations.image_ids, scene, folder / "scene_gt.json")
    instances = count_instances(annotations.image_ids, annotations.object_ids)
    pairs = np.column_stack([annotations.object_ids, instances])
    keys, indices = np.unique(pairs, axis=0, return_inverse=True)
    sightings = Sightings(
        keys=tuple((int(object_id), int(instance)) for object_id, instance in keys),
        landmark_indices=indices.ravel(),
        T_world_cam=scene.T_cam_world.inv()[rows],
        T_cam_obj=annotations.T_cam_obj,
    )
    return _Source(folder, scene, annotations, sightings)


def _rows_of(image_ids: NDArray[np.int64], scene: BopScene, path: Path | None) -> NDArray[np.intp]:
    """Return which of the scene's images each id is."""
    rows = np.minimum(np.searchsorted(scene.image_ids, image_ids), len(scene) - 1)
    unknown = scene.image_ids[rows] != image_ids
    if unknown.any():
        what = f"image {image_ids[np.argmax(unknown)]} is not in scene_camera.json"
        raise InputError(what, path=path, fix="give files of one dataset")
    return rows


def _placed(source: _Source, options: ConvertBopOptions) -> tuple[Placement, ...]:
    placements = place_objects(source.sightings)
    worst = _beyond(placements, options)
    if worst is None:
        return placements
    what = (
        f"object {worst.key[0]} spreads by {worst.distance_p90_m * 1e3:.1f} mm and "
        f"{np.rad2deg(worst.angle_p90_rad):.2f} deg over {worst.frames} frames"
    )
    fix = "raise --max-spread-mm and --max-spread-deg if that will do"
    if options.fit_camera_offset:
        fix = f"fit groups of scenes apart with --scenes, or {fix}"
    else:
        offset = fit_camera_offset([source.sightings])
        if offset is not None and _beyond(place_objects(source.sightings.moved(offset)), options) is None:
            t = ", ".join(f"{value * 1e3:.1f}" for value in offset.translation)
            turn = np.rad2deg(offset.rotation.magnitude())
            what += f": the trajectory is another camera's, ({t}) mm and {turn:.2f} deg away"
            fix = "pass --fit-camera-offset"
    raise InputError(what, path=source.folder, fix=fix)


def _beyond(placements: Iterable[Placement], options: ConvertBopOptions) -> Placement | None:
    limit_m, limit_rad = options.max_spread_mm / 1e3, np.deg2rad(options.max_spread_deg)
    bad = [place for place in placements if place.distance_p90_m > limit_m or place.angle_p90_rad > limit_rad]
    return max(bad, key=lambda place: place.distance_p90_m, default=None)


def _turn_to_z_up(up: tuple[float, float, float]) -> RigidTransform:
    if not np.linalg.norm(up) > 0:
        raise InputError("--up is zero", fix="give the upward direction in the dataset's world axes")
    return make_pose(Rotation.align_vectors([[0, 0, 1]], [up])[0], [0, 0, 0])


def _landmark_map(placements: Sequence[Placement], models: Mapping[int, BopModel], turn: RigidTransform) -> LandmarkMap:
    return LandmarkMap(
        tuple(
            Landmark(
                object_id=place.key[0],
                T_world_obj=turn * place.T_world_obj,
                instance=place.key[1],
                name=f"obj_{place.key[0]:06d}",
                symmetry=models[place.key[0]].symmetry if place.key[0] in models else None,
            )
            for place in placements
        )
    )


def _frames(source: _Source, options: ConvertBopOptions, log: Path) -> Frames:
    images = [_image(source.folder, number) for number in source.scene.image_ids.tolist()]
    relative = tuple(os.path.relpath(image, log.resolve()) if image else "" for image in images)
    return Frames(_stamps(source, options), source.scene.image_ids, relative)


def _stamps(source: _Source, options: ConvertBopOptions) -> Stamps:
    numbers = source.scene.image_ids
    if options.stamps is None:
        if not options.frame_rate > 0:
            raise InputError(f"--frame-rate is {options.frame_rate:g}", fix="give a positive rate in Hz")
        return np.rint(numbers * (1e9 / options.frame_rate)).astype(np.int64)
    name = source.folder.resolve().name
    path = options.stamps / f"{name}.csv" if options.stamps.is_dir() else options.stamps
    table = read_frames(path)
    stamp_of = dict(zip(table.frames.tolist(), table.stamps_ns.tolist(), strict=True))
    missing = [number for number in numbers.tolist() if number not in stamp_of]
    if missing:
        raise InputError(f"has no stamp for image {missing[0]} of scene {name}", path=path, fix="list every image")
    stamps = np.array([stamp_of[number] for number in numbers.tolist()], np.int64)
    if np.any(np.diff(stamps) <= 0):
        raise InputError(f"the stamps do not increase with the images of scene {name}", path=path, fix="correct them")
    return stamps


def _object_poses(source: _Source, results: BopResults | None, options: ConvertBopOptions) -> tuple[ObjectPoses, int]:
    """Return the estimates, or the ground truth where there are none, and how many estimates were dropped."""
    stamps = _stamps(source, options)
    if results is None:
        return _ground_truth(source, stamps, options.min_visible), 0
    here = results.scene_ids == _scene_number(source.folder)
    if not here.any():
        what = f"has no estimates of scene {source.folder.resolve().name}"
        raise InputError(what, path=options.results, fix="choose the scenes it has with --scenes")
    known = here & np.isin(results.object_ids, [key[0] for key in source.sightings.keys])
    rows = np.flatnonzero(known)
    rows = rows[np.lexsort((-results.scores[rows], results.object_ids[rows], results.image_ids[rows]))]
    images, object_ids = results.image_ids[rows], results.object_ids[rows]
    poses = ObjectPoses(
        stamps_ns=stamps[_rows_of(images, source.scene, options.results)],
        frames=images,
        object_ids=object_ids,
        instances=count_instances(images, object_ids),
        scores=results.scores[rows],
        T_cam_obj=results.T_cam_obj[rows],
    )
    return poses, int(np.count_nonzero(here & ~known))


def _ground_truth(source: _Source, stamps: Stamps, min_visible: float) -> ObjectPoses:
    annotations, scene = source.annotations, source.scene
    keys = np.array(source.sightings.keys)[source.sightings.landmark_indices]
    poses = ObjectPoses(
        stamps_ns=stamps[_rows_of(annotations.image_ids, scene, source.folder / "scene_gt.json")],
        frames=annotations.image_ids,
        object_ids=keys[:, 0],
        instances=keys[:, 1],
        scores=np.ones(len(annotations)),
        T_cam_obj=annotations.T_cam_obj,
    )
    if annotations.visible_fractions is None:
        return poses
    return poses[annotations.visible_fractions >= min_visible]


def _camera(source: _Source) -> Camera:
    matrices = source.scene.camera_matrices
    matrix = np.median(matrices, axis=0)
    if np.abs(matrices - matrix).max() > 1.0:
        warnings.warn(f"{source.folder}: cam_K changes between images; the median is written", stacklevel=2)
    fx, fy, cx, cy = (float(value) for value in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    images = (_image(source.folder, number) for number in source.scene.image_ids.tolist())
    first = next((image for image in images if image is not None), None)
    return Camera((fx, fy, cx, cy), resolution=None if first is None else _resolution(first))


def _resolution(image: Path) -> tuple[int, int]:
    from PIL import Image

    with Image.open(image) as opened:
        return opened.size


def _image(folder: Path, number: int) -> Path | None:
    candidates = (
        folder / kind / f"{number:06d}.{suffix}" for kind in ("rgb", "gray") for suffix in ("png", "jpg", "tif")
    )
    return next((path.resolve() for path in candidates if path.exists()), None)


def _models(root: Path, models_info: Path | None) -> Mapping[int, BopModel]:
    if models_info is not None:
        return read_models_info(models_info)
    place = root.resolve()
    for folder in (place, *list(place.parents)[:2]):
        for name in ("models_eval", "models"):
            if (folder / name / "models_info.json").exists():
                return read_models_info(folder / name / "models_info.json")
    return {}
