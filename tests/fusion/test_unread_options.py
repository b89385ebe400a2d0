"""What is refused as unread changes no number of the result, and what is not refused does, or may."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from functools import reduce

import numpy as np
import pytest

from fusion.fuse import fuse
from fusion.motion_source import motion_of
from fusion.options import Estimate, FuseOptions, Graph, Moved
from fusion.simulate import SimulationOptions, simulate
from fusion.unread_options import Reader, refuse_unread
from poet_loc.core.input_error import InputError

POSE = (0.3, -0.2, 1.1, 0.0, 0.0, 0.0, 1.0)
OTHER = {
    "gate.partial": "none",
    "graph.kernel": "cauchy",
    "graph.kernel_width": 0.5,
    "moved.then": "re-estimate",
    "estimate.map": "approximate",
    "gate.probability": 0.5,
    "bias.correlation_across_s": 0.2,
    "bias.means": tuple((k, 5.0, 0.0, 0.0, 0.0, 0.01, 0.02) for k in range(1, 20)),
    "bias.correlation_along_s": 0.2,
    "bias.correlation_rotation_s": 0.2,
    "start.min_votes": 30,
    "start.min_span_s": 0.9,
    "start.window_s": 0.2,
    "start.pose": POSE,
}
"""Values beside the default where half as much again is none."""


def names(options: object) -> list[str]:
    """Return the dotted names of all options in groups."""
    found = []
    for each in fields(options):
        value = getattr(options, each.name)
        if is_dataclass(value):
            found += [f"{each.name}.{name}" for name in (names(value) or [one.name for one in fields(value)])]
    return found or [each.name for each in fields(options)]


def with_other(options: FuseOptions, name: str) -> FuseOptions:
    group, _, option = name.partition(".")
    value = getattr(getattr(options, group), option)
    other = OTHER.get(name, not value if isinstance(value, bool) else value + 1 if isinstance(value, int) else None)
    other = (1.5 * value if value else 0.3) if other is None else other
    return replace(options, **{group: replace(getattr(options, group), **{option: other})})


def is_refused(log, base: FuseOptions, name: str) -> bool:
    options = with_other(base, name)
    stated = any(poses.covariances is not None for poses in log.object_poses.values())
    own = log.camera_poses
    unstated = own is None or own.covariances is None or np.isnan(own.covariances).any()
    try:
        refuse_unread(options, [Reader(options, motion_of(log, options), own is None, stated, bool(unstated))])
    except InputError as error:
        return name.replace("_", "-") in error.what
    return False


def numbers(log, options: FuseOptions) -> np.ndarray:
    result = fuse(log, options)
    return np.c_[result.T_world_imu.as_matrix().reshape(-1, 16), result.velocity, result.sigmas]


def log_with(**simulation):
    wanted = {"duration_s": 5.0, "imu_rate_hz": 100.0, "camera_rate_hz": 15.0, "objects": 3}
    return simulate(SimulationOptions(**(wanted | simulation)))


CHOICES = {
    "eskf": (FuseOptions(), {}),
    "graph": (FuseOptions("graph"), {}),
    "batch": (FuseOptions("batch"), {}),
    "batch without a kernel": (FuseOptions("batch", graph=Graph(kernel="none")), {}),
    "smoothed, stated covariances": (FuseOptions(smooth=True), {"noise": "white"}),
    "camera poses": (FuseOptions(measurements="camera"), {"camera_poses": True}),
    "odometry": (FuseOptions(motion="odometry"), {"odometry": True}),
    "imu and odometry": (FuseOptions(), {"odometry": True}),
    "nothing that moves": (FuseOptions(motion="constant-velocity"), {}),
    "approximate map": (FuseOptions(estimate=Estimate(map="approximate", extrinsics=True, time_offset=True)), {}),
    "unknown map": (FuseOptions(estimate=Estimate(map="unknown", gravity=True)), {}),
    "estimated anew": (FuseOptions(moved=Moved(then="re-estimate")), {}),
    "nobody released": (FuseOptions(moved=Moved(release=False)), {}),
}


@pytest.mark.parametrize("choice", CHOICES)
def test_what_is_refused_changes_no_number(choice):
    base, simulation = CHOICES[choice]
    log = log_with(**simulation)
    refused = [name for name in names(base) if is_refused(log, base, name)]
    assert len(refused) > 10
    np.testing.assert_array_equal(numbers(log, reduce(with_other, refused, base)), numbers(log, base))


def test_the_noise_of_camera_poses_is_read_where_one_states_none():
    log, base = log_with(camera_poses=True), FuseOptions(measurements="camera")
    noise = ["camera_noise.position", "camera_noise.rotation_deg"]
    assert all(is_refused(log, base, name) for name in noise)
    covariances = log.camera_poses.covariances.copy()
    covariances[::7] = np.nan
    log = replace(log, camera_poses=replace(log.camera_poses, covariances=covariances))
    for name in noise:
        assert not is_refused(log, base, name)
        assert not np.array_equal(numbers(log, with_other(base, name)), numbers(log, base))


FELT = {
    "eskf": ["noise.across", "bias.along", "prior.velocity", "imu.noise_scale"],
    "graph": ["graph.lag_s", "graph.kernel_width"],
    "batch": ["graph.kernel"],
    "smoothed, stated covariances": ["noise.stated_scale"],
    "camera poses": ["prior.position"],
    "odometry": ["odometry.translation_walk"],
    "imu and odometry": ["odometry.step_s"],
    "nothing that moves": ["constant_velocity.acceleration", "prior.velocity"],
    "approximate map": ["prior.map_position", "prior.extrinsic_position", "prior.time_offset"],
    "unknown map": ["meeting.min_poses", "prior.gravity_deg"],
}


@pytest.mark.parametrize("choice", FELT)
def test_what_changes_the_result_is_not_refused(choice):
    base, simulation = CHOICES[choice]
    log = log_with(**simulation)
    expected = numbers(log, base)
    for name in FELT[choice]:
        assert not is_refused(log, base, name), name
        assert not np.array_equal(numbers(log, with_other(base, name)), expected), name
