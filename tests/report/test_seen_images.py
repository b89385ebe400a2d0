"""Images in figures and recordings: lines against OpenCV's projection and samples, and the file read back."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from poet_loc.core.records import Camera, ObjectPoses
from poet_loc.io.boxes_csv import write_boxes
from poet_loc.io.frames_csv import Frames
from poet_loc.io.log_folder import Log
from poet_loc.report.rerun_log_images import ENTITY, Attention, write_image_recording
from poet_loc.report.seen_images import SeenImages, axis_lines, images_of, position_ellipses

CAMERA = Camera((300.0, 310.0, 80.0, 60.0), resolution=(160, 120))
STEP_NS = 50_000_000


@pytest.fixture
def poses() -> ObjectPoses:
    """Two objects in frame 0, none in frame 1, one in frame 2."""
    rng = np.random.default_rng(1)
    t = np.array([[0.1, -0.05, 0.7], [-0.1, 0.02, 0.9], [0.0, 0.0, 0.6]])
    factor = rng.normal(size=(3, 6, 6)) * 0.004
    covariances = factor @ factor.mT
    covariances[:, :3, 3:] = covariances[:, 3:, :3] = 0.0
    frames = np.array([0, 0, 2])
    T_cam_obj = RigidTransform.from_components(t, Rotation.random(3, rng=rng))
    return ObjectPoses(
        frames * STEP_NS, frames, np.array([4, 9, 4]), np.zeros(3, np.int64), np.ones(3), T_cam_obj, covariances
    )


@pytest.fixture
def log(tmp_path: Path) -> Log:
    (tmp_path / "rgb").mkdir()
    names = [f"rgb/{number}.jpg" for number in range(4)]
    for number, name in enumerate(names[:3]):  # the fourth is missing
        cv2.imwrite(str(tmp_path / name), np.full((120, 160, 3), 60 * number, np.uint8))
    write_boxes(
        tmp_path / "boxes_mine.csv", {"0.jpg": np.array([[10, 20, 50, 80, 0.5, 4], [60, 20, 80, 80, 0.75, 9.0]])}
    )
    stamps_ns = np.arange(4) * STEP_NS
    return Log(tmp_path, frames=Frames(stamps_ns, np.arange(4), tuple(names)))


def test_axes_are_where_opencv_projects_them(poses: ObjectPoses) -> None:
    lines = axis_lines(poses, CAMERA, 0.05)
    fx, fy, cx, cy = CAMERA.intrinsics
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    corners = np.vstack([np.zeros(3), 0.05 * np.eye(3)])
    for row, T in enumerate(poses.T_cam_obj):
        expected, _ = cv2.projectPoints(corners, T.rotation.as_rotvec(), T.translation, K, None)
        np.testing.assert_allclose(lines[row, :, 0], np.tile(expected[0], (3, 1)), atol=1e-6)
        np.testing.assert_allclose(lines[row, :, 1], expected[1:, 0], atol=1e-6)


def test_what_is_behind_the_camera_is_not_drawn(poses: ObjectPoses) -> None:
    behind = replace(poses, T_cam_obj=RigidTransform.from_translation([0, 0, -2.0]) * poses.T_cam_obj)
    assert np.isnan(axis_lines(behind, CAMERA)).all()
    assert np.isnan(position_ellipses(behind, CAMERA)).all()


def test_an_outline_holds_the_share_of_projected_samples_that_its_sigmas_say(poses: ObjectPoses) -> None:
    rng = np.random.default_rng(3)
    fx, fy, cx, cy = CAMERA.intrinsics
    for sigmas in (1.0, 2.0):
        outlines = position_ellipses(poses, CAMERA, sigmas, corners=90)
        for row, T in enumerate(poses.T_cam_obj):
            points = T.translation + rng.multivariate_normal(np.zeros(3), poses.covariances[row, 3:, 3:], 4000)
            pixels = points[:, :2] / points[:, 2:] * [fx, fy] + [cx, cy]
            polygon = outlines[row].astype(np.float32)
            inside = np.mean([cv2.pointPolygonTest(polygon, tuple(map(float, p)), False) >= 0 for p in pixels])
            assert inside == pytest.approx(chi2.cdf(sigmas**2, 2), abs=0.03)


def test_images_are_those_that_are_there_with_the_boxes_of_these_detections(log: Log) -> None:
    images = images_of(log, "mine")
    assert [file.name for file in images.files] == ["0.jpg", "1.jpg", "2.jpg"]
    assert images.stamps_ns.tolist() == [0, STEP_NS, 2 * STEP_NS]
    assert images.boxes["0.jpg"].shape == (2, 6)
    assert not images_of(log, "other").boxes
    assert images_of(replace(log, frames=None), "mine") is None
    assert images_of(replace(log, path=log.path / "elsewhere"), "mine") is None


def test_the_recording_has_each_image_with_what_was_seen_in_it(log: Log, poses: ObjectPoses, tmp_path: Path) -> None:
    looked = {STEP_NS: Attention(np.array([[3.0, 4.0], [5.0, 6.0]]), np.array([0.2, 0.8]))}
    write_image_recording(tmp_path / "images.rrd", images_of(log, "mine"), poses, CAMERA, looked)
    found = defaultdict(list)
    for chunk in RrdReader(str(tmp_path / "images.rrd")).stream():
        found[chunk.entity_path.strip("/")].append(chunk.to_record_batch())

    def column(entity: str, ending: str) -> list:
        (values,) = [b.column(n) for b in found[entity] for n in b.schema.names if n.endswith(ending)]
        return values.to_pylist()

    blobs = column(ENTITY, "EncodedImage:blob")
    assert [bytes(blob[0]) for blob in blobs] == [(log.path / f"rgb/{n}.jpg").read_bytes() for n in range(3)]
    assert [len(row) for row in column(f"{ENTITY}/boxes", "half_sizes")] == [2, 0, 0]
    np.testing.assert_allclose(column(f"{ENTITY}/boxes", "centers")[0], [[30, 50], [70, 50]])
    assert [len(row) for row in column(f"{ENTITY}/axes", "strips")] == [6, 0, 3]
    assert [len(row) for row in column(f"{ENTITY}/position_3_sigma", "strips")] == [2, 0, 1]
    assert column(f"{ENTITY}/objects", ":labels") == [["object 4", "object 9"], [], ["object 4"]]
    np.testing.assert_allclose(column(f"{ENTITY}/axes", "strips")[2], axis_lines(poses, CAMERA)[2], rtol=1e-5)
    assert column(f"{ENTITY}/attention", "positions") == [[], [[3.0, 4.0], [5.0, 6.0]], []]


def test_large_images_are_thinned(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from poet_loc.report import rerun_log_images

    images = images_of(log, "mine")
    monkeypatch.setattr(rerun_log_images, "MOST_BYTES", sum(f.stat().st_size for f in images.files) // 2 + 1)
    thin = rerun_log_images._thinned(images)
    assert thin.stamps_ns.tolist() == [0, 2 * STEP_NS]
    assert isinstance(thin, SeenImages)
