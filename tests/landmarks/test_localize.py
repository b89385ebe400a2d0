"""The stage on hand-made logs and on the shared real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors

from landmarks.camera_pose import MODES, Memory
from landmarks.localize import LocalizeOptions, localize
from poet_loc.core.errors import position_error, rotation_angle
from poet_loc.core.input_error import InputError
from poet_loc.core.records import LandmarkMap
from poet_loc.io.log_folder import Log, read_log

TRAINING = ("0001", "0014", "0017", "0029")
TEST = ("0049", "0050", "0051", "0053", "0054", "0055", "0058", "0059")
DETECTIONS = ("synthetic", "selftrained", "supervised")


def hand_made_log(path: Path) -> Log:
    rng = np.random.default_rng(0)
    landmarks, truth = make_map(rng, [2, 3, 9]), fly_around(rng, 10)
    errors = small_errors(rng, 10, 3, 0.3)
    errors[4, 1] = gross_errors(rng, 1)
    poses = detect(truth, landmarks, errors)
    return Log(path, {"one": poses}, landmarks, T_world_cam=truth)


@pytest.mark.parametrize("mode", MODES)
def test_result_of_the_stage(tmp_path: Path, mode: str) -> None:
    log = hand_made_log(tmp_path)
    result = localize(log, LocalizeOptions(mode=mode))
    assert result.name == f"localize/{mode}"
    assert result.detections == "one"
    assert result.runtime_s > 0.0
    np.testing.assert_array_equal(result.trajectory.stamps_ns, log.T_world_cam.stamps_ns)
    columns = result.voter_columns
    assert set(columns) == {"voters", "refused"}
    for frame in range(10):
        named = sorted([*columns["voters"][frame].split(), *columns["refused"][frame].split()])
        assert named == ["2:0", "3:0", "9:0"]
    expected = {"all": ("2:0 3:0 9:0", ""), "best": None}.get(mode, ("2:0 9:0", "3:0"))
    if expected:
        assert (columns["voters"][4], columns["refused"][4]) == expected
    else:
        assert len(columns["voters"][4].split()) == 1


def test_strangers_are_refused_under_their_own_name(tmp_path: Path) -> None:
    log = hand_made_log(tmp_path)
    fewer = Log(tmp_path, log.object_poses, LandmarkMap(log.landmark_map.landmarks[:2]))
    columns = localize(fewer, LocalizeOptions(mode="all")).voter_columns
    assert set(columns["voters"]) == {"2:0 3:0"}
    assert set(columns["refused"]) == {"9:0"}


def test_mistakes(tmp_path: Path) -> None:
    log = hand_made_log(tmp_path)
    poses = log.object_poses["one"]
    with pytest.raises(InputError, match=r"has no landmarks\.json"):
        localize(Log(tmp_path, {"": poses}))
    with pytest.raises(InputError, match=r"has no object_poses_two\.csv; choose among object_poses_one\.csv"):
        localize(log, LocalizeOptions(detections="two"))
    with pytest.raises(InputError, match="several sets of detections: one, two"):
        localize(Log(tmp_path, {"one": poses, "two": poses}, log.landmark_map))
    with pytest.raises(InputError, match="oracle"):
        localize(Log(tmp_path, log.object_poses, log.landmark_map), LocalizeOptions(mode="best"))


@pytest.fixture(scope="module")
def pooled(shared_data: Path) -> dict[tuple[str, str, str], tuple[np.ndarray, ...]]:
    """By videos, detections and mode: distances (m), angles (rad), and which poses are held."""
    errors = {}
    for videos, names in (("training", TRAINING), ("test", TEST)):
        logs = [read_log(shared_data / "ycbv_dope" / name) for name in names]
        for detections in DETECTIONS:
            for mode in MODES:
                distance, angle, held = [], [], []
                for log in logs:
                    result = localize(log, LocalizeOptions(mode=mode, detections=detections))
                    truth, known = log.T_world_cam.interpolate(result.trajectory.stamps_ns)
                    assert known.all()
                    distance.append(np.linalg.norm(position_error(result.trajectory.T_world_body, truth), axis=1))
                    angle.append(rotation_angle(result.trajectory.T_world_body, truth))
                    held.append(result.estimates.held)
                errors[videos, detections, mode] = (
                    *map(np.concatenate, (distance, angle)),
                    np.concatenate(held).mean(),
                )
    return errors


@pytest.mark.parametrize("videos", ["training", "test"])
@pytest.mark.parametrize("detections", DETECTIONS)
def test_robust_beats_out_and_prev_on_real_detections(pooled, videos: str, detections: str) -> None:
    rmse = {mode: [np.sqrt(np.mean(e**2)) for e in pooled[videos, detections, mode][:2]] for mode in MODES}
    frames = {len(pooled[videos, detections, mode][0]) for mode in MODES}
    assert len(frames) == 1  # no mode looks better by staying silent
    for other in ("all", "out", "prev"):
        assert rmse["robust"][0] < rmse[other][0]
        assert rmse["robust"][1] < rmse[other][1]


@pytest.mark.parametrize("detections", DETECTIONS)
def test_modes_rank_as_published_on_the_test_videos(pooled, detections: str) -> None:
    rmse = {mode: np.sqrt(np.mean(pooled["test", detections, mode][0] ** 2)) for mode in MODES}
    assert rmse["best"] < rmse["prev"] < min(rmse["out"], rmse["all"])
    assert rmse["robust"] < rmse["best"]  # the oracle sees one frame only


@pytest.mark.parametrize("detections", ["selftrained", "supervised"])
def test_few_poses_are_held_where_detections_are_mostly_good(pooled, detections: str) -> None:
    assert pooled["test", detections, "robust"][2].mean() < 0.1


def test_choosing_by_memory_without_holding_changes_no_pose(shared_data: Path) -> None:
    """With hold_s = 0 each pose is one that the frame's own votes cast."""
    log = read_log(shared_data / "ycbv_dope" / "0054", "supervised")
    options = LocalizeOptions(detections="supervised", memory=Memory(hold_s=0.0))
    estimates = localize(log, options).estimates
    assert not estimates.held.any()
    assert estimates.voted[estimates.frame_of_detection >= 0].sum() >= len(estimates.camera_poses)
