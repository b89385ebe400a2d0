"""Figures: what is drawn, in which unit, and that missing parts only leave out what they are needed for."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import RigidTransform

from poet_loc.core.input_error import InputError
from poet_loc.report import figure_style
from poet_loc.report import figures as figures_module
from poet_loc.report.evaluate import ERROR_AXES
from poet_loc.report.figures import (
    consistency_figure,
    draw_run,
    error_figure,
    landmark_figure,
    top_view_figure,
    trajectory_figure,
    write_figures,
)
from poet_loc.report.run_record import ACCEPTED, POSITION_ONLY, REFUSED, ROTATION_ONLY, RunRecord

EXPECTED = {
    "errors_localize_best",
    "errors_localize_robust",
    "errors_fuse_eskf_objects",
    "error_distribution",
    "consistency_localize_robust",
    "consistency_fuse_eskf_objects",
    "trajectory_cam",
    "trajectory_imu",
    "top_view",
    "landmarks_localize_robust",
    "landmarks_fuse_eskf_objects",
}


@pytest.fixture(scope="module")
def figures(run_record: RunRecord) -> dict[str, Figure]:
    return draw_run(run_record)


def test_a_full_run_has_every_figure(figures: dict[str, Figure]) -> None:
    assert set(figures) == EXPECTED


def test_every_axis_has_a_unit(figures: dict[str, Figure]) -> None:
    for name, figure in figures.items():
        for axes in figure.axes:
            texts = [axes.get_xlabel(), axes.get_ylabel()]
            assert any(texts), name
            for text in texts:
                assert not text or re.search(r"\[.+\]$", text) or text == "share of the common frames", (name, text)
        assert any(axes.get_xlabel() for axes in figure.axes), name


def test_errors_are_drawn_in_mm_and_deg_with_three_sigma(run_record: RunRecord) -> None:
    assert run_record.evaluation is not None
    row = run_record.evaluation["fuse/eskf/objects"]
    figure = error_figure(row, run_record.start_ns)
    panels = {axes.get_ylabel(): axes for axes in figure.axes}
    for k, unit, factor in ((2, "mm", 1e3), (3, "deg", 180 / np.pi)):
        axes = panels[f"{ERROR_AXES[k]} [{unit}]"]
        seconds, error = axes.lines[0].get_data()
        np.testing.assert_allclose(error, row.errors[:, k] * factor)
        np.testing.assert_allclose(seconds, (row.stamps_ns - run_record.start_ns) * 1e-9)
        band = axes.collections[0].get_paths()[0].vertices[:, 1]
        assert row.sigmas is not None
        assert band.max() == pytest.approx(3 * row.sigmas[0, k] * factor)


def test_gross_errors_do_not_shrink_the_rest(run_record: RunRecord) -> None:
    assert run_record.evaluation is not None
    row = run_record.evaluation["localize/robust"]
    errors = row.errors.copy()
    errors[3, 0] = 50.0
    axes = error_figure(replace(row, errors=errors)).axes[0]
    assert axes.get_ylim()[1] < 200.0
    assert "1 off scale, up to 50000 mm" in axes.get_title("right")


@pytest.mark.parametrize("span", [(0.15, 6.0), (11.0, 80.0), (0.3, 0.9), (1e-3, 1e3), (1e-6, 1e5)])
def test_numbers_at_logarithmic_axes_are_plain_and_apart(span: tuple[float, float]) -> None:
    figure, axes = figure_style.new_figure(1, 2, 2.8, sharex=False)
    axes[0, 0].set(xlim=span)
    axes[0, 1].set(ylim=span)
    figure_style.logarithmic(axes[0, 0].xaxis)
    figure_style.logarithmic(axes[0, 1].yaxis)
    figure.draw_without_rendering()
    for axis, side in ((axes[0, 0].xaxis, 0), (axes[0, 1].yaxis, 1)):
        ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
        shown = [tick.label1 for tick in ticks if tick.label1.get_text() and span[0] <= tick.get_loc() <= span[1]]
        boxes = sorted(label.get_window_extent().get_points()[:, side].tolist() for label in shown)
        assert len(shown) >= 2
        assert all(float(label.get_text().replace("\N{MINUS SIGN}", "-")) > 0 for label in shown)
        assert all(one[1] < other[0] for one, other in pairwise(boxes))


def test_an_estimate_beside_the_truth_stays_in_the_picture(run_record: RunRecord) -> None:
    truth = run_record.references["imu"]
    height = truth.T_world_body.translation[:, 2]
    for metres, whole in ((0.8 * np.ptp(height), True), (50.0 * np.ptp(height), False)):
        moved = RigidTransform.from_translation([0.0, 0.0, metres]) * truth.T_world_body
        estimate = replace(run_record.estimates[-1], trajectory=replace(truth, T_world_body=moved))
        figure = trajectory_figure(replace(run_record, estimates=(estimate,)), "imu")
        low, high = next(axes for axes in figure.axes if axes.get_ylabel() == "z [m]").get_ylim()
        assert low < height.min()
        assert (high > height.max() + metres) == whole
        assert high - low < 4.0 * np.ptp(height) + 0.1


def test_an_estimate_of_a_camera_at_rest_stays_in_the_picture(run_record: RunRecord) -> None:
    """Where the truth spans nothing, the best estimate says how much is shown; a worse one does not shrink it."""
    truth = run_record.references["imu"]
    resting = replace(truth, T_world_body=truth.T_world_body[np.zeros(len(truth), dtype=int)])
    estimates = []
    for metres in (0.006, 2.0):
        moved = RigidTransform.from_translation([0.0, 0.0, metres]) * resting.T_world_body
        estimates.append(replace(run_record.estimates[-1], trajectory=replace(truth, T_world_body=moved)))
    record = replace(run_record, references={"imu": resting}, estimates=tuple(estimates))
    figure = trajectory_figure(record, "imu")
    low, high = next(axes for axes in figure.axes if axes.get_ylabel() == "z [m]").get_ylim()
    height = resting.T_world_body.translation[0, 2]
    assert low < height < height + 0.006 < high < height + 0.1


def test_names_as_of_a_database_leave_the_panels_their_size(run_record: RunRecord) -> None:
    """Long, with what would be a broken formula; panels are as wide as with short names."""

    def named(name: str) -> RunRecord:
        landmarks = [replace(each, name=name) for each in run_record.landmark_map]
        return replace(run_record, landmark_map=replace(run_record.landmark_map, landmarks=tuple(landmarks)))

    long = named("CAD_0001_" + 6 * "of_a_very_long_name_" + "$\\frac$_rev_B")
    widths = []
    for record in (named("box"), long):
        figure = top_view_figure(record)
        figure.draw_without_rendering()
        widths.append([axes.get_window_extent().width for axes in figure.axes])
    assert widths[1] == pytest.approx(widths[0], rel=0.02)
    name, decisions = next(iter(long.decisions.items()))
    figure = landmark_figure(long, decisions, name)
    figure.draw_without_rendering()
    assert figure.axes[0].get_window_extent().width > 0.5 * figure.bbox.width
    texts = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert all(text.startswith("CAD_0001_") and "_B" in text and len(text) < 32 for text in texts)


def test_lines_do_not_bridge_gaps() -> None:
    seconds = np.array([0.0, 0.1, 0.2, 0.9, 1.0])
    at, values = figure_style.broken(seconds, np.arange(5.0))
    assert np.isnan(at).tolist() == [False, False, False, True, False, False]
    assert np.isnan(values[3])
    assert figure_style.broken(seconds[:1], seconds[:1])[0].tolist() == [0.0]


def test_no_path_from_above_bridges_a_gap(run_record: RunRecord) -> None:
    whole = run_record.estimates[-1].trajectory
    count = len(whole)
    silent = whole[np.r_[: count // 3, 2 * count // 3 : count]]
    estimate = replace(run_record.estimates[-1], trajectory=silent)
    panel = top_view_figure(replace(run_record, estimates=(estimate,))).axes[-1]
    drawn = next(line for line in panel.lines if line.get_label() == estimate.name)
    gap = np.flatnonzero(np.isnan(np.asarray(drawn.get_xdata(), dtype=float)))
    assert gap.tolist() == [count // 3]
    np.testing.assert_allclose(np.asarray(drawn.get_xdata())[-1], silent.T_world_body.translation[-1, 0])


def test_decisions_of_gate_and_votes(run_record: RunRecord) -> None:
    gate = run_record.fused[0].gate
    assert gate is not None
    found = run_record.decisions["fuse/eskf/objects"].decisions
    since = gate.stamps_ns > run_record.fused[0].stamps_ns[0]
    assert 0 < len(found) == since.sum() < len(since), "what made the start was not refused"
    position, rotation = gate.position_accepted[since], gate.rotation_accepted[since]
    both, neither = position & rotation, ~position & ~rotation
    assert (found[both] == ACCEPTED).all()
    assert (found[neither] == REFUSED).all()
    assert (found[position & ~both] == POSITION_ONLY).all()
    assert (found[rotation & ~both] == ROTATION_ONLY).all()
    lanes = run_record.decisions["localize/robust"].lanes()
    assert list(lanes) == [(3, 0), (9, 1)]
    assert sum(len(stamps) for stamps, _ in lanes.values()) == 240
    assert [run_record.landmark_label(*key) for key in lanes] == ["004_sugar_box", "object 9 #1"]


def test_no_title_speaks_of_landmarks_where_there_are_none(run_record: RunRecord) -> None:
    fused = run_record.fused[0]
    gate = replace(fused.gate, object_ids=np.full_like(fused.gate.object_ids, -1))
    of_poses = replace(run_record, fused=(replace(fused, gate=gate),), landmark_map=None, detections=None, voted={})
    for record, spoken in ((run_record, True), (of_poses, False)):
        figures = [top_view_figure(record), landmark_figure(record, record.decisions[fused.name], fused.name)]
        assert ["landmark" in figure.get_suptitle() for figure in figures] == [spoken, spoken]


def test_the_share_accepted_is_of_the_poses_that_were_asked(run_record: RunRecord) -> None:
    gate, row = run_record.fused[0].gate, run_record.evaluation["fuse/eskf/objects"]
    late = np.arange(len(gate.stamps_ns)) >= 60
    asked = replace(
        gate, nis_position=np.where(late, gate.nis_position, np.nan), position_accepted=late & gate.position_accepted
    )
    title = consistency_figure(row, asked).axes[1].get_title("left")
    assert f"{100 * gate.position_accepted[late].mean():.1f} % accepted" in title


def test_lanes_cover_the_time_that_was_seen(figures: dict[str, Figure]) -> None:
    """The bars of a lane add up to the frames in which the landmark was seen."""
    bars = [path for c in figures["landmarks_localize_robust"].axes[0].collections for path in c.get_paths()]
    widths = [np.ptp(path.vertices[:, 0]) for path in bars]
    assert sum(widths) == pytest.approx(2 * 4.0, rel=1e-3)


def test_what_is_missing_leaves_out_only_its_figures(run_record: RunRecord) -> None:
    bare = replace(run_record, references={}, evaluation=None, fused=(), landmark_map=None, detections=None, voted={})
    assert set(draw_run(bare)) == {"trajectory_cam", "trajectory_imu", "top_view"}
    silent = replace(run_record.estimates[1], trajectory=run_record.estimates[1].trajectory[:0])
    assert set(draw_run(replace(bare, estimates=(silent,)))) == {"trajectory_cam", "top_view"}
    assert draw_run(replace(bare, estimates=())) == {}


def test_files_are_written_with_something_in_them(run_record: RunRecord, tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    few = replace(run_record, evaluation=None, detections=None, voted={}, fused=())
    paths = write_figures(few, tmp_path / "figures")
    assert {path.name for path in paths} == {"trajectory_cam.png", "trajectory_imu.png", "top_view.png"}
    for path in paths:
        with Image.open(path) as image:
            assert image.width == int(figure_style.WIDTH * 160)
            assert np.std(np.asarray(image.convert("L"))) > 5
    assert not list((tmp_path / "figures").glob("*.pdf"))
    assert dict(mpl.rcParams) == before
    with pytest.raises(InputError, match="'bmp'"):
        figure_style.save_figures({}, tmp_path, "bmp")


def test_for_a_paper_each_figure_is_a_vector_pdf_too(run_record: RunRecord, tmp_path: Path) -> None:
    few = replace(run_record, evaluation=None, detections=None, voted={}, fused=())
    pictures = write_figures(few, tmp_path, paper=True)
    assert len(pictures) == 3
    for picture in pictures:
        content = picture.with_suffix(".pdf").read_bytes()
        assert content.startswith(b"%PDF")
        assert b"/FontFile2" in content  # fonts are embedded as TrueType, which publishers ask for
        assert b"/Subtype /Image" not in content
        (box,) = re.findall(rb"/MediaBox \[ 0 0 ([0-9.]+) ([0-9.]+) \]", content)
        assert float(box[0]) == pytest.approx(72 * figure_style.WIDTH, abs=0.1)


def test_very_many_dots_are_pixels_even_in_a_pdf(
    run_record: RunRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run_record.evaluation is not None
    row = run_record.evaluation["localize/robust"]
    (vectors,) = figure_style.save_figures({"few": error_figure(row)}, tmp_path, "pdf")
    monkeypatch.setattr(figures_module, "_MOST_DOTS", 50)
    (pixels,) = figure_style.save_figures({"many": error_figure(row)}, tmp_path, "pdf")
    assert b"/Subtype /Image" not in vectors.read_bytes()
    assert b"/Subtype /Image" in pixels.read_bytes()


def test_colours_are_told_apart_by_the_colour_blind() -> None:
    """Under a simulation of deuteranopia (Vienot et al. 1999) the palette keeps its distances."""
    palette = [figure_style.BLUE, figure_style.VERMILLION, figure_style.GREEN, figure_style.PURPLE]
    simulation = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    seen = np.array([to_rgb(colour) for colour in palette]) ** 2.2 @ simulation.T
    gaps = np.linalg.norm(seen[:, None] - seen, axis=-1) + np.eye(len(palette))
    assert gaps.min() > 0.1
