"""poet-loc evaluate-poses: object poses against the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat, refuse_overwrite_without
from poet_loc.cli.terminal import print_tables
from poet_loc.core.input_error import InputError
from poet_loc.io.whole_folder import whole_folder
from poet_loc.report.pose_evaluation import evaluate_poses
from poet_loc.report.pose_inputs import EvaluatePosesOptions
from poet_loc.report.pose_tables import pose_tables


@dataclass(frozen=True)
class Arguments:
    """Errors of object poses per class: ADD, ADD-S and their areas, translation, rotation, BOP's recalls."""

    results: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")]
    """BOP results (.csv) or PoET's (.json), one or several beside each other (say, true and predicted boxes)."""
    truth: Path
    """BOP split folder."""
    options: Flat[EvaluatePosesOptions]
    out: Path | None = None
    """Folder for poses.json, poses.md and poses.tex."""
    overwrite: bool = False
    """Replace what is there."""


def execute(arguments: Arguments) -> None:
    """Print the tables, and write them where asked."""
    refuse_overwrite_without(arguments.out, "--out", arguments.overwrite)
    if arguments.options.scene is not None and not any(path.suffix == ".json" for path in arguments.results):
        raise InputError("--scene changes nothing: BOP results tell theirs", fix="leave it out")
    found = evaluate_poses(arguments.results, arguments.truth, arguments.options)
    tables = pose_tables(found)
    print_tables(tables)
    if arguments.out is not None:
        with whole_folder(arguments.out, arguments.overwrite, arguments.results) as folder:
            (folder / "poses.json").write_text(json.dumps([e.to_json() for e in found], indent=1) + "\n")
            (folder / "poses.md").write_text("\n".join(table.markdown() for table in tables))
            (folder / "poses.tex").write_text("\n".join(table.latex() for table in tables))
