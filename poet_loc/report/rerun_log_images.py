"""Images in a rerun recording: boxes, axes and 3-sigma outlines of the objects, and where the network looked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from poet_loc.core.records import Camera, ObjectPoses
from poet_loc.report.rerun_log_time import TIMELINE, time_column
from poet_loc.report.seen_images import SeenImages, axis_lines, position_ellipses

Array = NDArray[np.float64]

ENTITY = "camera/image"
MOST_BYTES = 100_000_000
"""Images that are larger in all are thinned evenly."""

_AXIS_COLOURS = [(230, 60, 60), (40, 180, 75), (60, 110, 240)]
_BOX_COLOUR = (255, 225, 25)
_SIGMA_COLOUR = (255, 255, 255)
_MEDIA = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}


@dataclass(frozen=True)
class Attention:
    """Where the network looked in an image."""

    points: Array
    """(K, 2) px"""
    weights: Array
    """(K,)"""


_NOWHERE = Attention(np.zeros((0, 2)), np.zeros(0))


def write_image_recording(
    path: str | Path,
    images: SeenImages,
    detections: ObjectPoses | None,
    camera: Camera | None,
    attention: Mapping[int, Attention] | None = None,
) -> None:
    """Write an .rrd file of images alone; attention by the stamp of its image."""
    recording = rr.RecordingStream("poet-loc")
    with recording:
        blueprint = rrb.Blueprint(image_view(), rrb.TimePanel(timeline=TIMELINE), collapse_panels=True)
        recording.save(path, default_blueprint=blueprint)
        log_images(recording, images, detections, camera, lambda object_id, _: f"object {object_id}", attention)


def image_view() -> rrb.Spatial2DView:
    """Return the view of the images."""
    return rrb.Spatial2DView(origin=ENTITY, name="camera")


def log_images(
    recording: rr.RecordingStream,
    images: SeenImages,
    detections: ObjectPoses | None,
    camera: Camera | None,
    label_of: Callable[[int, int], str],
    attention: Mapping[int, Attention] | None = None,
) -> None:
    """Log images and, over them, boxes, axes (x red, y green, z blue), 3-sigma of the position, and attention."""
    images = _thinned(images)
    time = [time_column(images.stamps_ns)]
    blobs = [file.read_bytes() for file in images.files]
    media = [_MEDIA.get(file.suffix.lower(), "image/png") for file in images.files]
    recording.send_columns(ENTITY, time, rr.EncodedImage.columns(blob=blobs, media_type=media))
    if images.boxes:
        _log_boxes(recording, images, time)
    if detections is not None and camera is not None:
        _log_poses(recording, images.stamps_ns, time, detections, camera, label_of)
    if attention:
        _log_attention(recording, images.stamps_ns, attention)


def _log_boxes(recording: rr.RecordingStream, images: SeenImages, time: Sequence[rr.TimeColumn]) -> None:
    rows = [images.boxes.get(file.name, np.zeros((0, 6))) for file in images.files]
    corners = np.concatenate(rows)
    columns = rr.Boxes2D.columns(
        centers=(corners[:, 0:2] + corners[:, 2:4]) / 2,
        half_sizes=(corners[:, 2:4] - corners[:, 0:2]) / 2,
        labels=[f"{score:.2f}" for score in corners[:, 4]],
    )
    entity = f"{ENTITY}/boxes"
    recording.log(entity, rr.Boxes2D.from_fields(colors=[_BOX_COLOUR], show_labels=False), static=True)
    recording.send_columns(entity, time, columns.partition([len(each) for each in rows]))


def _log_poses(
    recording: rr.RecordingStream,
    stamps_ns: NDArray[np.int64],
    time: Sequence[rr.TimeColumn],
    detections: ObjectPoses,
    camera: Camera,
    label_of: Callable[[int, int], str],
) -> None:
    lines = axis_lines(detections, camera)
    outlines = None if detections.covariances is None else position_ellipses(detections, camera)
    seen = np.isfinite(lines).all(axis=(1, 2, 3))
    rows = [np.flatnonzero((detections.stamps_ns == stamp) & seen) for stamp in stamps_ns]
    order, counts = np.concatenate(rows), np.array([len(each) for each in rows])
    entity = f"{ENTITY}/axes"
    colours = [_AXIS_COLOURS] * len(order)
    columns = rr.LineStrips2D.columns(strips=list(lines[order].reshape(-1, 2, 2)), colors=_flat(colours))
    recording.log(entity, rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(1.5)), static=True)
    recording.send_columns(entity, time, columns.partition(3 * counts))
    names = [label_of(int(detections.object_ids[row]), int(detections.instances[row])) for row in order]
    points = rr.Points2D.columns(positions=lines[order, 0, 0], labels=names)
    style = rr.Points2D.from_fields(radii=rr.Radius.ui_points(2.0), show_labels=False)  # a click shows them
    recording.log(f"{ENTITY}/objects", style, static=True)
    recording.send_columns(f"{ENTITY}/objects", time, points.partition(counts))
    if outlines is not None:
        entity = f"{ENTITY}/position_3_sigma"
        strips = rr.LineStrips2D.columns(strips=list(outlines[order]))
        outline = rr.LineStrips2D.from_fields(colors=[_SIGMA_COLOUR], radii=rr.Radius.ui_points(0.75))
        recording.log(entity, outline, static=True)
        recording.send_columns(entity, time, strips.partition(counts))


def _log_attention(
    recording: rr.RecordingStream, stamps_ns: NDArray[np.int64], attention: Mapping[int, Attention]
) -> None:
    """Points of an image vanish with the next one."""
    looked = [attention.get(stamp, _NOWHERE) for stamp in stamps_ns.tolist()]
    points = np.concatenate([each.points for each in looked])
    share = np.concatenate([each.weights / each.weights.max(initial=1e-12) for each in looked])
    colours = np.stack([np.full(len(share), 255), 80 + 175 * share, 40 + 0 * share, 40 + 200 * share], axis=1)
    columns = rr.Points2D.columns(positions=points, radii=0.4 + 2.2 * np.sqrt(share), colors=colours.astype(np.uint8))
    counts = [len(each.points) for each in looked]
    recording.send_columns(f"{ENTITY}/attention", [time_column(stamps_ns)], columns.partition(counts))


def _thinned(images: SeenImages) -> SeenImages:
    step = 1 + sum(file.stat().st_size for file in images.files) // MOST_BYTES
    return SeenImages(images.stamps_ns[::step], images.files[::step], images.boxes)


def _flat(rows: Sequence[Sequence[Any]]) -> list[Any]:
    return [each for row in rows for each in row]
