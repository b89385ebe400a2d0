"""The recording, read back: entities, times, numbers, and what `rerun rrd verify` says."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rerun.chunk import Chunk, RrdReader
from scipy.spatial.transform import Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.records import LandmarkMap
from poet_loc.report import rerun_log, rerun_log_time
from poet_loc.report.run_record import DECISIONS, RunRecord

AXES = ("x", "y", "z", "yaw", "roll", "pitch")
NAMES = ("localize/best", "localize/robust", "fuse/eskf/objects")


def read(path: Path) -> dict[str, list[Chunk]]:
    chunks = defaultdict(list)
    for chunk in RrdReader(str(path)).stream():
        chunks[chunk.entity_path.strip("/")].append(chunk)
    return chunks


def column(chunks: list[Chunk], ending: str) -> Any:
    """The one column of an entity that ends so, as a list of rows."""
    found = [
        batch.column(name)
        for batch in (chunk.to_record_batch() for chunk in chunks)
        for name in batch.schema.names
        if name.endswith(ending)
    ]
    assert len(found) == 1, ending
    return found[0]


def having(chunks: list[Chunk], archetype: str) -> list[Chunk]:
    return [chunk for chunk in chunks if any(archetype in name for name in chunk.to_record_batch().schema.names)]


def stamps_of(chunks: list[Chunk]) -> np.ndarray:
    return np.array(column(chunks, rerun_log_time.TIMELINE).cast("int64"))


@pytest.fixture(scope="module")
def recording(run_record: RunRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "recording.rrd"
    rerun_log.write_recording(run_record, path)
    return path


@pytest.fixture(scope="module")
def chunks(recording: Path) -> dict[str, list[Chunk]]:
    return read(recording)


def test_rerun_verifies_the_file(recording: Path, tmp_path: Path) -> None:
    program = Path(sys.executable).parent / "rerun"
    environment = os.environ | {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    done = subprocess.run(
        [program, "rrd", "verify", recording], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "verified without error" in done.stderr + done.stdout


def test_everything_is_in_it_and_no_entity_is_a_pose(chunks: dict[str, list[Chunk]]) -> None:
    expected = {"world", "world/landmarks", "world/landmarks/axes", "world/ground_truth/cam/pose/detections"}
    for place in ("ground_truth/cam", "ground_truth/imu", *[f"estimates/{name}" for name in NAMES]):
        expected |= {f"world/{place}/path", f"world/{place}/pose"}
    expected |= {"world/ground_truth/cam/pose/view", "world/estimates/fuse/eskf/objects/pose/cam/view"}
    expected |= {f"errors/{axis}/{name}" for axis in AXES for name in NAMES}
    expected |= {f"errors/{axis}/{name}/3_sigma" for axis in AXES for name in NAMES[1:]}
    states = ("gyroscope_bias", "accelerometer_bias", "velocity")
    expected |= {f"states/fuse/eskf/objects/{state}" for state in states}
    expected |= {f"decisions/{name}/{landmark}" for name in NAMES[1:] for landmark in ("004_sugar_box", "object_9__1")}
    expected |= {"consistency/fuse/eskf/objects/nis_position_per_dof", "consistency/localize/robust/nees_per_dof"}
    assert expected <= set(chunks)
    assert len(chunks) < 80


def test_a_layout_comes_with_it(recording: Path) -> None:
    assert len(RrdReader(str(recording)).blueprints()) == 1


def test_time_is_the_sensors_to_the_nanosecond(run_record: RunRecord, chunks: dict[str, list[Chunk]]) -> None:
    poses = having(chunks["world/ground_truth/cam/pose"], "Transform3D")
    np.testing.assert_array_equal(stamps_of(poses), run_record.references["cam"].stamps_ns)
    for parts in chunks.values():
        for chunk in parts:
            assert chunk.is_static or chunk.timeline_names == [rerun_log_time.TIMELINE]


def test_cameras_show_from_the_first_pose_on(run_record: RunRecord, chunks: dict[str, list[Chunk]]) -> None:
    view = "world/estimates/fuse/eskf/objects/pose/cam/view"
    assert stamps_of(chunks[view]).tolist() == [int(run_record.fused[0].stamps_ns[0])]
    assert not any(chunk.is_static for chunk in chunks[view])


def test_poses_and_errors_are_the_records(run_record: RunRecord, chunks: dict[str, list[Chunk]]) -> None:
    truth = run_record.references["cam"].T_world_body
    poses = chunks["world/ground_truth/cam/pose"]
    translation = np.array(column(poses, "Transform3D:translation").to_pylist())[:, 0]
    np.testing.assert_allclose(translation, truth.translation, atol=1e-6)
    q_xyzw = np.array(column(poses, "Transform3D:quaternion").to_pylist())[:, 0]
    gap = (Rotation.from_quat(q_xyzw).inv() * truth.rotation).magnitude()
    assert gap.max() < 1e-6
    assert run_record.evaluation is not None
    row = run_record.evaluation["fuse/eskf/objects"]
    assert row.sigmas is not None
    for axis, k, factor in (("y", 1, 1e3), ("roll", 5, 180 / np.pi)):
        error = np.array(column(chunks[f"errors/{axis}/{row.name}"], "Scalars:scalars").to_pylist())[:, 0]
        np.testing.assert_allclose(error, row.errors[:, k] * factor)
        band = chunks[f"errors/{axis}/{row.name}/3_sigma"]
        variances = np.array(column(band, "Measurements:variances").to_pylist())[:, 0]
        np.testing.assert_allclose(np.sqrt(variances), 3 * row.sigmas[:, k] * factor)
        assert not np.any(column(band, "Measurements:values").to_pylist())


def test_paths_are_named_at_places_apart(run_record: RunRecord, chunks: dict[str, list[Chunk]]) -> None:
    names = {entity: rows for entity, rows in chunks.items() if entity.endswith("/name")}
    labels = {column(rows, ":labels").to_pylist()[0][0] for rows in names.values()}
    assert {f"{each.name} ({each.body})" for each in run_record.estimates} <= labels
    assert "ground truth (cam)" in labels
    places = {tuple(column(rows, "positions").to_pylist()[0][0]) for rows in names.values()}
    assert len(places) == len(names)
    for estimate in run_record.estimates:
        place = column(chunks[f"world/estimates/{estimate.name}/name"], "positions").to_pylist()[0][0]
        assert np.abs(estimate.trajectory.T_world_body.translation - place).max(axis=1).min() < 1e-6


def test_detections_hang_on_the_true_camera(run_record: RunRecord, chunks: dict[str, list[Chunk]]) -> None:
    rows = column(chunks["world/ground_truth/cam/pose/detections"], "Points3D:positions").to_pylist()
    assert len(rows) == 120
    assert {len(row) for row in rows} == {2}
    truth = run_record.references["cam"].T_world_body[5]
    assert run_record.landmark_map is not None
    expected = run_record.landmark_map.T_world_obj.translation
    np.testing.assert_allclose(truth.apply(np.array(rows[5])), expected, atol=1e-5)


def test_lanes_change_where_the_decisions_do() -> None:
    stamps = np.array([0, 33, 66, 99, 300, 333], dtype=np.int64)
    at, states = rerun_log._changes(stamps, np.array([3, 3, 0, 3, 3, 3]))
    not_seen = len(DECISIONS)
    assert list(zip(at.tolist(), states.tolist(), strict=True)) == [
        (0, 3),
        (66, 0),
        (99, 3),
        (132, not_seen),
        (300, 3),
        (366, not_seen),
    ]


def test_ellipsoids_are_three_sigma_along_their_axes() -> None:
    rng = np.random.default_rng(1)
    mix = rng.normal(size=(20, 3, 3))
    covariances = mix @ mix.mT
    half_sizes, q_xyzw = rerun_log._ellipsoids(covariances)
    R = Rotation.from_quat(q_xyzw).as_matrix()
    rebuilt = R @ (np.eye(3) * (half_sizes / 3.0)[:, None] ** 2) @ R.mT
    np.testing.assert_allclose(rebuilt, covariances, atol=1e-9)


def test_long_logs_are_thinned(run_record: RunRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_log, "MAX_ROWS", 50)
    rerun_log.write_recording(run_record, tmp_path / "thin.rrd")
    thin = read(tmp_path / "thin.rrd")
    assert max(chunk.num_rows for name, parts in thin.items() for chunk in parts if "decisions" not in name) <= 50
    assert stamps_of(having(thin["world/ground_truth/cam/pose"], "Transform3D"))[0] == run_record.start_ns


def test_stamps_from_the_sensors_start_are_durations(run_record: RunRecord, tmp_path: Path) -> None:
    estimate = run_record.estimates[0]
    shifted = replace(estimate.trajectory, stamps_ns=estimate.trajectory.stamps_ns - run_record.start_ns)
    bare = RunRecord(estimates=(replace(estimate, trajectory=shifted),))
    rerun_log.write_recording(bare, tmp_path / "bare.rrd")
    poses = having(read(tmp_path / "bare.rrd")["world/estimates/localize/best/pose"], "Transform3D")
    np.testing.assert_array_equal(stamps_of(poses), shifted.stamps_ns)


def test_a_record_with_nothing_but_a_silent_estimate_is_written(run_record: RunRecord, tmp_path: Path) -> None:
    silent = replace(run_record.estimates[1], trajectory=run_record.estimates[1].trajectory[:0])
    rerun_log.write_recording(RunRecord(estimates=(silent,), landmark_map=LandmarkMap()), tmp_path / "silent.rrd")
    assert "world" in read(tmp_path / "silent.rrd")


def test_covariances_of_landmarks_are_drawn(run_record: RunRecord, tmp_path: Path) -> None:
    assert run_record.landmark_map is not None
    first, second = run_record.landmark_map
    known = LandmarkMap((replace(first, covariance=np.diag([0.01] * 3 + [0.04, 0.09, 0.16])), second))
    rerun_log.write_recording(RunRecord(estimates=(), landmark_map=known), tmp_path / "map.rrd")
    half_sizes = column(read(tmp_path / "map.rrd")["world/landmarks/position_3_sigma"], "half_sizes").to_pylist()[0]
    np.testing.assert_allclose(half_sizes, [[0.6, 0.9, 1.2]], atol=1e-6)


def test_the_map_is_drawn_as_given_and_as_found(run_record: RunRecord, tmp_path: Path) -> None:
    (fused,) = run_record.fused
    assert run_record.landmark_map is not None
    shifted = [
        make_pose(each.T_world_obj.rotation, each.T_world_obj.translation + 0.05) for each in run_record.landmark_map
    ]
    found = LandmarkMap(
        tuple(
            replace(each, T_world_obj=T, covariance=np.diag([0.01] * 6))
            for each, T in zip(run_record.landmark_map, shifted, strict=True)
        )
    )
    record = replace(run_record, fused=(replace(fused, calibrated=SimpleNamespace(landmark_map=found)),))
    rerun_log.write_recording(record, tmp_path / "found.rrd")
    chunks = read(tmp_path / "found.rrd")
    entity = f"world/landmarks_found/{fused.name}"
    before = np.array(column(chunks["world/landmarks"], "centers").to_pylist()[0])
    after = np.array(column(chunks[entity], "centers").to_pylist()[0])
    np.testing.assert_allclose(after - before, 0.05, atol=1e-6)
    half_sizes = column(chunks[f"{entity}/position_3_sigma"], "half_sizes").to_pylist()[0]
    np.testing.assert_allclose(half_sizes, 0.3, atol=1e-6)
    assert "world/landmarks/position_3_sigma" not in chunks
