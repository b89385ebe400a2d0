"""Kernels compiled from other sources than the present ones are not run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
