"""Settings of the documentation: `make docs`."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from options_reference import write_options_page

project = "poet-loc"
author = "the authors of poet-loc"
release = metadata.version("poet-loc")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "examples"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
autodoc_typehints = "none"
autodoc_member_order = "bysource"
html_theme = "furo"
html_title = f"poet-loc {release}"

write_options_page(Path(__file__).resolve().parent / "_generated" / "options.md")
