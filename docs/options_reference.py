"""Writes the options reference from the dataclasses, which are the one home of every default and every explanation."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, get_type_hints

STAGES = (
    ("localize", "landmarks.localize", "LocalizeOptions"),
    ("fuse", "fusion.options", "FuseOptions"),
    ("the online estimator", "fusion.online_input", "OnlineOptions"),
    ("evaluate: rows of a run", "poet_loc.report.evaluate", "EvaluateOptions"),
    ("evaluate: one trajectory against another", "poet_loc.report.compare", "CompareOptions"),
    ("fit-noise", "fusion.fit_noise", "FitNoiseOptions"),
    ("simulate", "fusion.simulate", "SimulationOptions"),
    ("detect", "poet_loc.detect.options", "DetectOptions"),
    ("convert bop", "poet_loc.io.convert_bop", "ConvertBopOptions"),
    ("convert poet", "poet_loc.io.convert_poet", "ConvertPoetOptions"),
    ("convert tum", "poet_loc.io.convert_tum", "ConvertTumOptions"),
    ("convert rosbag", "poet_loc.io.convert_rosbag", "ConvertRosbagOptions"),
    ("convert euroc", "poet_loc.io.convert_euroc", "ConvertEurocOptions"),
    ("convert kalibr", "poet_loc.io.convert_kalibr", "ConvertKalibrOptions"),
    ("convert kitti and openvins", "poet_loc.io.convert_trajectory", "ConvertTrajectoryOptions"),
    ("convert super6d", "poet_loc.io.convert_super6d", "ConvertSuper6dOptions"),
    ("convert annotation", "poet_loc.io.convert_annotation", "ConvertAnnotationOptions"),
    ("evaluate-poses", "poet_loc.report.pose_inputs", "EvaluatePosesOptions"),
    ("render images", "poet_loc.data.render", "RenderOptions"),
    ("render videos", "poet_loc.videos", "VideoOptions"),
)

HEAD = """# Options

Made from the dataclasses when the documentation is built. An option `group.name` is written `--group.name` on the
command line (`_` becomes `-`) and as the field of a dataclass in Python. An unknown option is an error,
and so is one that nothing reads with what else was chosen: the mode of the solver, the estimator, the measurements,
the map, the motion, the noise of a simulation, the images, the start or the preset of a training.
"""


def write_options_page(path: Path) -> None:
    """Write the page; the folder is made."""
    parts = [HEAD]
    for title, module, name in STAGES:
        kind = getattr(import_module(module), name)
        parts.append(f"## {title}\n\n`{module}.{name}`: {summary(kind)}\n\n{table(kind)}\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(parts), encoding="utf-8")


def table(kind: type) -> str:
    """Return a markdown table of every option, groups spread out."""
    lines = ["| option | default | what |", "|---|---|---|"]
    lines += [f"| `{name}` | {default} | {what} |" for name, default, what in rows(kind)]
    return "\n".join(lines)


def rows(kind: type, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield (name, default, explanation) of every option; a group of options is spread out under its name."""
    explained, types = field_docstrings(kind), get_type_hints(kind)
    for each in fields(kind):
        own = types[each.name]
        if is_dataclass(own) and each.name != "imu_noise":
            yield from rows(own, f"{prefix}{each.name}.")
        else:
            yield f"{prefix}{each.name}", default_text(each), explained.get(each.name, "").replace("|", r"\|")


def default_text(each: Field[Any]) -> str:
    """Return a default as code; a word for what must be given."""
    if isinstance(each.default, Path):
        return f"`{each.default}`"
    if each.default is not MISSING:
        return f"`{each.default!r}`"
    return "required" if each.default_factory is MISSING else f"`{each.default_factory()!r}`"


def field_docstrings(kind: type) -> dict[str, str]:
    """Return the docstring under each field, also of the classes it inherits from."""
    found: dict[str, str] = {}
    for parent in reversed(kind.__mro__[:-1]):
        body = ast.parse(inspect.getsource(parent)).body[0].body
        for field, after in pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                found[field.target.id] = " ".join(str(after.value.value).split())
    return found


def summary(kind: type) -> str:
    """Return the first sentence of a class's docstring."""
    return " ".join((kind.__doc__ or "").strip().split("\n\n")[0].split())
