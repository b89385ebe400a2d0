"""The notebooks run from the first cell to their last assert, in a process of their own, and store no outputs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jupytext
import pytest

from poet_loc.model.embedded import EMBEDDED_WEIGHTS

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))

# cells as a kernel would run them, without its process: line magics are for a browser only
RUN = """
import sys, jupytext, matplotlib
matplotlib.use("Agg")
scope = {"__name__": "__main__"}
for cell in jupytext.read(sys.argv[1]).cells:
    if cell.cell_type == "code":
        source = "\\n".join("" if line.startswith("%") else line for line in cell.source.splitlines())
        exec(compile(source, sys.argv[1], "exec"), scope)
"""


def test_there_are_six_and_nothing_else():
    assert [path.name[0] for path in NOTEBOOKS] == list("123456")
    assert {path.suffix for path in FOLDER.iterdir() if path.is_file()} == {".py"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_text_with_asserts_at_its_end(path):
    cells = jupytext.read(path).cells
    assert cells[0].cell_type == "markdown"
    assert cells[0].source.startswith(f"# {path.name[0]} · ")
    assert not any(cell.get("outputs") for cell in cells)
    assert "assert " in cells[-1].source


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path):
    if path.stem.startswith("1_") and not EMBEDDED_WEIGHTS.exists():
        pytest.skip("this checkout has no embedded weights")
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONPATH": str(FOLDER.parent)}
    done = subprocess.run([sys.executable, "-c", RUN, str(path)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
