"""A run as a rerun recording: the world with its paths, errors in their 3-sigma bands, biases, what the gate decided.

Everything is sent by columns, never an entity a pose; long logs are thinned. The time is the sensor's.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.records import Camera, LandmarkMap
from poet_loc.core.trajectory import Trajectory
from poet_loc.report.evaluate import ERROR_AXES, Body, Estimate, Row
from poet_loc.report.fused import Fused
from poet_loc.report.rerun_log_images import log_images
from poet_loc.report.rerun_log_layout import UNITS, in_unit, layout_of
from poet_loc.report.rerun_log_time import time_column
from poet_loc.report.run_record import DECISIONS, Decisions, RunRecord

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Colour = tuple[int, int, int]

MAX_ROWS = 20_000
"""Longest column of one entity; longer ones are thinned evenly."""
MAX_RATE_HZ = 50.0
"""Poses and states at a higher rate are thinned to it."""

_TRUTH: Colour = (230, 230, 230)
_ORACLE: Colour = (150, 150, 150)
PALETTE: tuple[Colour, ...] = (
    (86, 180, 233),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (230, 159, 0),
    (240, 228, 66),
)  # Okabe and Ito (2008), what reads on black
_DECISION_COLOURS = (0xD55E00FF, 0xE69F00FF, 0xCC79A7FF, 0x0072B2FF)
_NOT_SEEN = "not seen"


def write_recording(record: RunRecord, path: str | Path, name: str = "poet-loc") -> None:
    """Write a run to an .rrd file that `rerun` and `poet-loc view` open, with its layout in it.

    Entities: world/landmarks, world/landmarks_found/<estimate>, world/ground_truth/<body>, world/estimates/<estimate>,
    errors/<axis>/<estimate>, states/<estimate>, consistency/<estimate>, decisions/<estimate>/<landmark>, camera/image.
    """
    recording = rr.RecordingStream("poet-loc")
    with recording:
        recording.save(path, default_blueprint=layout_of(record))
        recording.send_recording_name(name)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if record.landmark_map is not None and len(record.landmark_map):
            _log_landmarks(recording, "world/landmarks", record, record.landmark_map, PALETTE[4])
        colours = _colours(record.estimates)
        paths = [
            (f"ground_truth/{body}", trajectory, body, f"ground truth ({body})", _TRUTH)
            for body, trajectory in record.references.items()
        ]
        paths += [
            (f"estimates/{each.name}", each.trajectory, each.body, f"{each.name} ({each.body})", colours[each.name])
            for each in record.estimates
        ]
        for k, (entity, trajectory, body, label, colour) in enumerate(paths):
            _log_trajectory(recording, record, f"world/{entity}", trajectory, body, colour)
            _log_name(recording, f"world/{entity}/name", trajectory, (k + 0.5) / len(paths), label, colour)
        for estimate in record.estimates:
            entity = f"world/estimates/{estimate.name}/position_3_sigma"
            _log_ellipsoids(recording, entity, estimate, colours[estimate.name])
        for row in record.evaluation.rows if record.evaluation else ():
            _log_errors(recording, row, colours.get(row.name, _ORACLE))
        for fused in record.fused:
            _log_states(recording, fused)
            found = None if fused.calibrated is None else fused.calibrated.landmark_map
            if found is not None and len(found):
                entity = f"world/landmarks_found/{fused.name}"
                _log_landmarks(recording, entity, record, found, colours.get(fused.name, _ORACLE))
        for estimator, decisions in record.decisions.items():
            _log_decisions(recording, record, estimator, decisions)
        _log_detections(recording, record)
        if record.images is not None:
            log_images(recording, record.images, record.detections, record.camera, record.landmark_label)


def _log_landmarks(
    recording: rr.RecordingStream, entity: str, record: RunRecord, landmark_map: LandmarkMap, colour: Colour
) -> None:
    """The map as it was given, or as an estimate found it, with what is known of its error."""
    T = landmark_map.T_world_obj
    labels = [record.landmark_label(*landmark.key) for landmark in landmark_map]
    boxes = rr.Boxes3D(
        centers=T.translation,
        half_sizes=[[0.02, 0.02, 0.02]] * len(labels),
        quaternions=T.rotation.as_quat(),
        labels=labels,
        colors=colour,
    )
    recording.log(entity, boxes, static=True)
    axes = 0.06 * T.rotation.as_matrix().mT.reshape(-1, 3)  # rows x, y, z of each landmark
    origins, colours = np.repeat(T.translation, 3, axis=0), [[255, 0, 0], [0, 200, 0], [60, 60, 255]] * len(labels)
    recording.log(f"{entity}/axes", rr.Arrows3D(origins=origins, vectors=axes, colors=colours), static=True)
    known = [landmark for landmark in landmark_map if landmark.covariance is not None]
    if known:
        R = RigidTransform.concatenate([landmark.T_world_obj for landmark in known]).rotation.as_matrix()
        covariances = R @ np.stack([landmark.covariance[3:, 3:] for landmark in known]) @ R.mT
        half_sizes, q_xyzw = _ellipsoids(covariances)
        centers = [landmark.T_world_obj.translation for landmark in known]
        ellipsoids = rr.Ellipsoids3D(centers=centers, half_sizes=half_sizes, quaternions=q_xyzw, colors=colour)
        recording.log(f"{entity}/position_3_sigma", ellipsoids, static=True)


def _log_trajectory(
    recording: rr.RecordingStream, record: RunRecord, entity: str, trajectory: Trajectory, body: Body, colour: Colour
) -> None:
    """The whole path at once, and the current pose with its camera."""
    if len(trajectory) == 0:
        return
    trajectory = _thinned(trajectory)
    path: rr.Points3D | rr.LineStrips3D
    if entity.startswith("world/estimates/localize/"):  # single frames: lines between them would only tangle
        points = trajectory.T_world_body.translation
        path = rr.Points3D(points, colors=colour, radii=rr.Radius.ui_points(1.5))
    else:
        strips = [strip.T_world_body.translation for strip in _unbroken(trajectory)]
        path = rr.LineStrips3D(strips, colors=colour, radii=rr.Radius.ui_points(1.0))
    recording.log(f"{entity}/path", path, static=True)
    pose = f"{entity}/pose"
    T = trajectory.T_world_body
    columns = rr.Transform3D.columns(translation=T.translation, quaternion=T.rotation.as_quat())
    recording.send_columns(pose, [time_column(trajectory.stamps_ns)], columns)
    # from the first pose on: what is static would stand at the world's origin before it
    first = [time_column(trajectory.stamps_ns[:1])]
    recording.send_columns(pose, first, rr.TransformAxes3D.columns(axis_length=[0.05]))
    if record.camera is not None and (body == "cam" or record.T_cam_imu is not None):
        if body == "imu" and record.T_cam_imu is not None:
            T_imu_cam = record.T_cam_imu.inv()
            q_xyzw = rr.Quaternion(xyzw=T_imu_cam.rotation.as_quat())
            mount = rr.Transform3D(translation=T_imu_cam.translation, quaternion=q_xyzw)
            recording.log(f"{pose}/cam", mount, static=True)
            pose = f"{pose}/cam"
        recording.send_columns(f"{pose}/view", first, _pinhole(record.camera, colour))


def _log_name(
    recording: rr.RecordingStream, entity: str, trajectory: Trajectory, share: float, label: str, colour: Colour
) -> None:
    """What a path is, written at this share of it, for the view of the world has no legend."""
    if len(trajectory):
        position = trajectory.T_world_body.translation[int(share * len(trajectory))]
        point = rr.Points3D(position, radii=rr.Radius.ui_points(3.0), colors=colour, labels=label, show_labels=True)
        recording.log(entity, point, static=True)


def _log_ellipsoids(recording: rr.RecordingStream, entity: str, estimate: Estimate, colour: Colour) -> None:
    """The 3-sigma ellipsoid of the position at each pose."""
    if estimate.pose_covariances is None or len(estimate.trajectory) == 0:
        return
    step = _step(estimate.trajectory.stamps_ns)
    covariances = estimate.pose_covariances[::step, 3:, 3:]
    known = np.flatnonzero(np.isfinite(covariances).all(axis=(1, 2)))
    if len(known) == 0:
        return
    stamps_ns = estimate.trajectory.stamps_ns[::step][known]
    half_sizes, q_xyzw = _ellipsoids(covariances[known])
    columns = rr.Ellipsoids3D.columns(
        centers=estimate.trajectory.T_world_body[::step][known].translation, half_sizes=half_sizes, quaternions=q_xyzw
    )
    recording.log(
        entity,
        rr.Ellipsoids3D.from_fields(colors=[colour], fill_mode=rr.components.FillMode.MajorWireframe),
        static=True,
    )
    recording.send_columns(entity, [time_column(stamps_ns)], columns)


def _log_errors(recording: rr.RecordingStream, row: Row, colour: Colour) -> None:
    """Each axis's error as a line, its 3-sigma as a band about zero, and the NEES."""
    step = _step(row.stamps_ns)
    time = time_column(row.stamps_ns[::step])
    for axis, unit, error in zip(ERROR_AXES, UNITS, row.errors[::step].T, strict=True):
        entity = f"errors/{axis}/{row.name}"
        style = rr.SeriesLines(colors=colour, names=f"{row.name} [{unit}]", widths=1.5)
        recording.log(entity, style, static=True)
        recording.send_columns(entity, [time], rr.Scalars.columns(scalars=in_unit(error, unit)))
    if row.sigmas is not None:
        # rerun draws one standard deviation: nine times the variance makes it three
        bounds = 9.0 * row.sigmas[::step] ** 2
        for axis, unit, bound in zip(ERROR_AXES, UNITS, bounds.T, strict=True):
            entity = f"errors/{axis}/{row.name}/3_sigma"
            variances = in_unit(in_unit(bound, unit), unit)
            name = f"±3σ [{unit}]"
            _send_measurements(recording, entity, time, np.zeros((len(bound), 1)), variances[:, None], [name], [colour])
    if row.nees is not None:
        entity = f"consistency/{row.name}/nees_per_dof"
        recording.log(entity, rr.SeriesLines(colors=colour, names=f"{row.name} NEES/dof [-]"), static=True)
        recording.send_columns(entity, [time], rr.Scalars.columns(scalars=row.nees[::step]))


def _log_states(recording: rr.RecordingStream, fused: Fused) -> None:
    """Biases and velocity with their 3-sigma bands."""
    step = _step(fused.stamps_ns)
    time = time_column(fused.stamps_ns[::step])
    states = (
        ("gyroscope_bias", fused.gyroscope_bias, slice(9, 12), "rad/s"),
        ("accelerometer_bias", fused.accelerometer_bias, slice(12, 15), "m/s²"),
        ("velocity", fused.velocity, slice(6, 9), "m/s"),
    )
    colours = [(213, 94, 0), (0, 158, 115), (0, 114, 178)]
    for state, values, columns, unit in states:
        names = [f"{state.replace('_', ' ')} {axis} ±3σ [{unit}]" for axis in "xyz"]
        variances = 9.0 * fused.sigmas[::step, columns] ** 2
        entity = f"states/{fused.name}/{state}"
        _send_measurements(recording, entity, time, values[::step], variances, names, colours)
    if fused.gate is not None:
        step = _step(fused.gate.stamps_ns)
        time = time_column(fused.gate.stamps_ns[::step])
        parts = (("position", fused.gate.nis_position, PALETTE[0]), ("rotation", fused.gate.nis_rotation, PALETTE[4]))
        for part, nis, colour in parts:
            entity = f"consistency/{fused.name}/nis_{part}_per_dof"
            style = rr.SeriesPoints(names=f"{fused.name} NIS of {part}/dof [-]", colors=colour, marker_sizes=1.5)
            recording.log(entity, style, static=True)
            recording.send_columns(entity, [time], rr.Scalars.columns(scalars=nis[::step] / 3.0))


def _log_decisions(recording: rr.RecordingStream, record: RunRecord, name: str, decisions: Decisions) -> None:
    """A lane for each landmark, with a row wherever the decision changes."""
    for key, (stamps_ns, decided) in decisions.lanes().items():
        entity = f"decisions/{name}/{_path_part(record.landmark_label(*key))}"
        states = [*DECISIONS, _NOT_SEEN]
        colours = [*_DECISION_COLOURS, 0x80808030]
        recording.log(entity, rr.StateConfiguration(values=states, labels=states, colors=colours), static=True)
        at_ns, changed = _changes(stamps_ns, decided)
        texts = [states[index] for index in changed]
        recording.send_columns(entity, [time_column(at_ns)], rr.StateChange.columns(state=texts))


def _log_detections(recording: rr.RecordingStream, record: RunRecord) -> None:
    """The detected objects as points in front of the true camera: how far they miss the landmarks is their error."""
    detections = record.detections
    if detections is None or len(detections) == 0 or "cam" not in record.references:
        return
    frames_ns = np.unique(detections.stamps_ns)
    detections = detections[np.isin(detections.stamps_ns, frames_ns[:: _step(frames_ns)])]
    stamps_ns, counts = np.unique(detections.stamps_ns, return_counts=True)  # sorted, as detections are
    _, kinds = np.unique(detections.object_ids, return_inverse=True)
    colours = np.array(PALETTE)[kinds % len(PALETTE)]
    entity = "world/ground_truth/cam/pose/detections"
    columns = rr.Points3D.columns(positions=detections.T_cam_obj.translation, colors=colours.astype(np.uint8))
    recording.log(entity, rr.Points3D.from_fields(radii=rr.Radius.ui_points(3.0)), static=True)
    recording.send_columns(entity, [time_column(stamps_ns)], columns.partition(counts))


def _send_measurements(
    recording: rr.RecordingStream,
    entity: str,
    time: rr.TimeColumn,
    values: Array,
    variances: Array,
    names: Sequence[str],
    colours: Sequence[Colour],
) -> None:
    """Columns (N, K) of K series."""
    count = np.full(len(values), values.shape[1])
    columns = rr.Measurements.columns(values=values.ravel(), variances=variances.ravel()).partition(count)
    recording.log(entity, rr.Measurements.from_fields(names=names, colors=colours, widths=[1.5]), static=True)
    recording.send_columns(entity, [time], columns)


def _pinhole(camera: Camera, colour: Colour) -> rr.ComponentColumnList:
    """A camera's frustum as columns of one row."""
    fx, fy, cx, cy = camera.intrinsics
    resolution = camera.resolution or (round(2 * cx), round(2 * cy))
    return rr.Pinhole.columns(
        image_from_camera=np.array([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]]),
        resolution=[resolution],
        camera_xyz=[rr.ViewCoordinates.RDF],
        image_plane_distance=[0.1],
        color=[colour],
    )


def _ellipsoids(covariances: Array) -> tuple[Array, Array]:
    """3-sigma half axes (N, 3) and q_xyzw (N, 4) of covariances (N, 3, 3)."""
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return 3.0 * np.sqrt(np.maximum(variances, 0.0)), Rotation.from_matrix(axes).as_quat()


def _changes(stamps_ns: Stamps, decided: NDArray[np.int64]) -> tuple[Stamps, NDArray[np.int64]]:
    """Stamps and states (index into DECISIONS, or one beyond for not seen) wherever a lane changes."""
    if len(stamps_ns) == 0:
        return stamps_ns, decided
    interval = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 33_000_000
    last_before_gap = np.append(np.diff(stamps_ns) > 1.6 * interval, True)
    stamps = np.concatenate([stamps_ns, stamps_ns[last_before_gap] + interval])
    states = np.concatenate([decided, np.full(last_before_gap.sum(), len(DECISIONS))])
    order = np.argsort(stamps, kind="stable")
    stamps, states = stamps[order], states[order]
    keep = np.append(True, states[1:] != states[:-1])
    return stamps[keep], states[keep]


def _unbroken(trajectory: Trajectory) -> list[Trajectory]:
    """The parts between gaps, so that no line bridges one."""
    steps = np.diff(trajectory.stamps_ns)
    if len(steps) < 2:
        return [trajectory]
    cuts = [0, *(np.flatnonzero(steps > 3 * np.median(steps)) + 1).tolist(), len(trajectory)]
    return [trajectory[start:end] for start, end in itertools.pairwise(cuts)]


def _thinned(trajectory: Trajectory) -> Trajectory:
    return trajectory[:: _step(trajectory.stamps_ns)]


def _step(stamps_ns: Stamps) -> int:
    """Every which row is enough for the eye."""
    if len(stamps_ns) < 2:
        return 1
    interval_s = float(np.median(np.diff(stamps_ns))) * 1e-9
    return max(1 + (len(stamps_ns) - 1) // MAX_ROWS, int(1.001 / (MAX_RATE_HZ * interval_s)) if interval_s else 1, 1)


def _colours(estimates: Sequence[Estimate]) -> dict[str, Colour]:
    rivals = [estimate.name for estimate in estimates if not estimate.oracle]
    colours = {name: PALETTE[k % len(PALETTE)] for k, name in enumerate(rivals)}
    return colours | {estimate.name: _ORACLE for estimate in estimates if estimate.oracle}


def _path_part(text: str) -> str:
    """A landmark's name as one part of an entity path."""
    return "".join(c if c.isalnum() or c in "_-." else "_" for c in text)
