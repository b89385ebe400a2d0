"""Impossible numbers of the estimators' options are refused by name; every number has a range."""

import math
from dataclasses import fields, is_dataclass, replace

import pytest

from fusion.option_ranges import RANGES
from fusion.options import FuseOptions
from poet_loc.core.input_error import InputError

NUMBERS = [
    f"{group.name}.{each.name}"
    for group in fields(FuseOptions)
    if is_dataclass(getattr(FuseOptions(), group.name))
    for each in fields(getattr(FuseOptions(), group.name))
    if type(getattr(getattr(FuseOptions(), group.name), each.name)) in (int, float)
]


def with_value(name, value):
    group, each = name.split(".")
    return replace(FuseOptions(), **{group: replace(getattr(FuseOptions(), group), **{each: value})})


def test_every_number_has_one_range():
    assert sorted(NUMBERS) == sorted(name for names in RANGES.values() for name in names)


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [math.nan, -1.0, -math.inf])
def test_no_option_is_nan_or_negative(name, value):
    with pytest.raises(InputError, match=f"^{name.replace('_', '-')} is {value}; give"):
        with_value(name, value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gate.probability", 0.0),
        ("gate.probability", 1.5),
        ("bias.correlation_across_s", 0.0),
        ("bias.correlation_rotation_s", 0.0),
        ("noise.rotation_deg", math.inf),
        ("graph.keyframe_rate_hz", 0.0),
        ("graph.kernel_width", 0.0),
        ("graph.max_iterations", 0),
        ("constant_velocity.rate_hz", 0.0),
        ("moved.memory_s", 0.0),
        ("start.min_votes", 0),
        ("start.max_angle_deg", 0.0),
        ("start.max_distance", 0.0),
        ("meeting.max_angle_deg", 0.0),
        ("meeting.max_distance", 0.0),
    ],
)
def test_what_would_divide_by_zero_is_refused(name, value):
    with pytest.raises(InputError, match=name.replace("_", "-")):
        with_value(name, value)


def test_detections_without_any_noise_are_refused():
    with pytest.raises(InputError, match="floor is 0"):
        replace(FuseOptions(), noise=replace(FuseOptions().noise, floor=0.0, across=0.0))


@pytest.mark.parametrize(
    ("name", "value"), [("gate.probability", 1.0), ("gate.settled", math.inf), ("graph.lag_s", 0.0)]
)
def test_the_ends_of_a_range_that_mean_something_are_taken(name, value):
    assert with_value(name, value)
