"""PoET's results.json becomes a log, with the stamps that it lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from poet_loc.core.input_error import InputError
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.io.frames_csv import read_frames
from poet_loc.io.input_text import read_json
from poet_loc.io.log_folder import Log, check_log, read_log_files, write_log
from poet_loc.io.poet_results import read_poet_results, stamp_poet_results
from poet_loc.io.whole_folder import whole_folder


@dataclass(frozen=True)
class ConvertPoetOptions:
    """How PoET's results become a log."""

    stamps: Path
    """frames.csv (timestamp_ns,frame,image): the stamp of each image that the results name."""
    classes: Path | None = None
    """PoET's classes file ({"1": "ape", "5": "can", ..}): label n is its n-th key; without it label n is object n."""
    like: Path | None = None
    """Folder whose landmarks, IMU, calibration, ground truth and further detections the new log takes over."""
    name: str = "poet"
    """The object poses become object_poses_NAME.csv."""
    overwrite: bool = False
    """Replace an output folder that holds something."""


def convert_poet(results: str | Path, out: str | Path, options: ConvertPoetOptions) -> Log:
    """Write a log folder whose object poses are PoET's results.json, with stamps and scores of 1; return it.

    Raises InputError for an image without a stamp, a class without an id, and records that do not belong together.
    """
    frames = read_frames(options.stamps)
    object_ids = None if options.classes is None else _object_ids(options.classes)
    poses = stamp_poet_results(read_poet_results(results), frames, object_ids)
    like = Log(Path(out)) if options.like is None else read_log_files(options.like)
    if like.landmark_map is not None:
        _refuse_unmapped(poses, like.landmark_map, results, options)
    log = replace(
        like,
        path=Path(out),
        object_poses={**like.object_poses, options.name: poses},
        frames=like.frames or frames,
    )
    check_log(log)
    inputs = [path for path in (results, options.stamps, options.classes, options.like) if path is not None]
    with whole_folder(out, options.overwrite, inputs) as folder:
        write_log(folder, log)
    return log


def _refuse_unmapped(poses: ObjectPoses, mapped: LandmarkMap, results: str | Path, options: ConvertPoetOptions) -> None:
    known = sorted(set(mapped.object_ids.tolist()))
    unknown = sorted(set(poses.object_ids.tolist()) - set(known))
    if unknown:
        what = f"has objects {', '.join(map(str, unknown))}; the map of {options.like} has {', '.join(map(str, known))}"
        fix = "add them to that map" if options.classes is not None else "give PoET's classes file with --classes"
        raise InputError(what, path=results, fix=fix)


def _object_ids(path: Path) -> Mapping[int, int]:
    """Return label -> object id: PoET counts its labels along the file, whatever the keys are."""
    content = read_json(path)
    if not isinstance(content, Mapping) or not all(key.isdigit() for key in content):
        raise InputError("is no classes file", path=path, fix='write {"1": "ape", "5": "can", ..}')
    return {label: int(key) for label, key in enumerate(content, start=1)}
