"""Compiling ahead: the command says what it did, and afterwards what users call is there already."""

from __future__ import annotations

import subprocess
import sys

from poet_loc.cli.main import main

FUSE = """
from fusion.compiled import kernels_from_scratch
from fusion.fuse import fuse
from fusion.options import FuseOptions
from fusion.simulate import SimulationOptions, simulate

log = simulate(SimulationOptions(duration_s=4.0, objects=4))
for estimator in ("eskf", "graph"):
    fuse(log, FuseOptions(estimator=estimator))
print(kernels_from_scratch())
"""


def test_after_compile_a_fresh_process_compiles_nothing(capsys):
    assert main(["compile"]) == 0
    first = capsys.readouterr().out
    assert len(first.splitlines()) == 1
    assert main(["compile"]) == 0
    assert "compiled before" in capsys.readouterr().out
    fresh = subprocess.run([sys.executable, "-c", FUSE], capture_output=True, text=True, check=True)
    assert fresh.stdout.split() == ["0"]
