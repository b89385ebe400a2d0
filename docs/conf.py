"""Settings of the documentation: `make docs`."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

sys.path.insert(0, str(Path(__file__).resolve().parent))

from commands_reference import write_commands_page
from options_reference import write_options_page

project = "poet-loc"
author = copyright = "the authors of poet-loc"
release = metadata.version("poet-loc")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "examples"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
default_role = "code"
autodoc_typehints = "none"
autodoc_member_order = "bysource"
html_theme = "furo"
html_math_renderer = "mathml"
html_title = f"poet-loc {release}"

generated = Path(__file__).resolve().parent / "_generated"
write_options_page(generated / "options.md")
write_commands_page(generated / "commands.md")


def setup(app: Sphinx) -> None:
    """Write formulas as MathML, which browsers show by themselves: the pages fetch no script from anywhere."""
    app.add_html_math_renderer("mathml", inline_renderers=(inline_formula, None), block_renderers=(formula, None))


def inline_formula(writer: HTML5Translator, node: nodes.Element) -> None:
    """Write a formula within a line."""
    writer.body.append(convert(node.astext()))
    raise nodes.SkipNode


def formula(writer: HTML5Translator, node: nodes.Element) -> None:
    """Write a formula that stands by itself; one that is too wide for the window scrolls."""
    writer.body.append(
        f'<div style="overflow-x: auto; padding: 0.3em 0">{convert(node.astext(), display="block")}</div>'
    )
    raise nodes.SkipNode
