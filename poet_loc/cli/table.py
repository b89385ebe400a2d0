"""poet-loc table: the localisation table of one log or several."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from landmarks.options import MODES, Mode
from poet_loc.cli.arguments import Flat, refuse_overwrite_without, refuse_twice
from poet_loc.cli.estimates import FUSIONS, Fusion, StageOptions, estimate_log, refuse_one_estimator, steps
from poet_loc.cli.noise_file import with_noise_from
from poet_loc.cli.sensitivity_table import sensitivity_rows, sensitivity_tables, sensitivity_text
from poet_loc.cli.terminal import Report, print_tables, progress
from poet_loc.cli.unread import refuse_unread
from poet_loc.core.input_error import InputError
from poet_loc.io.log_folder import Log, read_log
from poet_loc.io.whole_folder import folder_is_there, write_whole_file
from poet_loc.report.error_tables import Block, consistency_table, error_table, table_text
from poet_loc.report.evaluate import Evaluation, pool
from poet_loc.report.summary import to_summary

Format = Literal["rich", "md", "latex", "csv", "json"]

_OF_SUFFIX: dict[str, Format] = {".md": "md", ".tex": "latex", ".csv": "csv", ".json": "json"}


@dataclass(frozen=True)
class Arguments:
    """The localisation table: detections x modes, pooled over the frames of all logs and log by log."""

    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
    """Log folders with ground truth."""
    detections: tuple[str, ...] = ()
    """Only these sets of detections; none: all that the logs have."""
    modes: tuple[Mode, ...] = MODES
    """Modes of the solver, one row each."""
    with_fusion: bool = False
    """Also fuse, and add a row for each of --fusions."""
    fusions: tuple[Fusion, ...] = FUSIONS
    """Estimators and what they fuse."""
    noise_from: Path | None = None
    """Noise and bias of the detections from this file, as fit-noise writes it."""
    sensitivity: bool = False
    """Instead: how the errors of the modes depend on the solver's options, one changed at a time."""
    pooled_only: bool = False
    """Leave the logs one by one out."""
    format: Format | None = None
    """How it is written; none: as --out ends, else for the terminal, and as markdown into a pipe."""
    out: Path | None = None
    """Write it to this file instead of printing it."""
    overwrite: bool = False
    """Replace the file."""
    options: Flat[StageOptions] = field(default_factory=StageOptions)


def execute(arguments: Arguments) -> None:
    """Compute the table and print or write it."""
    refuse_twice(arguments.logs)
    refuse_overwrite_without(arguments.out, "--out", arguments.overwrite)
    refuse_one_estimator(arguments.options.fusion)
    form = _form(arguments)
    logs = [read_log(path) for path in arguments.logs]
    _refuse_unread(arguments, logs)
    fusion = with_noise_from(arguments.noise_from, arguments.options.fusion)
    arguments = replace(arguments, options=replace(arguments.options, fusion=fusion))
    if arguments.sensitivity:
        rows = sensitivity_rows(logs, detection_sets(logs, arguments.detections))
        tables, text = sensitivity_tables(rows), partial(sensitivity_text, rows)
    else:
        blocks = _blocks(logs, arguments)
        tables, text = [error_table(blocks), consistency_table(blocks)], partial(table_text, blocks)
    if form == "rich":
        print_tables([table for table in tables if table.rows], rich=True)
    elif arguments.out is None:
        print(text(form), end="")
    else:
        write_whole_file(arguments.out, [text(form)])
        print(arguments.out)


def _refuse_unread(arguments: Arguments, logs: Sequence[Log]) -> None:
    """Raise InputError for options of what this table does not show."""
    if arguments.sensitivity and (arguments.with_fusion or arguments.modes != MODES):
        raise InputError("--sensitivity changes the solver's options itself", fix="leave --with-fusion and --modes out")
    if arguments.sensitivity and arguments.options != StageOptions():
        raise InputError("--sensitivity takes no options of the stages", fix="leave them out")
    if arguments.fusions != FUSIONS and not arguments.with_fusion:
        raise InputError("--fusions changes nothing without --with-fusion", fix="add it")
    fusions = arguments.fusions if arguments.with_fusion else ()
    refuse_unread(arguments.options, logs, arguments.modes, fusions, arguments.detections, arguments.noise_from)


def _form(arguments: Arguments) -> Format:
    form, out = arguments.format, arguments.out
    if out is None:
        return form or ("rich" if sys.stdout.isatty() else "md")
    if out.exists() and not arguments.overwrite:
        raise InputError("exists already", path=out, fix="choose another --out or pass --overwrite")
    folder_is_there(out)
    form = form or _OF_SUFFIX.get(out.suffix)
    if form is None or form == "rich":
        raise InputError("no format for this file", path=out, fix="pass --format md, latex, csv or json")
    return form


def _blocks(logs: Sequence[Log], arguments: Arguments) -> list[Block]:
    labels = log_labels(arguments.logs)
    sets = detection_sets(logs, arguments.detections)
    fusions = arguments.fusions if arguments.with_fusion else ()
    jobs = [(log, label, name) for name in sets for log, label in zip(logs, labels, strict=True) if _has(log, name)]
    found: dict[str | None, list[tuple[str, Evaluation]]] = {name: [] for name in sets}
    with progress(len(jobs) * steps(arguments.modes, fusions)) as report:
        for log, label, name in jobs:
            named = _Named(report, f"{label} {name or ''}")
            evaluation = estimate_log(log, name, arguments.options, named, arguments.modes, fusions).evaluation
            if evaluation is not None:
                found[name].append((label, evaluation))
    blocks = list(_blocks_of(found, len(logs), arguments.pooled_only))
    if not blocks:
        raise InputError("no log has ground truth", fix="a table of errors needs T_world_cam.tum or T_world_imu.tum")
    return blocks


def _blocks_of(found: dict[str | None, list[tuple[str, Evaluation]]], logs: int, pooled_only: bool) -> Iterator[Block]:
    """Yield a pooled block per set of detections, then one per log and set."""
    if logs > 1:
        for name, evaluations in found.items():
            if evaluations:
                pooled = pool(evaluation for _, evaluation in evaluations)
                yield Block(to_summary(pooled), name or "", f"all {len(evaluations)} logs")
    if logs == 1 or not pooled_only:
        for name, evaluations in found.items():
            for label, evaluation in evaluations:
                yield Block(to_summary(evaluation), name or "", label if logs > 1 else "")


def detection_sets(logs: Sequence[Log], wanted: Sequence[str]) -> list[str | None]:
    """Return the names of the sets of detections to take; None for logs that only bring camera poses.

    Raises InputError for a wanted set that no log has.
    """
    there: list[str | None] = list(dict.fromkeys(name for log in logs for name in sorted(log.object_poses)))
    for name in wanted:
        if name not in there:
            known = ", ".join(repr(each) for each in there) or "none"
            raise InputError(f"no log has detections named '{name}'", fix=f"they have {known}")
    if wanted:
        return list(wanted)
    return there + ([None] if any(not log.object_poses for log in logs) else [])


def log_labels(paths: Sequence[Path]) -> list[str]:
    """Return the shortest ends of the paths that tell the logs apart."""
    resolved = [path.resolve() for path in paths]
    for length in range(1, max(len(path.parts) for path in resolved) + 1):
        labels = ["/".join(path.parts[-length:]) for path in resolved]
        if len(set(labels)) == len(set(resolved)):
            return labels
    return [str(path) for path in resolved]


def _has(log: Log, name: str | None) -> bool:
    return not log.object_poses if name is None else name in log.object_poses


@dataclass(frozen=True)
class _Named:
    """A report whose steps say which log they are about."""

    report: Report
    name: str

    def step(self, what: str) -> None:
        self.report.step(f"{self.name}: {what}")

    def note(self, line: str) -> None:
        self.report.note(line)
