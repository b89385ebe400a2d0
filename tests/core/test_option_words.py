"""Words that an option does not know are refused by name, from Python as on the command line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Literal, get_args, get_origin, get_type_hints

import pytest

from fusion.options import Estimate, FuseOptions
from fusion.simulate import SimulationOptions
from landmarks.options import SolverOptions
from poet_loc.core.input_error import InputError


def words(options: object) -> Iterator[tuple[str, tuple]]:
    """Yield the name of each field that takes one of some words, and the words."""
    kinds = get_type_hints(type(options))
    for each in fields(options):
        if get_origin(kinds[each.name]) is Literal:
            yield each.name, get_args(kinds[each.name])
        elif is_dataclass(value := getattr(options, each.name)):
            yield from ((f"{each.name}.{name}", known) for name, known in words(value))


WORDS = [
    (record, *found) for record in (FuseOptions(), SolverOptions(), SimulationOptions()) for found in words(record)
]


def with_word(options, name, word):
    group, _, rest = name.partition(".")
    return replace(options, **{group: with_word(getattr(options, group), rest, word) if rest else word})


@pytest.mark.parametrize(("options", "name", "known"), WORDS)
def test_a_word_that_an_option_does_not_know_is_refused(options, name, known):
    for word in known:
        with_word(options, name, word)
    with pytest.raises(InputError, match=f"^{name} is 'Imu '; choose among {known[0]}, "):
        with_word(options, name, "Imu ")


def test_there_are_such_words():
    names = [name for _, name, _ in WORDS]
    assert {"estimator", "measurements", "motion", "estimate.map", "gate.partial", "tie_rule", "noise"} <= set(names)


def test_a_record_in_the_place_of_another_is_refused():
    with pytest.raises(InputError, match=r"^estimate is 'unknown'; give Estimate\(\.\.\)"):
        FuseOptions(estimate="unknown")
    assert FuseOptions(estimate=Estimate(map="unknown")).estimate.map == "unknown"
