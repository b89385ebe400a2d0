"""Numbers that make no sense are refused by name, in one line, before anything is written."""

from __future__ import annotations

import pytest
from test_main import one_line

from poet_loc.cli.main import main

LOCALIZE = ["localize", "LOG", "--out", "OUT"]
SIMULATE = ["simulate", "--out", "OUT"]
RUNS = ["simulate", "--runs", "1"]
IMAGES, VIDEOS = ["render", "images", "--out", "OUT"], ["render", "videos", "--out", "OUT"]


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        (SIMULATE, "duration-s", "0"),
        (SIMULATE, "duration-s", "nan"),
        (SIMULATE, "imu-rate-hz", "0"),
        (SIMULATE, "camera-rate-hz", "-5"),
        (SIMULATE, "objects", "0"),
        (SIMULATE, "seed", "-1"),
        (SIMULATE, "moved.object", "8"),
        (SIMULATE, "network.gross-share", "2"),
        (SIMULATE, "network.bias-share", "0.9"),
        (SIMULATE, "network.correlation-time-s", "0"),
        (SIMULATE, "white.across-m", "-1"),
        (SIMULATE, "imu-noise.gyroscope-random-walk", "-1"),
        (RUNS, "workers", "0"),
        (RUNS, "options.evaluation.confidence", "1"),
        (["fit-noise", "LOG"], "longest-lag-s", "0"),
        (["evaluate", "LOG/T_world_cam.tum", "LOG/T_world_cam.tum"], "rpe-delta", "0"),
        (["evaluate", "LOG/T_world_cam.tum", "LOG/T_world_cam.tum"], "rpe-delta", "nan"),
        (["evaluate", "LOG/T_world_cam.tum", "LOG/T_world_cam.tum"], "max-offset-s", "inf"),
        (LOCALIZE, "distance", "-1"),
        (LOCALIZE, "gate-probability", "1"),
        (LOCALIZE, "noise.across", "nan"),
        (LOCALIZE, "memory.evidence-s", "-1"),
        (["fuse", "LOG", "--out", "OUT"], "gate.probability", "0"),
        (["fuse", "LOG", "--out", "OUT"], "graph.keyframe-rate-hz", "0"),
        (IMAGES, "jobs", "0"),
        (IMAGES, "seed", "-1"),
        (VIDEOS, "jobs", "0"),
        (VIDEOS, "frame-rate-hz", "0"),
        (VIDEOS, "focal-px", "-1"),
    ],
)
def test_an_impossible_number_is_named(command, option, value, clean_log, tmp_path, capsys):
    places = {"LOG": str(clean_log), "OUT": str(tmp_path / "out")}
    words = [places.get(word, word.replace("LOG/", f"{clean_log}/")) for word in command]
    assert main([*words, f"--{option}", value]) == 1
    assert option.removeprefix("options.evaluation.") in one_line(capsys)
    assert not list(tmp_path.iterdir())


def test_a_cluster_that_is_not_there_is_one_line(capsys):
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    assert main([*RUNS, "--cluster", "nowhere"]) == 1
    assert "dask scheduler" in one_line(capsys)
