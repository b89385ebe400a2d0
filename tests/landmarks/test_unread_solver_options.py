"""What is refused as unread changes no camera pose, and what is not refused does."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest

from fusion.detection_errors import NetworkErrors
from fusion.simulate import SimulationOptions, simulate
from landmarks.localize import LocalizeOptions, localize
from landmarks.options import MODES, Memory, SolverOptions, VoteNoise
from landmarks.unread_options import reader_of, refuse_unread
from poet_loc.core.input_error import InputError
from poet_loc.io.log_folder import Log

OTHERS = {
    "distance": 0.02,
    "angle_deg": 2.0,
    "tie_rule": "compact",
    "position_average": "median",
    "rotation_average": "geodesic",
    "vote_weights": "score",
    "trust_instances": True,
    "gate_probability": 0.5,
    "noise.across": 0.03,
    "noise.along": 0.1,
    "noise.least": 0.05,
    "noise.rotation_deg": 9.0,
    "noise.use_detections": False,
    "memory.evidence_s": 0.5,
    "memory.hold_s": 0.1,
    "memory.speed": 2.0,
    "memory.turn_rate_deg": 200.0,
    "memory.white_share": 1.0,
}


def with_other(options: SolverOptions, name: str) -> SolverOptions:
    group, _, option = name.rpartition(".")
    if not group:
        return replace(options, **{option: OTHERS[name]})
    return replace(options, **{group: replace(getattr(options, group), **{option: OTHERS[name]})})


def log_of(symmetric: int, noise: str, gross_share: float = 0.06) -> Log:
    errors = NetworkErrors(gross_share=gross_share)
    world = SimulationOptions(duration_s=4.0, camera_rate_hz=15.0, objects=5, symmetric_objects=symmetric, seed=2)
    return simulate(replace(world, noise=noise, network=errors))


def refused(log: Log, base: SolverOptions, name: str) -> bool:
    options, poses = with_other(base, name), next(iter(log.object_poses.values()))
    try:
        refuse_unread(options, [reader_of(poses, log.landmark_map, options, options.mode)])
    except InputError as error:
        return error.what == f"{name.replace('_', '-')} changes nothing here"
    return False


def numbers(log: Log, options: SolverOptions) -> np.ndarray:
    given = {name: getattr(options, name) for name in SolverOptions.__dataclass_fields__}
    found = localize(log, LocalizeOptions(**given)).estimates.camera_poses
    return np.concatenate([found.T_world_cam.as_matrix().ravel(), found.covariances.ravel()])


@pytest.mark.parametrize("noise", ["network", "white"])  # white: with covariances
@pytest.mark.parametrize("symmetric", [0, 2])
@pytest.mark.parametrize("mode", MODES)
def test_what_is_refused_changes_no_number(mode, symmetric, noise):
    log, base = log_of(symmetric, noise), SolverOptions(mode=mode)
    names = [name for name in OTHERS if refused(log, base, name)]
    assert "trust_instances" in names
    np.testing.assert_allclose(numbers(log, reduce(with_other, names, base)), numbers(log, base), rtol=1e-9, atol=1e-12)


def test_without_evidence_the_rest_of_the_memory_is_refused():
    log, base = log_of(0, "network"), SolverOptions(memory=Memory(evidence_s=0.0))
    names = [name for name in OTHERS if name.startswith("memory.") and refused(log, base, name)]
    assert names == ["memory.hold_s", "memory.speed", "memory.turn_rate_deg", "memory.white_share"]
    np.testing.assert_array_equal(numbers(log, reduce(with_other, names, base)), numbers(log, base))


FELT = {
    "all": ["position_average", "vote_weights", "noise.across"],
    "out": ["distance", "angle_deg", "position_average"],
    "prev": ["distance", "vote_weights"],
    "best": ["noise.rotation_deg"],
    "robust": ["gate_probability", "memory.evidence_s", "memory.hold_s", "noise.along"],
}


@pytest.mark.parametrize("mode", MODES)
def test_what_changes_the_result_is_not_refused(mode):
    log, base = log_of(0, "network", gross_share=0.5), SolverOptions(mode=mode)
    for name in FELT[mode]:
        assert not refused(log, base, name), name
        assert not np.array_equal(numbers(log, with_other(base, name)), numbers(log, base)), name


def test_objects_that_may_be_mistaken_make_the_thresholds_count():
    base = SolverOptions(mode="robust")
    log = log_of(2, "network")
    assert not refused(log, base, "angle_deg")
    assert refused(log_of(0, "network"), base, "angle_deg")
    assert not np.array_equal(numbers(log, with_other(base, "angle_deg")), numbers(log, base))


def test_one_reader_of_several_is_enough():
    log = log_of(0, "network")
    poses, options = next(iter(log.object_poses.values())), SolverOptions(noise=VoteNoise(use_detections=False))
    readers = [reader_of(poses, log.landmark_map, options, mode) for mode in MODES]
    with pytest.raises(InputError, match=r"noise.use-detections changes nothing here; it goes with detections with"):
        refuse_unread(options, readers)
    stated = next(iter(log_of(0, "white").object_poses.values()))
    refuse_unread(options, [*readers, reader_of(stated, log.landmark_map, options, "all")])
    with pytest.raises(InputError, match="changes nothing: no object poses are localised"):
        refuse_unread(options, [])
