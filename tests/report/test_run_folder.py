"""A run folder survives being written and read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from poet_loc.core.input_error import InputError
from poet_loc.io.tum import write_tum
from poet_loc.report.run_folder import STATE_COLUMNS, read_errors_csv, read_run, read_states, write_states
from poet_loc.report.run_record import RunRecord
from poet_loc.report.summary import to_summary, write_errors_csv, write_summary


def test_states_round_trip(run_record: RunRecord, tmp_path: Path) -> None:
    fused = run_record.fused[0]
    write_states(tmp_path / "states.csv", fused)
    read = read_states(tmp_path / "states.csv")
    np.testing.assert_array_equal(read.stamps_ns, fused.stamps_ns)
    np.testing.assert_allclose(read.T_world_imu.as_matrix(), fused.T_world_imu.as_matrix(), atol=5e-9)
    for name in ("velocity", "gyroscope_bias", "accelerometer_bias", "sigmas"):
        np.testing.assert_allclose(getattr(read, name), getattr(fused, name), atol=5e-10)


def test_states_csv_is_the_documented_one(run_record: RunRecord, tmp_path: Path) -> None:
    """A golden row: bias and sigma columns stand where their names say."""
    fused = run_record.fused[0]
    write_states(tmp_path / "states.csv", fused)
    header, first, *rest = (tmp_path / "states.csv").read_text().splitlines()
    assert header.startswith("timestamp_ns,px,py,pz,vx,vy,vz,qx,qy,qz,qw,bgx,bgy,bgz,bax,bay,baz,sigma_rx,")
    assert header.split(",")[1:] == list(STATE_COLUMNS)
    cells = dict(zip(header.split(","), first.split(","), strict=True))
    assert int(cells["timestamp_ns"]) == fused.stamps_ns[0]
    assert float(cells["bay"]) == pytest.approx(fused.accelerometer_bias[0, 1], abs=1e-9)
    assert [float(cells[f"sigma_{axis}"]) for axis in ("rx", "pz", "vx", "bgy", "baz")] == [
        0.01,
        0.005,
        0.02,
        1e-3,
        1e-2,
    ]
    assert len(rest) == len(fused.stamps_ns) - 1


def test_a_run_is_read_whole(run_record: RunRecord, tmp_path: Path) -> None:
    assert run_record.evaluation is not None
    summary = to_summary(run_record.evaluation)
    write_summary(tmp_path / "summary.json", summary)
    write_errors_csv(tmp_path / "errors.csv", run_record.evaluation)
    (tmp_path / "options.yaml").write_text("command: run\nasked: {seed: 3}\n")
    place = tmp_path / "fuse" / "eskf" / "objects"
    place.mkdir(parents=True)
    write_states(place / "states.csv", run_record.fused[0])
    write_states(tmp_path / "states.csv", run_record.fused[0])
    write_tum(place / "T_world_imu.tum", run_record.estimates[2].trajectory)
    run = read_run(tmp_path)
    assert run.summary == summary
    assert run.options == {"command": "run", "asked": {"seed": 3}}
    assert set(run.states) == {"", "fuse/eskf/objects"}
    assert list(run.trajectories) == ["fuse/eskf/objects/T_world_imu"]
    row = run_record.evaluation["localize/robust"]
    errors = run.errors["localize/robust"]
    np.testing.assert_array_equal(errors["timestamp_ns"], row.stamps_ns)
    np.testing.assert_allclose(errors["yaw_rad"], row.errors[:, 3], atol=1e-9)
    assert summary["localize/robust"]["position_error_mm"]["z"]["rmse"] == pytest.approx(
        1e3 * np.sqrt(np.mean(errors["z_m"] ** 2)), abs=1e-5
    )


def test_what_is_no_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no run folder"):
        read_run(tmp_path)
    (tmp_path / "options.yaml").write_text("command: run\n")
    assert read_run(tmp_path).summary == {}
    (tmp_path / "errors.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"no errors\.csv"):
        read_errors_csv(tmp_path / "errors.csv")
    (tmp_path / "errors.csv").write_text("name,timestamp_ns,x_m\nlocalize/all,5,abc\n")
    with pytest.raises(InputError, match="cannot be read"):
        read_errors_csv(tmp_path / "errors.csv")
