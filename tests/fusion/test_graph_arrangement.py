"""The graph's result put into the filter's state, against gtsam's retractions and each variable's own derivative."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from test_graph_factors import random_state, values_of

from fusion.graph_arrangement import Arrangement
from fusion.graph_variables import (
    CloneVariable,
    block_diagonal,
    errors_of,
    keyframe_variables,
    object_variable,
    static_variables,
)
from fusion.nav_state import GRAVITY, StateLayout, gravity_tangent

LAYOUT = StateLayout(n_objects=2, extrinsics=True, time_offset=True, gravity=True, objects=True, clone=True)


def every_kind(plain):
    clone = CloneVariable(gtsam.symbol("x", 7), errors_of(LAYOUT, "clone"), LAYOUT.clone_start)
    objects = [object_variable(LAYOUT, k) for k in (1, 0)]
    return [*keyframe_variables(3, True, plain), *static_variables(LAYOUT), *objects, clone]


@pytest.mark.parametrize("plain", [False, True])
def test_a_step_and_its_root_are_gtsams_in_the_filters_errors(plain):
    rng, variables = np.random.default_rng(5), every_kind(plain)
    origin = random_state(rng, LAYOUT)
    start = LAYOUT.clone_start
    origin[start : start + 12] = origin[:12]
    size = sum(variable.size for variable in variables)
    step, root, at = 0.3 * rng.normal(size=size), np.asfortranarray(rng.normal(size=(size, size))), 0
    moves = gtsam.VectorValues()
    for variable in variables:
        moves.insert(variable.key, step[at : at + variable.size])
        at += variable.size
    values, expected = values_of(variables, origin).retract(moves), origin.copy()
    for variable in variables:
        variable.read(values, expected)
    x, twin, arrangement = origin.copy(), np.zeros_like(origin), Arrangement(variables)
    found = arrangement.settle(origin, x, twin, step, root)
    np.testing.assert_allclose(x, expected, atol=1e-12)
    touched = np.concatenate([np.arange(v.place.start, v.place.stop) for v in variables])
    np.testing.assert_array_equal(twin[touched], x[touched])
    np.testing.assert_array_equal(np.delete(twin, touched), 0.0)
    assert arrangement.errors.tolist() == [i for variable in variables for i in variable.errors]
    derivatives = block_diagonal([variable.to_filter(x) for variable in variables])
    np.testing.assert_allclose(found, derivatives @ root, atol=1e-10)


def test_gravitys_angles_are_what_its_tangent_says():
    rng, x = np.random.default_rng(6), random_state(np.random.default_rng(7), LAYOUT)
    gravity = [variable for variable in static_variables(LAYOUT) if variable.size == 3]
    angles = rng.normal(size=2)
    step = gravity_tangent(x[GRAVITY : GRAVITY + 3]) @ angles
    found = Arrangement(gravity).settle(x, x.copy(), x.copy(), np.zeros(3), np.asfortranarray(step[:, None]))
    np.testing.assert_allclose(found[:, 0], angles, atol=1e-12)
