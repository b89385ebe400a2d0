"""Kernels compiled from other sources than the present ones are not run, and those inside kernels compile once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest

from fusion.compiled import njit

KERNEL = """
from fusion.compiled import njit
from fusion.numbers import one

@njit(cache=True)
def two():
    return 2 * one()
"""

NUMBERS = """
from fusion.compiled import njit

@njit(cache=True)
def one():
    return {value}
"""


def test_a_change_in_an_imported_module_is_noticed(tmp_path):
    package = tmp_path / "fusion"
    package.mkdir()
    (package / "__init__.py").write_text("")
    source = Path(__file__).resolve().parents[2] / "fusion" / "compiled.py"
    (package / "compiled.py").write_text(source.read_text())
    (package / "doubled.py").write_text(KERNEL)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    program = "from fusion.doubled import two; print(two(), sum(two.stats.cache_hits.values()))"

    def run() -> list[str]:
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.split()

    (package / "numbers.py").write_text(NUMBERS.format(value=1))
    assert run() == ["2", "0"]
    assert run() == ["2", "1"]
    (package / "numbers.py").write_text(NUMBERS.format(value=5))
    assert run() == ["10", "0"]


@njit
def power(x, n):
    total = 1.0
    for _ in range(n):
        total *= x
    return total


@njit
def copied(x, out):
    out[:3] = x[:3]  # numba makes a copy in between where the two may overlap


@njit
def doubled(x):
    return x + x


class Halves(NamedTuple):
    first: np.ndarray
    second: np.ndarray


@njit(_nrt=True)
def halves(x):
    return Halves(x[:2], x[2:])


@njit
def halves_that_are_not_held(x):
    return Halves(x[:2], x[2:])


def test_constants_make_no_versions_of_a_kernel():
    @njit
    def powers(x, n):
        return power(x, 2) + power(x, 3) + power(x, n)

    assert powers(2.0, 4) == 28.0
    versions, _, _, _ = power.get_call_template([numba.float64, numba.types.literal(5)], {})
    assert versions.cases == [numba.float64(numba.float64, numba.int64)]


def test_a_kernel_inside_a_kernel_gives_what_it_gives_python():
    @njit
    def outer(x, out):
        copied(x, out)
        parts = halves(doubled(out))
        out[0:2] = 0.5 * parts.first
        parts = halves(out)
        parts.first[0] = power(parts.second[0], 2)

    x, out = np.arange(4.0), np.zeros(4)
    outer(x, out)
    held = sys.getrefcount(out)
    for _ in range(1000):
        outer(x, out)
    assert sys.getrefcount(out) == held  # references are neither lost nor kept
    np.testing.assert_array_equal(out, [4.0, 1.0, 2.0, 0.0])
    assert power(3.0, 2) == 9.0
    copied(x, out)
    np.testing.assert_array_equal(doubled(out), [0.0, 2.0, 4.0, 0.0])


def test_a_kernel_that_returns_arrays_must_say_so():
    @njit
    def outer(x):
        return halves_that_are_not_held(x).first[0]

    with pytest.raises((TypeError, numba.core.errors.NumbaError), match="_nrt=True"):
        outer(np.zeros(4))
