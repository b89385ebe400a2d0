"""Which frames count, what the errors are, what stands in summary.json and errors.csv."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.result import FuseResult, GateLog
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, CameraPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log
from poet_loc.report.evaluate import (
    Estimate,
    EvaluateOptions,
    evaluate,
    frames_to_compare,
    pool,
    references_for_both_bodies,
    stamps_in_gaps,
)
from poet_loc.report.log_evaluation import evaluate_log, on_camera_clock
from poet_loc.report.summary import inside_3_sigma, read_summary, to_summary, write_errors_csv, write_summary

START_NS = 1_600_049_000_000_000_000
EVERYTHING = (0, 2**62)


def stamps(rate: float, count: int, offset_s: float = 0.0) -> np.ndarray:
    return START_NS + np.round((np.arange(count) / rate + offset_s) * 1e9).astype(np.int64)


def motion(stamps_ns: np.ndarray) -> Trajectory:
    t = (stamps_ns - START_NS) * 1e-9
    rotation = Rotation.from_rotvec(np.stack([0.3 * np.sin(t), 0.2 * t, 0.1 * np.cos(2 * t)], axis=1))
    return Trajectory(stamps_ns, make_pose(rotation, np.stack([np.cos(t), np.sin(t), 0.1 * t], axis=1)))


def off(trajectory: Trajectory, position=(0.0, 0.0, 0.0), body_turn=(0.0, 0.0, 0.0)) -> Trajectory:  # type: ignore[no-untyped-def]
    T = trajectory.T_world_body
    return Trajectory(
        trajectory.stamps_ns, make_pose(T.rotation * Rotation.from_rotvec(body_turn), T.translation + position)
    )


CAMERA = motion(stamps(30.0, 60))


def cam(name: str, trajectory: Trajectory, **kwargs) -> Estimate:  # type: ignore[no-untyped-def]
    return Estimate(name, trajectory, "cam", **kwargs)


def test_a_known_error_is_reported_per_axis_and_in_the_units_of_the_file() -> None:
    estimate = cam("localize/all", off(CAMERA, (0.01, -0.02, 0.03), (0.0, 0.0, -0.1)), runtime_s=1.5)
    row = to_summary(evaluate([estimate], {"cam": CAMERA}, EVERYTHING))["localize/all"]
    assert row["frames"] == 60
    assert row["coverage"] == 1.0
    position, attitude = row["position_error_mm"], row["attitude_error_deg"]
    for axis, expected in (("x", 10.0), ("y", 20.0), ("z", 30.0), ("norm", 1400**0.5)):
        assert [position[axis][k] for k in ("mean", "rmse", "p95")] == pytest.approx([expected] * 3)
        assert position[axis]["std"] == pytest.approx(0.0, abs=1e-9)
    assert [attitude["yaw"]["median"], attitude["angle"]["p95"]] == pytest.approx([np.degrees(0.1)] * 2)
    assert attitude["roll"]["rmse"] == pytest.approx(0.0, abs=1e-9)
    assert row["nees"] is row["inside_3_sigma"] is None
    assert (row["runtime_s"], row["body"], row["oracle"]) == (1.5, "cam", False)


def test_a_missed_frame_is_missed_and_not_interpolated() -> None:
    """Poses at frames never speak for a frame in between, whatever the camera's rate."""
    for rate in (20.0, 30.0, 60.0, 100.0):
        frames = motion(stamps(rate, 50))
        seen = np.ones(50, dtype=bool)
        seen[[3, 17, 18, 40]] = False
        row = evaluate([cam("a", frames[seen])], {"cam": frames}, EVERYTHING)["a"]
        assert row.stamps_ns.tolist() == frames.stamps_ns[seen].tolist()
        assert row.coverage == 46 / 50


def test_an_imu_rate_estimate_is_interpolated_at_the_frames() -> None:
    fused = Estimate("f", motion(stamps(200.0, 500, offset_s=0.0021)), "imu")
    row = evaluate([fused], {"imu": CAMERA}, EVERYTHING)["f"]
    assert row.coverage == 59 / 60  # the first frame lies before the estimate
    assert np.abs(row.errors).max() < 2e-5


def test_a_gap_of_an_imu_rate_estimate_is_not_bridged() -> None:
    trajectory = motion(stamps(200.0, 500))
    seconds = (trajectory.stamps_ns - START_NS) * 1e-9
    row = evaluate([cam("f", trajectory[(seconds < 0.5) | (seconds > 1.0)])], {"cam": CAMERA}, EVERYTHING)["f"]
    frame_s = (CAMERA.stamps_ns - START_NS) * 1e-9
    assert row.stamps_ns.tolist() == CAMERA.stamps_ns[(frame_s < 0.4951) | (frame_s > 1.0)].tolist()


def test_stamps_that_are_off_by_rounding_still_count() -> None:
    jittered = Trajectory(CAMERA.stamps_ns + 400_000, CAMERA.T_world_body)
    assert evaluate([cam("a", jittered)], {"cam": CAMERA}, EVERYTHING)["a"].coverage == 1.0
    late = Trajectory(CAMERA.stamps_ns + 600_000, CAMERA.T_world_body)
    row = evaluate([cam("a", late)], {"cam": CAMERA}, EVERYTHING)["a"]
    assert row.coverage == 0.0
    options = EvaluateOptions(max_offset_s=0.001)
    assert evaluate([cam("a", late)], {"cam": CAMERA}, EVERYTHING, options)["a"].coverage == 1.0


def test_only_frames_within_the_sensors_span_count() -> None:
    span = (int(CAMERA.stamps_ns[10]), int(CAMERA.stamps_ns[29]))
    row = evaluate([cam("a", CAMERA[15:])], {"cam": CAMERA}, span)["a"]
    assert (row.frames_in_span, len(row.stamps_ns)) == (20, 15)


def test_common_frames_are_those_that_every_row_covers() -> None:
    estimates = [
        cam("a", off(CAMERA[:40], (1.0, 0, 0))),
        Estimate("b", CAMERA[20:], "imu"),
        cam("silent", CAMERA[:0]),
    ]
    summary = to_summary(evaluate(estimates, {"cam": CAMERA, "imu": CAMERA}, EVERYTHING))
    assert summary["a"]["on_common_frames"]["frames"] == summary["b"]["on_common_frames"]["frames"] == 20
    assert summary["a"]["on_common_frames"]["position_error_mm"]["x"]["mean"] == pytest.approx(1000.0)
    assert summary["silent"]["coverage"] == 0.0
    assert summary["silent"]["position_error_mm"]["x"]["rmse"] is None


def test_rows_without_a_shared_frame_have_no_common_frames() -> None:
    evaluation = evaluate([cam("a", CAMERA[:20]), cam("b", CAMERA[30:])], {"cam": CAMERA}, EVERYTHING)
    assert to_summary(evaluation)["a"]["on_common_frames"]["frames"] == 0


def test_sigmas_bounds_and_nees_of_honest_covariances() -> None:
    rng = np.random.default_rng(3)
    frames = motion(stamps(30.0, 4000))
    sigma = np.array([0.01, 0.02, 0.03, 0.05, 0.1, 0.2])  # rx ry rz px py pz
    error = rng.normal(size=(4000, 6)) * sigma
    T = frames.T_world_body
    wrong = make_pose(T.rotation * Rotation.from_rotvec(error[:, :3]), T.translation + error[:, 3:])
    covariances = np.broadcast_to(np.diag(sigma**2), (4000, 6, 6)).copy()
    covariances[:5] = np.nan
    estimate = cam("a", Trajectory(frames.stamps_ns, wrong), pose_covariances=covariances)
    evaluation = evaluate([estimate], {"cam": frames}, EVERYTHING)
    row = evaluation["a"]
    assert row.sigmas is not None
    np.testing.assert_allclose(row.sigmas[10], [0.05, 0.1, 0.2, 0.03, 0.02, 0.01])
    shares = inside_3_sigma(row)
    assert shares is not None
    assert all(0.995 < share < 0.9995 for share in shares.values())
    nees = to_summary(evaluation)["a"]["nees"]
    assert nees is not None
    assert nees["pose"] == pytest.approx(1.0, abs=0.05)
    assert nees["bounds"][0] < 1.0 < nees["bounds"][1]


def test_pooling_weighs_frames_and_keeps_rows_comparable() -> None:
    near, far = off(CAMERA, (0.1, 0, 0)), off(CAMERA[:20], (0.4, 0, 0))
    full = evaluate([cam("a", near), cam("b", near)], {"cam": CAMERA}, EVERYTHING)
    partial = evaluate([cam("a", far)], {"cam": CAMERA}, EVERYTHING)
    pooled = pool([full, partial])
    assert pooled.names == ("a", "b")
    summary = to_summary(pooled)
    assert (summary["a"]["frames"], summary["a"]["coverage"]) == (80, 80 / 120)
    assert (summary["a"]["frames_in_span"], summary["a"]["compared_at"]) == (120, "the ground truth")
    assert summary["a"]["position_error_mm"]["x"]["mean"] == pytest.approx((60 * 100 + 20 * 400) / 80)
    # b did not run on the second log, so that log says nothing about a against b
    assert summary["a"]["on_common_frames"]["frames"] == summary["b"]["on_common_frames"]["frames"] == 60


def test_pooling_one_log_changes_nothing() -> None:
    evaluation = evaluate([cam("a", off(CAMERA, (0.1, 0, 0)), runtime_s=2.0)], {"cam": CAMERA}, EVERYTHING)
    assert to_summary(pool([evaluation])) == to_summary(evaluation)


def test_truth_that_ticks_otherwise_is_compared_at_the_sensors_frames() -> None:
    truth = motion(stamps(100.0, 300))
    sensor_ns = stamps(30.0, 60, offset_s=0.0037)
    assert frames_to_compare(truth.stamps_ns, np.repeat(sensor_ns, 3)).tolist() == sensor_ns.tolist()
    row = evaluate([cam("a", motion(sensor_ns))], {"cam": truth}, EVERYTHING, frame_stamps_ns=sensor_ns)["a"]
    assert row.coverage == 1.0
    assert np.abs(row.errors).max() < 1e-4
    # a sensor that misses most frames is still judged at all of them
    missing = CAMERA.stamps_ns[np.random.default_rng(1).random(60) < 0.5]
    assert frames_to_compare(CAMERA.stamps_ns, missing) is CAMERA.stamps_ns


@pytest.mark.parametrize(
    ("truth_hz", "sensor_hz"), [(1.0, 30.0), (7.7, 10.0), (30.0, 30.0), (30.0, 10.0), (60.0, 100.0)]
)
def test_truth_too_sparse_for_the_sensors_stamps_is_compared_at_its_own(truth_hz: float, sensor_hz: float) -> None:
    truth = motion(stamps(truth_hz, round(2 * truth_hz), offset_s=0.0047))
    sensor_ns = stamps(sensor_hz, round(2 * sensor_hz))
    assert frames_to_compare(truth.stamps_ns, sensor_ns) is truth.stamps_ns
    rows = evaluate([cam("fused", motion(stamps(200.0, 400)))], {"cam": truth}, EVERYTHING)
    assert rows["fused"].coverage > 0.9
    assert not rows["fused"].why_none


def test_sparse_truth_is_compared_at_the_sensors_stamps_where_it_has_poses_there() -> None:
    every_third = CAMERA[::3]
    frames_ns = frames_to_compare(every_third.stamps_ns, CAMERA.stamps_ns)
    row = evaluate([cam("a", CAMERA)], {"cam": every_third}, EVERYTHING, frame_stamps_ns=frames_ns)["a"]
    assert (row.coverage, len(row.stamps_ns)) == (1.0, 20)
    # wide enough a gap to interpolate over
    slow, wide = motion(stamps(20.0, 40, offset_s=0.0037)), EvaluateOptions(max_gap_s=0.1)
    assert frames_to_compare(slow.stamps_ns, stamps(15.0, 30), wide).tolist() == stamps(15.0, 30).tolist()


def test_a_long_gap_of_the_sensor_is_compared_at_the_truths_stamps_as_often() -> None:
    sensor_ns = stamps(30.0, 120, offset_s=0.0037)
    seconds = (sensor_ns - START_NS) * 1e-9
    truth_ns = stamps(100.0, 500)
    missed_ns = stamps_in_gaps(truth_ns, sensor_ns[(seconds < 1.0) | (seconds > 3.0)])
    assert np.isin(missed_ns, truth_ns).all()
    assert (len(missed_ns), np.diff(missed_ns).min() >= 3e7) == (60, True)
    in_gap = (missed_ns - START_NS) * 1e-9
    assert 0.99 < in_gap.min() < in_gap.max() < 3.0
    # what it misses now and then, and where there is no truth
    assert len(stamps_in_gaps(truth_ns, sensor_ns[np.arange(120) % 9 == 0])) == 0
    assert len(stamps_in_gaps(truth_ns, sensor_ns[(seconds < 1.0) | (seconds > 1.2)])) == 0
    assert len(stamps_in_gaps(truth_ns[:80], sensor_ns[(seconds < 1.0) | (seconds > 3.0)])) == 0


def test_clocks_that_only_beat_share_no_frame_and_it_is_said_why() -> None:
    truth, sensor = motion(stamps(7.7, 77)), motion(stamps(10.0, 100))  # they meet at 0 s
    fused = motion(stamps(200.0, 2000))
    evaluation = evaluate([cam("given", sensor), cam("fused", fused)], {"cam": truth}, EVERYTHING)
    assert evaluation["given"].coverage == 0.0
    assert evaluation["given"].why_none == (
        "its poses (10.0 Hz) share no stamp with the ground truth (7.7 Hz) to 0.5 ms "
        "and are too sparse to interpolate (0.100 s > 0.025 s)"
    )
    assert evaluation["fused"].on_common.sum() == len(truth)


def test_where_the_truth_is_missing_it_is_said_why() -> None:
    sparse, frames_ns = motion(stamps(20.0, 40, offset_s=0.0037)), CAMERA.stamps_ns
    row = evaluate([cam("a", CAMERA)], {"cam": sparse}, EVERYTHING, None, frames_ns, "frames.csv")["a"]
    assert row.why_none.startswith("the ground truth's poses (20.0 Hz) share no stamp with frames.csv (30.0 Hz)")
    later = motion(stamps(100.0, 40, offset_s=1e3))
    assert frames_to_compare(later.stamps_ns, frames_ns).tolist() == frames_ns.tolist()
    row = evaluate([cam("a", CAMERA)], {"cam": later}, EVERYTHING, None, frames_ns, "frames.csv")["a"]
    assert row.why_none == "the ground truth's poses share no time with frames.csv"
    assert evaluate([cam("a", CAMERA[:0])], {"cam": CAMERA}, EVERYTHING)["a"].why_none == ""


def test_the_other_bodys_truth_follows_from_the_extrinsics() -> None:
    T_cam_imu = RigidTransform.from_exp_coords([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    imu = references_for_both_bodies({"cam": CAMERA}, T_cam_imu)["imu"]
    back = references_for_both_bodies({"imu": imu}, T_cam_imu)["cam"]
    np.testing.assert_allclose(back.T_world_body.as_matrix(), CAMERA.T_world_body.as_matrix(), atol=1e-12)
    assert set(references_for_both_bodies({"cam": CAMERA}, None)) == {"cam"}


def fused_by_hand(trajectory: Trajectory, timeshift_found_s: float | None) -> FuseResult:
    n, none = len(trajectory), np.zeros(0)
    return FuseResult(
        "fused",
        *(trajectory.stamps_ns, trajectory.T_world_body),
        *(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3)), np.ones((n, 15)), np.tile(np.eye(6), (n, 1, 1))),
        GateLog(*[none.astype(np.int64)] * 3, *[none] * 3, *[none.astype(bool)] * 3),
        runtime_s=0.0,
        calibrated=SimpleNamespace(timeshift_cam_imu_s=timeshift_found_s, landmark_map=None),
    )


@pytest.mark.parametrize("known", [("cam", "imu"), ("cam",), ("imu",)])
@pytest.mark.parametrize(("stated_s", "found_s"), [(0.08, None), (-0.013, None), (0.03, 0.08)])
def test_errors_are_between_poses_of_one_moment_whatever_separates_the_clocks(
    stated_s: float, found_s: float | None, known: tuple[str, ...]
) -> None:
    T_cam_imu = RigidTransform.from_exp_coords([0.1, 0.2, 0.3, 0.1, 0.2, 0.3])
    timeshift_s = stated_s if found_s is None else found_s
    shift_ns = round(timeshift_s * 1e9)

    def of_imu(on_imu_clock: np.ndarray) -> Trajectory:
        return Trajectory(on_imu_clock, motion(on_imu_clock - shift_ns).T_world_body * T_cam_imu)

    truths = {"T_world_cam": CAMERA, "T_world_imu": of_imu(stamps(200.0, 400))}
    seen = CameraPoses(CAMERA.stamps_ns, np.arange(60), CAMERA.T_world_body)
    log = Log(
        Path("made"),
        camera_poses=seen,
        calibration=Calibration(T_cam_imu, stated_s),
        **{name: each for name, each in truths.items() if name[8:] in known},
    )
    followed = of_imu(stamps(200.0, 400, timeshift_s))
    fused = Estimate.of_fused(on_camera_clock(log, fused_by_hand(followed, found_s)))
    given = [] if "cam" not in known and found_s is not None else [cam("given", CAMERA)]  # nobody tells its clock
    evaluation = evaluate_log(log, None, [*given, fused], EvaluateOptions())
    assert evaluation is not None
    for row in evaluation.rows:
        assert row.coverage > 0.95
        assert np.abs(row.errors).max() < 1e-4
        assert np.isin(row.stamps_ns, CAMERA.stamps_ns).all() or known == ("imu",)


def test_what_cannot_be_compared_says_so() -> None:
    with pytest.raises(InputError, match="no ground-truth frame"):
        evaluate([cam("a", CAMERA)], {"cam": CAMERA}, (0, 1))
    with pytest.raises(ValueError, match="no ground truth"):
        evaluate([cam("a", CAMERA)], {"imu": CAMERA}, EVERYTHING)
    with pytest.raises(ValueError, match="its own name"):
        evaluate([cam("a", CAMERA)] * 2, {"cam": CAMERA}, EVERYTHING)


def test_summary_file_round_trip_is_plain_json(tmp_path: Path) -> None:
    summary = to_summary(evaluate([cam("a", CAMERA), cam("none", CAMERA[:0])], {"cam": CAMERA}, EVERYTHING))
    write_summary(tmp_path / "summary.json", summary)
    assert read_summary(tmp_path / "summary.json") == summary
    assert "NaN" not in (tmp_path / "summary.json").read_text()
    (tmp_path / "other.json").write_text(json.dumps({"a": {"frames": 1}}))
    with pytest.raises(InputError, match="no summary"):
        read_summary(tmp_path / "other.json")


def test_errors_csv_has_a_line_per_stamp_and_row(tmp_path: Path) -> None:
    covariances = np.broadcast_to(np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]) ** 2, (60, 6, 6))
    evaluation = evaluate(
        [cam("a", off(CAMERA, (0.1, 0.2, -0.3)), pose_covariances=covariances), cam("b", CAMERA[10:])],
        {"cam": CAMERA},
        EVERYTHING,
    )
    write_errors_csv(tmp_path / "errors.csv", evaluation)
    with open(tmp_path / "errors.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 110
    assert (rows[0]["name"], rows[0]["timestamp_ns"], rows[0]["on_common"]) == ("a", str(CAMERA.stamps_ns[0]), "0")
    assert [float(rows[0][k]) for k in ("x_m", "y_m", "z_m", "sigma_yaw_rad")] == [0.1, 0.2, -0.3, 0.03]
    assert rows[-1]["name"] == "b"
    assert rows[-1]["sigma_x_m"] == rows[-1]["nees"] == "nan"


def test_rows_pool_where_only_some_logs_have_sigmas() -> None:
    covariances = np.broadcast_to(np.eye(6), (60, 6, 6))
    known = evaluate([cam("a", CAMERA, pose_covariances=covariances)], {"cam": CAMERA}, EVERYTHING)
    row = pool([known, evaluate([cam("a", CAMERA)], {"cam": CAMERA}, EVERYTHING)])["a"]
    assert row.sigmas is not None
    assert np.isfinite(row.sigmas).all(axis=1).sum() == 60
    assert inside_3_sigma(replace(row, sigmas=None)) is None
