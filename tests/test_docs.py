"""What the documentation promises exists: commands, options, files, public names; every option is explained."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest
import yaml

import poet_loc
from fusion.options import FuseOptions
from landmarks.localize import LocalizeOptions
from poet_loc.cli.convert_commands import __path__ as convert_path
from poet_loc.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
TEXTS = {path.stem: path.read_text(encoding="utf-8") for path in PAGES}
CALL = re.compile(r"(?:^ {4}|`)poet-loc ([a-z][a-z-]+)(?: ([a-z]+))?", re.MULTILINE)
"""A command as code, with the word that follows it."""


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("options_reference", ROOT / "docs" / "options_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def option_names(kind: type, prefix: str = "") -> set[str]:
    types, found = get_type_hints(kind), set()
    for each in fields(kind):
        own = types[each.name]
        found |= option_names(own, f"{prefix}{each.name}.") if is_dataclass(own) else {f"{prefix}{each.name}"}
    return found


def test_every_option_of_the_stages_is_in_the_reference_with_its_default(reference, tmp_path):
    reference.write_options_page(tmp_path / "new" / "options.md")
    page = (tmp_path / "new" / "options.md").read_text(encoding="utf-8")
    for kind in (FuseOptions, LocalizeOptions):
        for name in option_names(kind):
            assert f"| `{name}` |" in page
    default = FuseOptions().bias.correlation_across_s
    assert f"| `bias.correlation_across_s` | `{default}` | Correlation time of its part across the ray, s. |" in page


def test_nearly_every_option_is_explained(reference):
    for kind in (FuseOptions, LocalizeOptions):
        silent = [name for name, _, what in reference.rows(kind) if not what]
        assert not silent


@pytest.mark.parametrize("page", TEXTS)
def test_commands_exist(page):
    for command, following in re.findall(CALL, TEXTS[page]):
        if command in COMMANDS:
            readers = {path.stem for path in Path(next(iter(convert_path))).glob("[a-z]*.py")}
            assert command != "convert" or not following or following in readers
        else:
            pytest.fail(f"{page}.md: poet-loc {command}")


@pytest.mark.parametrize("page", ["concepts", "tutorial", "questions", "why_is_my_filter_wrong"])
def test_options_exist(page):
    names = {name.replace("_", "-") for name in option_names(FuseOptions)}
    for name in re.findall(r"--([a-z-]+\.[a-z-]+)", TEXTS[page]):
        assert name in names or name.replace(".no-", ".") in names, f"{page}.md: --{name}"


@pytest.mark.parametrize("page", TEXTS)
def test_pages_that_are_linked_exist(page):
    for target in re.findall(r"\]\(([^)#]+?\.md)", TEXTS[page]):
        if not target.startswith("_generated/"):
            assert (ROOT / "docs" / target).resolve().is_file(), f"{page}.md: {target}"


def test_interface_page_has_every_public_function():
    for name in ("read_log", "localize", "fuse", "evaluate", "Estimator", "read_calibration", "read_landmarks"):
        assert name in poet_loc.__all__
        assert name in TEXTS["api"]


def test_questions_are_fifteen():
    assert re.findall(r"^(\d+)\. \*\*", TEXTS["questions"], re.MULTILINE) == [str(k) for k in range(1, 16)]


def test_citation_is_readable():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["cff-version"] == "1.2.0"
