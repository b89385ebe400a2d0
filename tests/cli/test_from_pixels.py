"""The documented way from nothing to the table: render videos, detect, table and run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from test_main import one_line

from poet_loc.cli.main import main
from poet_loc.io.boxes_csv import read_boxes
from poet_loc.io.landmarks_json import read_landmarks
from poet_loc.io.log_folder import read_log


@pytest.fixture(scope="module")
def videos(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("pixels") / "videos"
    words = ["--videos", "2", "--duration-s", "2.5", "2.5", "--frame-rate-hz", "10", "--jobs", "1", "--no-progress"]
    assert main(["render", "videos", "--out", str(out), *words]) == 0
    assert main(["model-card", "--videos", str(out)]) == 0
    return out


def test_a_log_gets_its_own_detections(videos, capsys):
    log = videos / "video_00"
    assert main(["detect", str(log), "--name", "mine"]) == 0
    assert "object_poses_mine.csv" in capsys.readouterr().out
    poses, known = read_log(log).object_poses["mine"], read_landmarks(log / "landmarks.json").object_ids
    assert set(poses.object_ids) <= set(known)
    assert len(np.unique(poses.frames)) > 15
    assert len(read_boxes(log / "boxes_mine.csv")) > 15
    assert main(["detect", str(log), "--name", "mine"]) == 1
    assert "--overwrite" in one_line(capsys)
    assert main(["detect", str(log), "--name", "mine", "--overwrite"]) == 0
    (log / "object_poses_mine.csv").unlink()


def test_the_table_has_both_kinds_of_boxes_and_all_modes(videos, capsys):
    logs = [str(videos / f"video_{number:02d}") for number in range(2)]
    assert main(["table", *logs, "--pooled-only", "--format", "json"]) == 0
    blocks = json.loads(capsys.readouterr().out)
    text = json.dumps(blocks)
    assert all(f"localize/{mode}" in text for mode in ("all", "out", "prev", "best", "robust"))
    assert '"bb"' in text
    assert '"gt"' in text


def test_run_takes_the_detections_by_name(videos, tmp_path):
    out = tmp_path / "run"
    assert main(["run", str(videos / "video_01"), "--detections", "gt", "--out", str(out), "--no-pictures"]) == 0
    found = json.loads((out / "summary.json").read_text())["localize/robust"]
    assert found["coverage"] > 0.9
    assert found["position_error_mm"]["norm"]["median"] < 300.0


def test_a_recording_shows_where_the_network_looked(videos, tmp_path, capsys):
    log, out = videos / "video_00", tmp_path / "seen"
    assert main(["detect", str(log), "--recording"]) == 1
    assert "--out" in one_line(capsys)
    assert main(["detect", str(log), "--out", str(out), "--recording"]) == 0
    chunks = {c.entity_path.strip("/"): c for c in RrdReader(str(out / "recording.rrd")).stream() if not c.is_static}
    points = chunks["camera/image/attention"].to_record_batch()
    (positions,) = [points.column(name).to_pylist() for name in points.schema.names if name.endswith("positions")]
    assert sum(bool(row) for row in positions) > 15
    everywhere = np.concatenate([np.array(row) for row in positions if row])
    assert np.mean(np.all((everywhere > -20) & (everywhere < [340, 260]), axis=1)) > 0.95
