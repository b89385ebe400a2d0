"""Tables: what stands in the cells, in each of the formats; APE and RPE of two trajectories."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from rich.console import Console
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory
from poet_loc.report.compare import CompareOptions, compare_trajectories
from poet_loc.report.error_tables import Block, comparison_tables, consistency_table, error_table, records, table_text
from poet_loc.report.evaluate import Estimate, evaluate
from poet_loc.report.summary import to_summary
from poet_loc.report.tables import Column, Table

STAMPS = np.arange(40, dtype=np.int64) * 33_333_333
TRUTH = Trajectory(STAMPS, RigidTransform.from_exp_coords(np.linspace(0, 1, 40)[:, None] * [0.2, 0.1, 0.4, 1, 2, 0.5]))


def wrong(sigma: float, seed: int) -> Trajectory:
    error = np.random.default_rng(seed).normal(0.0, sigma, (40, 6))
    T = TRUTH.T_world_body
    return Trajectory(STAMPS, make_pose(T.rotation * Rotation.from_rotvec(error[:, :3]), T.translation + error[:, 3:]))


@pytest.fixture(scope="module")
def blocks() -> list[Block]:
    made = []
    for seed, log in enumerate(("0049", "0050_hard|odd")):
        estimates = [
            Estimate("localize/all", wrong(0.03, seed), "cam"),
            Estimate("localize/best", wrong(0.001, seed + 10), "cam", oracle=True),
            Estimate("fuse/eskf", wrong(0.01, seed + 20), "cam", np.broadcast_to(1e-4 * np.eye(6), (40, 6, 6)), 1.5),
            Estimate("silent", TRUTH[:0], "cam"),
        ]
        summary = to_summary(evaluate(estimates, {"cam": TRUTH}, (0, int(STAMPS[-1]))))
        made.append(Block(summary, "supervised", log))
    return made


def cells_of(line: str) -> list[str]:
    return [cell.strip() for cell in line.replace("\\|", "¦").strip("| \n").split("|")]


def test_the_cells_are_the_summarys_numbers(blocks: list[Block]) -> None:
    table = error_table(blocks)
    assert [column.header for column in table.columns][:3] == ["log", "detections", "estimate"]
    row = blocks[1].summary["fuse/eskf"]
    position, attitude = (row["on_common_frames"][key] for key in ("position_error_mm", "attitude_error_deg"))
    expected = ["0050_hard|odd", "supervised", "fuse/eskf"]
    expected += [f"{position[a]['mean']:.1f} ± {position[a]['std']:.1f}" for a in "xyz"]
    expected += [f"{position['norm'][s]:.1f}" for s in ("median", "p95", "rmse")]
    expected += [f"{attitude[a]['mean']:.2f} ± {attitude[a]['std']:.2f}" for a in ("yaw", "roll", "pitch")]
    expected += [f"{attitude['angle'][s]:.2f}" for s in ("median", "p95", "rmse")]
    expected += [f"{row['position_error_mm']['norm']['rmse']:.1f}", f"{row['attitude_error_deg']['angle']['rmse']:.2f}"]
    assert list(table.rows[6]) == [*expected, "100.0"]


def test_oracles_are_labelled_and_never_the_winner(blocks: list[Block]) -> None:
    table = error_table(blocks)
    assert table.rows[1][2] == "localize/best (oracle)"
    assert {row for row, _ in table.bold} == {2, 6}
    assert {table.columns[column].header for _, column in table.bold} == {"RMSE"}
    assert any("oracle" in note for note in table.notes)


def test_a_silent_row_has_no_numbers_but_its_coverage(blocks: list[Block]) -> None:
    assert set(error_table(blocks).rows[3][3:-1]) == {"–"}
    assert error_table(blocks).rows[3][-1] == "0.0"


def test_consistency_lists_rows_with_sigmas_only(blocks: list[Block]) -> None:
    table = consistency_table(blocks)
    assert [row[2] for row in table.rows] == ["fuse/eskf", "fuse/eskf"]
    assert float(table.rows[0][3]) == pytest.approx(1.0, abs=0.3)
    assert all(float(cell) > 90 for cell in table.rows[0][5:])


def test_markdown_is_rectangular(blocks: list[Block]) -> None:
    text = error_table(blocks).markdown()
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + 8
    assert {len(cells_of(line)) for line in lines} == {18}
    assert cells_of(lines[0])[3] == "x [mm]"
    assert [cell.strip("-") for cell in cells_of(lines[1])] == [""] * 3 + [":"] * 15
    assert "**" in cells_of(lines[4])[8]


def test_latex_is_balanced_and_escaped(blocks: list[Block]) -> None:
    text = error_table(blocks).latex()
    assert r"0050\_hard" in text
    assert r"R\_ref\^{}T" in text
    assert text.count("{") == text.count("}")
    for environment in ("table*", "tabular"):
        assert text.count(rf"\begin{{{environment}}}") == text.count(rf"\end{{{environment}}}") == 1
    body = [line for line in text.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
    assert {line.count(" & ") for line in body} == {17}
    assert r"\multicolumn{6}{c}{Position error [mm]}" in text


def test_csv_and_json_hold_every_number(blocks: list[Block]) -> None:
    parsed = json.loads(table_text(blocks, "json"))
    assert parsed == records(blocks)
    row = parsed[2]
    assert (
        row["common_x_rmse_mm"] == blocks[0].summary["fuse/eskf"]["on_common_frames"]["position_error_mm"]["x"]["rmse"]
    )
    assert (row["log"], row["name"], row["runtime_s"]) == ("0049", "fuse/eskf", 1.5)
    read = list(csv.DictReader(io.StringIO(table_text(blocks, "csv"))))
    assert len(read) == 8
    assert float(read[2]["common_x_rmse_mm"]) == row["common_x_rmse_mm"]
    assert read[3]["norm_rmse_mm"] == ""


@pytest.mark.parametrize("width", [200, 100])
def test_the_terminal_shows_every_cell(blocks: list[Block], width: int) -> None:
    table = error_table(blocks)
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(table.rich(width))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in text
    assert max(len(line) for line in text.splitlines()) <= width
    for row in table.rows:
        for cell in row[2:]:
            assert cell in text
    assert "0050_hard|odd supervised" in text


def test_one_log_and_one_set_need_no_names(blocks: list[Block]) -> None:
    table = error_table([Block(blocks[0].summary)])
    assert [column.header for column in table.columns][:2] == ["estimate", "x"]
    assert "Common frames, which every row of a block covers: 40." in table.notes[1]


def test_a_table_without_groups_is_latex_too() -> None:
    text = Table("t", (Column("a"), Column("b")), (("1", "2"),)).latex()
    assert "multicolumn" not in text
    assert "1 & 2" in text


@pytest.mark.parametrize("kind", ["none", "se3", "sim3", "origin"])
def test_ape_and_rpe_are_evos_after_its_alignment(kind: str) -> None:
    est = wrong(0.05, 3)
    comparison = compare_trajectories(est, TRUTH, CompareOptions(align=kind, rpe_delta=0.5))  # type: ignore[arg-type]
    evo_est, evo_ref = (PosePath3D(poses_se3=list(t.T_world_body.as_matrix())) for t in (est, TRUTH))
    if kind == "origin":
        evo_est.align_origin(evo_ref)
    elif kind != "none":
        evo_est.align(evo_ref, correct_scale=kind == "sim3")
    for relation, mine in comparison.rpe.items():
        oracle = metrics.RPE(metrics.PoseRelation[relation], 0.5, metrics.Unit.meters)
        oracle.process_data((evo_ref, evo_est))
        assert mine.rmse == pytest.approx(oracle.get_statistic(metrics.StatisticsType.rmse), abs=1e-9, rel=1e-9)
    for relation, mine in comparison.ape.items():
        oracle = metrics.APE(metrics.PoseRelation[relation])
        oracle.process_data((evo_ref, evo_est))
        expected = {s: oracle.get_statistic(metrics.StatisticsType[s]) for s in ("mean", "std", "median", "rmse")}
        assert {s: getattr(mine, s) for s in expected} == pytest.approx(expected, abs=1e-9)


def test_comparison_tables_state_matching_and_alignment() -> None:
    comparison = compare_trajectories(wrong(0.05, 4)[::2], TRUTH, CompareOptions(align="sim3"))
    per_axis, poses = comparison_tables(comparison)
    assert "20 of 39 reference poses" in per_axis.notes[0]
    assert "Alignment: sim3, scale 1.0" in poses.notes[0] or "Alignment: sim3, scale 0.9" in poses.notes[0]
    assert f"RPE over 1 m: {comparison.rpe_pairs} pairs" in poses.notes[0]
    assert [row[0] for row in per_axis.rows] == ["x", "y", "z", "norm", "yaw", "roll", "pitch", "angle"]
    assert len(poses.rows) == 6 + 7


def test_a_path_too_short_for_a_pair_has_no_rpe() -> None:
    comparison = compare_trajectories(wrong(0.001, 5), TRUTH, CompareOptions(rpe_delta=100.0))
    assert comparison.rpe_pairs == 0
    assert "–" in comparison_tables(comparison)[1].rows[-1]


def test_trajectories_that_do_not_meet_say_so() -> None:
    late = Trajectory(STAMPS + 10**12, TRUTH.T_world_body)
    with pytest.raises(InputError, match="no stamps"):
        compare_trajectories(late, TRUTH)
    with pytest.raises(InputError, match="whole number"):
        compare_trajectories(TRUTH, TRUTH, CompareOptions(rpe_unit="frames", rpe_delta=1.5))


@pytest.mark.parametrize("width", [40, 200])
def test_equal_headers_are_told_apart_by_their_groups(width: int) -> None:
    columns = (Column("object"), Column("ADD", "gt", "%"), Column("ADD", "detected", "%"), Column("n", "detected"))
    table = Table("Areas", columns, (("a long name of an object", "1.00", "2.00", "3"),))
    assert cells_of(table.markdown().split("\n")[2]) == ["object", "gt ADD [%]", "detected ADD [%]", "n"]
    console = Console(width=width, record=True)
    console.print(table.rich(width))
    shown = console.export_text().split()
    assert {"gt", "detected", "1.00", "2.00", "3"} <= set(shown)
