"""The import rule of the architecture: data flows down the list of rooms, imports point up it."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
OURS = ("poet_loc", "landmarks", "fusion")
NETWORK = ("poet_loc.model", "poet_loc.data", "poet_loc.train", "poet_loc.detect")

# the first room that fits a module says what of ours it may import besides itself; everything may import the core
MAY_IMPORT = {
    "poet_loc.core": (),
    "poet_loc.io": (),
    "poet_loc.report": ("poet_loc.io", "poet_loc.data.world.rasterizer"),
    **dict.fromkeys(NETWORK, ("poet_loc.io", *NETWORK)),
    "poet_loc.check": ("poet_loc.io", "landmarks"),
    "poet_loc.cli": OURS,
    "poet_loc": OURS,
    "landmarks": ("poet_loc.io",),
    "fusion": ("poet_loc.io", "landmarks.landmark_map"),
}
# what of others lives in some rooms only
LIVES_IN = {
    "torch": NETWORK,
    "gtsam": ("fusion.graph",),
    "rerun": ("poet_loc.report.rerun_log", "poet_loc.report.rerun_comparison"),
    "matplotlib": ("poet_loc.report",),
    "rich": ("poet_loc.report", "poet_loc.cli", *NETWORK),
    "tyro": ("poet_loc.cli",),
    "evo": (),
}
CORE_NEEDS = {"numpy", "scipy", *sys.stdlib_module_names}


def inside(module: str, rooms: tuple[str, ...]) -> bool:
    return any(module == room or module.startswith((f"{room}.", f"{room}_")) for room in rooms)


def is_for_typing_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def imported(tree: ast.AST, package: str) -> Iterator[str]:
    """Every module that runs when the code does, also those imported inside functions."""
    if isinstance(tree, ast.Import):
        yield from (alias.name for alias in tree.names)
    elif isinstance(tree, ast.ImportFrom):
        parents = package.split(".")[: len(package.split(".")) - tree.level + 1] if tree.level else []
        base = ".".join([*parents, *([tree.module] if tree.module else [])])
        yield from (name if is_module(name := f"{base}.{alias.name}") else base for alias in tree.names)
    for child in ast.iter_child_nodes(tree):
        if is_for_typing_only(child):
            continue
        yield from imported(child, package)


def is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.is_dir() or path.with_suffix(".py").is_file()


def breaches(module: str, code: str, package: str) -> list[str]:
    room = next(room for room in MAY_IMPORT if inside(module, (room,)))
    found = []
    for name in imported(ast.parse(code), package):
        top = name.split(".")[0]
        if top in OURS:
            allowed = inside(name, (room, "poet_loc.core", *MAY_IMPORT[room]))
            allowed &= not inside(name, ("poet_loc.cli",)) or room == "poet_loc.cli"
        elif room == "poet_loc.core":
            allowed = top in CORE_NEEDS
        else:
            allowed = top not in LIVES_IN or inside(module, LIVES_IN[top])
        found += [] if allowed else [f"{module} imports {name}"]
    return found


def modules() -> Iterator[tuple[str, Path]]:
    for top in OURS:
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def test_imports_point_up() -> None:
    found = []
    for module, path in modules():
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        found += breaches(module, path.read_text(encoding="utf-8"), package)
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "code", "breaks"),
    [
        ("poet_loc.core.errors", "import numpy as np\nfrom scipy import stats", False),
        ("poet_loc.core.errors", "import yaml", True),
        ("poet_loc.core.errors", "def f():\n    from poet_loc.io import tum", True),
        ("poet_loc.io.tum", "from poet_loc.core.records import CameraPoses", False),
        ("poet_loc.io.tum", "from landmarks.camera_pose import solve", True),
        ("poet_loc.io.tum", "from .. import report", True),
        ("landmarks.localize", "from poet_loc.io import tum", False),
        ("landmarks.localize", "import fusion.eskf", True),
        ("fusion.eskf", "from landmarks.landmark_map import nearest", False),
        ("fusion.eskf", "from landmarks import camera_pose", True),
        ("fusion.eskf", "import gtsam", True),
        ("fusion.graph_factors", "import gtsam", False),
        ("poet_loc.report.tables", "import fusion.fuse", True),
        ("poet_loc.report.tables", "if TYPE_CHECKING:\n    from fusion.fuse import FuseResult", False),
        ("poet_loc.report.figures", "import rerun as rr", True),
        ("poet_loc.detect", "import torch\nfrom poet_loc.model import poet", False),
        ("poet_loc.check.objects", "from landmarks.camera_pose import solve", False),
        ("poet_loc.check.gravity", "from fusion.simulate import simulate", True),
        ("poet_loc.cli.main", "import fusion.fuse, landmarks.localize", False),
        ("fusion.fuse", "from poet_loc.cli.main import main", True),
        ("poet_loc", "from poet_loc.cli import main", True),
    ],
)
def test_the_rule_sees_breaches(module: str, code: str, breaks: bool) -> None:
    assert bool(breaches(module, code, module.rpartition(".")[0] or module)) is breaks
