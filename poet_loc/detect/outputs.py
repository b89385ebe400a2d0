"""The files of a detection run, written as the images come, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.records import ObjectPoses
from poet_loc.detect.estimator import Sighting
from poet_loc.io.bop_results_csv import BopResults, write_bop_results
from poet_loc.io.boxes_csv import write_boxes
from poet_loc.io.object_poses_csv import count_instances, write_object_poses
from poet_loc.io.poet_results import PoetResults, poet_image_id, write_poet_results


class PoseFiles:
    """object_poses.csv, boxes.csv, bop_results.csv and results.json of a growing number of pictures."""

    def __init__(self, folder: Path, scene: int) -> None:
        self.folder, self.scene = folder, scene
        self._ids: set[str] = set()
        self._started: set[str] = set()

    def append(self, sightings: Sequence[Sighting]) -> None:
        """Write the rows of some pictures, which come in order of time."""
        self._append("object_poses.csv", lambda path: write_object_poses(path, object_poses(sightings)))
        boxes = {sighting.picture.name: sighting.corners_px for sighting in sightings}
        self._append("boxes.csv", lambda path: write_boxes(path, boxes))
        self._append("bop_results.csv", lambda path: write_bop_results(path, bop_results(sightings, self.scene)))
        results = poet_results(sightings, [self._image_id(s.picture.name) for s in sightings])
        part = self.folder / "part"
        write_poet_results(part, results)
        text = part.read_text().strip()[1:-1]
        part.unlink()
        with (self.folder / "results.json").open("a") as file:
            file.write(("," if "results.json" in self._started else "{") + text)
        self._started.add("results.json")

    def finish(self) -> None:
        """Close results.json."""
        with (self.folder / "results.json").open("a") as file:
            file.write("}\n" if "results.json" in self._started else "{}\n")

    def _append(self, name: str, write: Callable[[Path], None]) -> None:
        part = self.folder / "part"
        write(part)
        lines = part.read_text().splitlines(keepends=True)
        part.unlink()
        with (self.folder / name).open("a") as file:
            file.writelines(lines[1:] if name in self._started else lines)
        self._started.add(name)

    def _image_id(self, name: str) -> str:
        """Return PoET's id of an image, or its name where another image has that id."""
        chosen = poet_image_id(name)
        chosen = name if chosen in self._ids else chosen
        self._ids.add(chosen)
        return chosen


def poses_of(sightings: Sequence[Sighting]) -> RigidTransform:
    """Return T_cam_obj of all detections."""
    rotations = np.concatenate([s.rotations for s in sightings]).reshape(-1, 3, 3)
    translations = np.concatenate([s.translations for s in sightings]).reshape(-1, 3)
    return make_pose(Rotation.from_matrix(rotations), translations)


def repeated(sightings: Sequence[Sighting], values: Sequence[float], kind: type) -> np.ndarray:
    """Return one value per picture as a column of its detections."""
    return np.repeat(np.array(values, kind), [len(s.labels) for s in sightings])


def object_poses(sightings: Sequence[Sighting]) -> ObjectPoses:
    """Return the detections as records."""
    frames = repeated(sightings, [s.picture.frame for s in sightings], np.int64)
    ids = np.concatenate([s.object_ids for s in sightings])
    known = sightings[0].covariances is not None
    covariances = np.concatenate([s.covariances for s in sightings if s.covariances is not None]) if known else None
    return ObjectPoses(
        repeated(sightings, [s.picture.stamp_ns for s in sightings], np.int64),
        frames,
        ids,
        count_instances(frames, ids),
        np.concatenate([s.scores for s in sightings]),
        poses_of(sightings),
        covariances,
    )


def bop_results(sightings: Sequence[Sighting], scene: int) -> BopResults:
    """Return the detections as BOP wants them; scene and image are those of the data set, if the picture is of one.

    Else the image id is the number in the file name.
    """
    places = [sighting.picture.place for sighting in sightings]
    names = [Path(sighting.picture.name).stem for sighting in sightings]
    ids = [
        int("".join(c for c in name if c.isdigit()) or sighting.picture.frame) if place is None else place.image
        for name, place, sighting in zip(names, places, sightings)
    ]
    return BopResults(
        repeated(sightings, [scene if place is None else place.scene for place in places], np.int64),
        repeated(sightings, ids, np.int64),
        np.concatenate([s.object_ids for s in sightings]),
        np.concatenate([s.scores for s in sightings]),
        poses_of(sightings),
        repeated(sightings, [s.seconds for s in sightings], float),
    )


def poet_results(sightings: Sequence[Sighting], image_ids: Sequence[str]) -> PoetResults:
    """Return the detections as PoET's results.json has them."""
    return PoetResults(
        tuple(image_ids),
        repeated(sightings, list(range(len(sightings))), np.intp),
        np.concatenate([s.labels for s in sightings]),
        poses_of(sightings),
        np.concatenate([s.boxes for s in sightings]),
    )
