"""The Python interface: lazy, typed, and the same numbers as the stages behind it."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import poet_loc
from fusion.fuse import fuse as fuse_stage
from fusion.simulate import SimulationOptions, simulate
from landmarks.options import SolverOptions
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import write_log
from poet_loc.io.tum import read_tum
from poet_loc.report.html import table_html
from poet_loc.report.tables import Column, Table

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"


@pytest.fixture(scope="module")
def log():
    return simulate(SimulationOptions(duration_s=8.0, noise="white", seed=3))


@pytest.fixture(scope="module")
def localized(log):
    return poet_loc.localize(log)


@pytest.fixture(scope="module")
def fused(log):
    return poet_loc.fuse(log)


class Sources(HTMLParser):
    """Collects what a page would fetch, and checks that its elements are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []

    def handle_starttag(self, tag, attributes):
        if tag not in ("img", "meta", "link", "br"):
            self.open.append(tag)
        self.fetched += [value for name, value in attributes if name in ("src", "href", "srcset", "data")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def page_sources(html: str) -> list[str]:
    parser = Sources()
    parser.feed(html)
    assert not parser.open
    assert "@import" not in html
    assert "url(" not in html
    return parser.fetched


def test_sparse_truth_is_compared_where_there_are_poses_and_else_it_is_said_why(log):
    stamps_ns = np.arange(log.T_world_cam.stamps_ns[0] + 3_700_000, log.T_world_cam.stamps_ns[-1], 130_000_000)
    sparse = Trajectory(stamps_ns, log.T_world_cam.interpolate(stamps_ns)[0])
    log = replace(log, T_world_cam=sparse, T_world_imu=None)
    localized, fused = poet_loc.localize(log), poet_loc.fuse(log)
    assert "no errors: its poses (30.0 Hz) share no stamp with T_world_cam.tum (7.7 Hz)" in repr(localized)
    assert "RMSE" in repr(fused)
    assert fused.evaluation["fuse/eskf/objects"].coverage > 0.9


def test_errors_where_the_sensor_saw_nothing_count_and_the_table_says_where_it_was_compared(log):
    truth, detections = log.T_world_cam, log.object_poses[""]
    stamps_ns = np.arange(truth.stamps_ns[0], truth.stamps_ns[-1], 10_000_000)
    dense = Trajectory(stamps_ns, truth.interpolate(stamps_ns)[0])
    seconds = (detections.stamps_ns - stamps_ns[0]) * 1e-9
    seen = (seconds < 3.0) | (seconds > 5.0)
    fast = replace(log, T_world_cam=dense, T_world_imu=None, frames=None)
    fused = poet_loc.fuse(replace(fast, object_poses={"": detections[seen]}))
    row = fused.evaluation["fuse/eskf/objects"]
    in_gap = np.abs((row.stamps_ns - stamps_ns[0]) * 1e-9 - 4.0) < 0.9
    assert in_gap.sum() == pytest.approx(54, abs=2)
    errors = np.linalg.norm(row.errors[:, :3], axis=1)
    assert errors[in_gap].mean() > 2.0 * errors[~in_gap].mean()
    files = "object_poses.csv and, in its long gaps, T_world_cam.tum"
    told = f"Compared with ground truth at {row.frames_in_span} stamps, those of {files};"
    assert told in fused._repr_html_()
    assert f"{row.frames_in_span} stamps, those of T_world_cam.tum;" not in fused._repr_html_()
    whole = poet_loc.evaluate(poet_loc.fuse(fast)).tables[0].notes
    assert any("stamps, those of object_poses.csv; errors elsewhere do not count." in note for note in whole)


def test_import_is_light_and_names_are_there():
    code = "import sys, poet_loc; print(*sys.modules); [getattr(poet_loc, name) for name in poet_loc.__all__]"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "scipy", "numba", "torch", "gtsam", "matplotlib", "rerun", "yaml"} & set(loaded)
    assert poet_loc.__all__ == sorted(poet_loc.__all__)
    for name in poet_loc.__all__:
        assert getattr(poet_loc, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'fuze'"):
        poet_loc.fuze  # noqa: B018


def test_names_for_type_checkers_are_those_of_the_interface():
    tree = ast.parse(Path(poet_loc.__file__).read_text(encoding="utf-8"))
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    typed = {alias.name: node.module for node in guarded.body for alias in node.names}
    assert typed == poet_loc._HOME_OF
    assert set(typed) == set(poet_loc.__all__)


def test_fuse_is_the_stage(log, fused):
    stage = fuse_stage(log)
    assert fused.name == stage.name == "fuse/eskf/objects"
    np.testing.assert_array_equal(fused.trajectory.stamps_ns, stage.stamps_ns)
    np.testing.assert_allclose(fused.trajectory.T_world_body.as_matrix(), stage.T_world_imu.as_matrix())
    assert fused.detections == ""


def test_camera_poses_come_from_the_solver_that_was_asked_for(log):
    options = poet_loc.FuseOptions(measurements="camera")
    robust = poet_loc.fuse(log, options)
    out = poet_loc.fuse(log, options, solver=poet_loc.LocalizeOptions(mode="out"))
    assert robust.name == out.name == "fuse/eskf/camera"
    assert not np.allclose(robust.trajectory.T_world_body.translation[-1], out.trajectory.T_world_body.translation[-1])


def test_a_path_is_a_log(log, localized, tmp_path):
    write_log(tmp_path, log)
    again = poet_loc.localize(tmp_path)
    np.testing.assert_allclose(
        again.trajectory.T_world_body.translation, localized.trajectory.T_world_body.translation, atol=1e-6
    )


def test_errors_are_those_of_the_definition(log, localized):
    row = localized.evaluation["localize/robust"]
    truth, valid = log.T_world_cam.interpolate(row.stamps_ns)
    assert valid.all()
    estimated = localized.trajectory.T_world_body[np.isin(localized.trajectory.stamps_ns, row.stamps_ns)]
    np.testing.assert_allclose(row.errors[:, :3], estimated.translation - truth.translation, atol=1e-9)
    rmse = 1e3 * np.sqrt(np.mean(np.sum(row.errors[:, :3] ** 2, axis=1)))
    assert f"RMSE {rmse:.1f} mm" in repr(localized)


def test_what_fuses_the_oracles_camera_poses_is_an_oracle(log):
    loose = replace(poet_loc.FuseOptions(), measurements="camera")
    assert poet_loc.fuse(log, loose, solver=SolverOptions(mode="best")).estimate.oracle
    assert not poet_loc.fuse(log, loose, solver=SolverOptions(mode="prev")).estimate.oracle


def test_comparison(localized, fused, tmp_path):
    both = poet_loc.evaluate(localized, fused)
    assert set(both.summary) == {"localize/robust", "fuse/eskf/objects"}
    frames = {row["on_common_frames"]["frames"] for row in both.summary.values()}
    assert len(frames) == 1
    assert frames.pop() > 100
    assert "fuse/eskf/objects" in both.tables[0].markdown()
    paths = both.to_tum(tmp_path / "poses")
    assert [path.name for path in paths] == ["localize_robust.tum", "fuse_eskf_objects.tum"]
    assert len(read_tum(paths[1])) == len(fused.trajectory)
    assert both.plot().axes


def test_pictures_have_one_clock_however_far_the_two_are_apart(log, fused):
    later_s = 7.0
    shift_ns = round(later_s * 1e9)
    apart = replace(
        log,
        calibration=replace(log.calibration, timeshift_cam_imu_s=later_s),
        imu=replace(log.imu, stamps_ns=log.imu.stamps_ns + shift_ns),
        T_world_imu=log.T_world_imu.later(shift_ns),
    )
    result = poet_loc.fuse(apart)
    np.testing.assert_array_equal(result.trajectory.stamps_ns, fused.trajectory.stamps_ns + shift_ns)
    for record in (result.record, poet_loc.evaluate(result, poet_loc.localize(apart)).record):
        estimate = record.estimates[0]
        np.testing.assert_array_equal(estimate.trajectory.stamps_ns, fused.trajectory.stamps_ns)
        np.testing.assert_array_equal(record.fused[0].stamps_ns, fused.result.stamps_ns)
        np.testing.assert_array_equal(record.fused[0].gate.stamps_ns, fused.result.gate.stamps_ns)
        np.testing.assert_array_equal(record.references["imu"].stamps_ns, log.T_world_imu.stamps_ns)
        np.testing.assert_array_equal(record.references["cam"].stamps_ns, log.T_world_cam.stamps_ns)
        assert record.start_ns == fused.record.start_ns


def test_files(localized, fused, tmp_path):
    back = read_tum(fused.to_tum(tmp_path / "T_world_imu.tum"))
    np.testing.assert_array_equal(back.stamps_ns, fused.trajectory.stamps_ns)
    np.testing.assert_allclose(back.T_world_body.translation, fused.trajectory.T_world_body.translation, atol=1e-8)
    recording = localized.to_rerun(tmp_path / "one.rrd")
    assert recording.read_bytes()[:4] in (b"RRF2", b"RRIO")


@pytest.mark.parametrize("picture", ["errors", "trajectory", "top view", "consistency", "landmarks", "distribution"])
def test_pictures(fused, picture):
    assert fused.plot(picture).axes


def test_notebook_pages_need_nothing_from_outside(localized, fused):
    for page in (localized._repr_html_(), fused._repr_html_(), poet_loc.evaluate(localized, fused)._repr_html_()):
        sources = page_sources(page)
        assert len(sources) == 1
        assert sources[0].startswith("data:image/png;base64,")
        assert "<table>" in page


def test_without_ground_truth(log):
    blind = poet_loc.localize(replace(log, T_world_cam=None, T_world_imu=None))
    assert blind.evaluation is None
    assert repr(blind).endswith("no ground truth>")
    assert "<img" in blind._repr_html_()
    with pytest.raises(poet_loc.InputError, match="no ground truth"):
        blind.plot("errors")
    with pytest.raises(poet_loc.InputError, match="no ground truth"):
        poet_loc.evaluate(blind)


def test_what_cannot_be_compared(log, localized):
    with pytest.raises(poet_loc.InputError, match="nothing to evaluate"):
        poet_loc.evaluate()
    with pytest.raises(poet_loc.InputError, match="two results have one name"):
        poet_loc.evaluate(localized, localized)
    with pytest.raises(poet_loc.InputError, match="different logs"):
        poet_loc.evaluate(localized, poet_loc.localize(replace(log)))
    with pytest.raises(poet_loc.InputError, match="unknown picture 'nothing'"):
        localized.plot("nothing")


def test_html_tables_escape_and_mark():
    table = Table("a < b", (Column("name"), Column("x", "g", "mm")), (("<i>", "1 & 2"),), bold=frozenset({(0, 1)}))
    html = table_html(table)
    assert "a &lt; b" in html
    assert "&lt;i&gt;" in html
    assert "<b>1 &amp; 2</b>" in html
    assert "g [mm]" in html
    page_sources(html)


def test_control_loop_example(log, fused):
    spec = importlib.util.spec_from_file_location("control_loop", EXAMPLES / "control_loop.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    states, commands = example.run(replace(log, object_poses={"": replace(log.detections()[1], covariances=None)}))
    assert len(states) == len(commands) > 250
    last = states[-1]
    truth, valid = log.T_world_imu.interpolate(np.array([last.stamp_ns]))
    assert valid[0]
    assert np.linalg.norm(last.position - truth.translation[0]) < 0.05
    assert (Rotation.from_matrix(last.R_world_imu).inv() * truth.rotation[0]).magnitude() < np.radians(3.0)
    assert np.abs(np.array(commands)).max() <= 0.2


def test_ros_node_uses_only_the_interface():
    text = (EXAMPLES / "ros2_node.py").read_text(encoding="utf-8")
    ast.parse(text)
    used = set(re.findall(r"poet_loc\.(\w+)", text))
    assert used
    assert used <= set(poet_loc.__all__)
    called = set(re.findall(r"estimator\.(\w+)\(", text))
    assert called >= {"feed_imu", "feed_object_poses", "state", "health"}
    assert all(callable(getattr(poet_loc.Estimator, name)) for name in called)
