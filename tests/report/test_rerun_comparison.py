"""Recordings of several runs in one: every estimate under its run's name, what is shared once, numbers unchanged."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_rerun_log import column, having, read, stamps_of

from poet_loc.cli.main import main
from poet_loc.cli.view import run_names
from poet_loc.core.input_error import InputError
from poet_loc.report.rerun_comparison import write_comparison
from poet_loc.report.rerun_log import write_recording
from poet_loc.report.run_record import RunRecord

FUSED = "fuse/eskf/objects"


@pytest.fixture(scope="module")
def recordings(run_record: RunRecord, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run, and one in which every error is twice as large and nothing but the fusion is there."""
    folder = tmp_path_factory.mktemp("recordings")
    assert run_record.evaluation is not None
    worse = replace(run_record.evaluation[FUSED], errors=2.0 * run_record.evaluation[FUSED].errors)
    other = replace(
        run_record,
        estimates=run_record.estimates[-1:],
        evaluation=replace(run_record.evaluation, rows=(worse,)),
        voted={},
    )
    paths = {"before": folder / "before.rrd", "after": folder / "after.rrd"}
    write_recording(run_record, paths["before"])
    write_recording(other, paths["after"])
    return paths


@pytest.fixture(scope="module")
def comparison(recordings: dict[str, Path]) -> Path:
    path = recordings["before"].with_name("comparison.rrd")
    write_comparison(recordings, path)
    return path


def test_estimates_stand_under_their_runs_and_what_is_shared_once(comparison: Path, run_record: RunRecord) -> None:
    chunks = read(comparison)
    for run, count in (("before", 3), ("after", 1)):
        paths = [
            entity for entity in chunks if entity.startswith(f"world/estimates/{run}/") and entity.endswith("/path")
        ]
        assert len(paths) == count
    assert f"errors/x/after/{FUSED}" in chunks
    assert f"decisions/before/{FUSED}/004_sugar_box" in chunks
    assert "errors/x/after/localize/robust" not in chunks
    assert not any(entity.startswith(f"errors/x/{FUSED}") for entity in chunks)
    truth = stamps_of(having(chunks["world/ground_truth/cam/pose"], "Transform3D"))
    np.testing.assert_array_equal(truth, run_record.references["cam"].stamps_ns)  # once, not twice


def test_numbers_are_those_of_the_recordings(comparison: Path, recordings: dict[str, Path]) -> None:
    alone = read(recordings["before"])[f"errors/yaw/{FUSED}"]
    chunks = read(comparison)
    before, after = (chunks[f"errors/yaw/{run}/{FUSED}"] for run in recordings)
    np.testing.assert_array_equal(stamps_of(before), stamps_of(alone))
    values = np.array(column(before, ":scalars").to_pylist())
    np.testing.assert_array_equal(values, column(alone, ":scalars").to_pylist())
    np.testing.assert_allclose(column(after, ":scalars").to_pylist(), 2.0 * values)


def test_runs_are_told_apart_in_legends(comparison: Path) -> None:
    chunks = read(comparison)
    for run in ("before", "after"):
        styles = [chunk.to_record_batch() for chunk in chunks[f"errors/x/{run}/{FUSED}"] if chunk.is_static]
        names = [
            batch.column("SeriesLines:names").to_pylist()[-1]
            for batch in styles
            if "SeriesLines:names" in batch.schema.names
        ]
        assert [f"{run}: {FUSED}"] in names


def test_paths_are_named_after_their_runs_at_places_apart(comparison: Path, run_record: RunRecord) -> None:
    chunks = read(comparison)
    points = next(each for each in run_record.estimates if each.name == FUSED).trajectory.T_world_body.translation
    places = []
    for run in ("before", "after"):
        batches = [chunk.to_record_batch() for chunk in chunks[f"world/estimates/{run}/{FUSED}/name"]]
        rows = [
            (label, position)
            for batch in batches
            for label, position in zip(
                batch.column("Points3D:labels").to_pylist(), batch.column("Points3D:positions").to_pylist(), strict=True
            )
        ]
        label, [place] = rows[-1]
        assert label == [f"{run}: {FUSED}"]
        assert np.abs(points - place).max(axis=1).min() < 1e-6
        places.append(place)
    assert places[0] != places[1]


def test_rerun_verifies_it(comparison: Path, tmp_path: Path) -> None:
    program = Path(sys.executable).parent / "rerun"
    home = os.environ | {"HOME": str(tmp_path)}
    done = subprocess.run([program, "rrd", "verify", comparison], env=home, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_file_that_is_no_recording(tmp_path: Path, recordings: dict[str, Path]) -> None:
    (tmp_path / "text.rrd").write_text("no recording")
    with pytest.raises(InputError, match="is no recording"):
        write_comparison({"text": tmp_path / "text.rrd", **recordings}, tmp_path / "out.rrd")


def test_the_command_saves_and_does_not_overwrite(
    recordings: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["view", *map(str, recordings.values()), "--save", str(tmp_path / "both.rrd")]
    assert main(asked) == 0
    assert f"world/estimates/after/{FUSED}/path" in read(tmp_path / "both.rrd")
    assert main(asked) == 1
    assert "is there already" in capsys.readouterr().err
    assert main([*asked, "--overwrite"]) == 0
    assert main(["view", str(recordings["after"]), "--save", str(tmp_path / "one.rrd")]) == 1
    assert main([*asked[:3], "--save", str(recordings["after"]), "--overwrite"]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["both.rrd"]


def test_names_of_runs() -> None:
    assert run_names([Path("/a/run"), Path("/b/run")]) == ["a_run", "b_run"]
    assert run_names([Path("/a/v1.2"), Path("/a/v 1.rrd")]) == ["v1.2", "v_1"]
    with pytest.raises(InputError, match="twice"):
        run_names([Path("/a/run"), Path("/a/run")])
