"""The rows of a sweep are what the solver gives when asked one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors

from landmarks.camera_pose import SolverOptions, solve
from landmarks.sensitivity import SWEEPS, Case, Sweep, sensitivity, with_option
from poet_loc.core.input_error import InputError


def case(seed: int, frames: int) -> Case:
    rng = np.random.default_rng(seed)
    landmarks, truth = make_map(rng, range(3)), fly_around(rng, frames)
    errors = small_errors(rng, frames, 3)
    errors[::3, 0] = gross_errors(rng, len(errors[::3]))
    return detect(truth, landmarks, errors), landmarks, truth


def test_rows_pool_the_frames_of_all_cases() -> None:
    cases = [case(0, 20), case(1, 30)]
    rows = list(
        sensitivity(
            cases, sweeps=[Sweep("distance", (0.01, 0.1), ("out",)), Sweep("memory.hold_s", (0.0,), ("robust",))]
        )
    )
    assert [(row.mode, row.option, row.value, row.default) for row in rows] == [
        ("out", "distance", 0.01, False),
        ("out", "distance", 0.1, True),
        ("robust", "memory.hold_s", 0.0, False),
    ]
    for row in rows[:2]:
        apart = []
        for poses, landmarks, truth in cases:
            estimates = solve(poses, landmarks, SolverOptions(mode="out", distance=row.value))
            apart.append(estimates.camera_poses.T_world_cam.translation - truth.T_world_body.translation)
        expected = np.linalg.norm(np.concatenate(apart), axis=1)
        assert row.frames == 50
        assert row.position_error_mm.rmse == pytest.approx(1e3 * np.sqrt(np.mean(expected**2)))
        assert row.position_error_mm.median == pytest.approx(1e3 * np.median(expected))
    assert rows[0].position_error_mm.rmse > rows[1].position_error_mm.rmse


def test_every_sweep_names_an_option_and_holds_its_default() -> None:
    for sweep in SWEEPS:
        changed = [with_option(SolverOptions(), sweep.option, value) for value in sweep.values]
        assert SolverOptions() in changed
        assert len(set(changed)) == len(sweep.values)
        assert "best" not in sweep.modes


def test_with_option() -> None:
    assert with_option(SolverOptions(), "distance", 0.3) == replace(SolverOptions(), distance=0.3)
    assert with_option(SolverOptions(), "noise.along", 0.3).noise.along == 0.3
    with pytest.raises(InputError, match="unknown option 'distanze'; choose among mode, distance"):
        with_option(SolverOptions(), "distanze", 0.3)
    with pytest.raises(InputError, match="unknown option 'alon'"):
        with_option(SolverOptions(), "noise.alon", 0.3)


def test_no_case_no_row() -> None:
    assert list(sensitivity([], sweeps=SWEEPS[:2])) == []
