"""The documentation builds without a warning, its pages show in a browser without a network, its code runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from fusion.simulate import SimulationOptions, simulate
from poet_loc.cli.convert import COMMANDS as CONVERT
from poet_loc.cli.main import COMMANDS
from poet_loc.cli.render import COMMANDS as RENDER
from poet_loc.io.log_folder import write_log

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    pytest.importorskip("sphinx", reason="the docs extra is not installed")
    folder = tmp_path_factory.mktemp("docs")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "-E", "-b", "html", str(ROOT / "docs"), str(folder)]
    done = subprocess.run(build, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


def test_links_within_the_documentation_lead_somewhere(built):
    for page in built.rglob("*.html"):
        for target, anchor in re.findall(
            r'href="([^"#:?]*)(?:[?][^"#]*)?(?:#([^"]*))?"', page.read_text(encoding="utf-8")
        ):
            found = (page.parent / target).resolve() if target else page
            assert found.exists(), f"{page.name}: {target}"
            if anchor and found.suffix == ".html":
                assert f'id="{anchor}"' in found.read_text(encoding="utf-8"), f"{page.name}: {target}#{anchor}"


def test_pages_load_nothing_from_elsewhere(built):
    for page in built.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"([^\"]+)\"", text)
        loaded += re.findall(r"<link\b[^>]*\brel=\"stylesheet\"[^>]*\bhref=\"([^\"]+)\"", text)
        assert loaded
        assert not [address for address in loaded if "//" in address]


@pytest.mark.parametrize("name", ["concepts", "_generated/options"])
def test_pages_in_a_browser(built, browser, name):
    page = built / f"{name}.html"
    layout = browser.layout(page, allowed="file:")
    assert layout.refused == []
    assert layout.overflow[0] == 0
    assert "$" not in layout.text
    assert "\\" not in layout.text
    if name == "concepts":
        assert len(layout.formulas) > 20
        assert min(layout.formulas) > 4


def test_every_command_has_its_place_in_the_reference(built):
    page = (built / "_generated" / "commands.html").read_text(encoding="utf-8")
    for command in set(COMMANDS) - {"convert", "render"}:
        assert f"<h2>poet-loc {command}<" in page
    for command, kinds in (("convert", CONVERT), ("render", RENDER)):
        for kind in kinds:
            assert f"<h3>poet-loc {command} {kind}<" in page
    assert "--measurements" not in page  # an option of fuse, told on the options' page
    assert ">--paper</span>" in page


def test_code_of_the_tutorial_runs(tmp_path):
    (tmp_path / "demo" / "log").mkdir(parents=True)
    write_log(tmp_path / "demo" / "log", simulate(SimulationOptions(duration_s=8.0, seed=1)))
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"), re.DOTALL)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    run = [sys.executable, "-W", "error::DeprecationWarning", "-c", code]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "fuse/eskf/objects" in done.stdout
    assert {"errors.png", "T_world_imu.tum", "both.rrd"} <= {path.name for path in tmp_path.iterdir()}
