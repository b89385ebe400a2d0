"""Options on a command line that change nothing are told, not ignored."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.options import FuseOptions
from landmarks.options import Mode, SolverOptions
from landmarks.unread_options import reader_of
from landmarks.unread_options import refuse_unread as refuse_solver
from poet_loc.cli.estimates import Fusion, StageOptions, with_fusion
from poet_loc.core.input_error import InputError
from poet_loc.core.records import ObjectPoses
from poet_loc.core.unread_options import refuse_unread as refuse
from poet_loc.io.log_folder import Log
from poet_loc.report.evaluate import EvaluateOptions
from poet_loc.report.log_evaluation import references_of

if TYPE_CHECKING:
    from fusion.unread_options import Reader


def refuse_unread(
    stages: StageOptions,
    logs: Sequence[Log],
    modes: Sequence[Mode],
    fusions: Sequence[Fusion],
    detections: Sequence[str] = (),
    noise_from: Path | None = None,
) -> None:
    """Raise InputError for what was asked of solver, fusions and evaluation that none of them reads on any of the logs.

    stages are as they were typed; modes are those that are shown. detections: names of the sets; none: all.
    """
    from fusion.unread_options import refuse_unread as refuse_fusion

    readers = list(_readers(stages.fusion, fusions, logs, detections))
    refuse_fusion(stages.fusion, readers)
    objects = any(reader.options.measurements == "objects" for reader in readers)
    if noise_from is not None and not objects:
        raise InputError("--noise-from changes nothing: no object poses are fused", path=noise_from, fix="leave it out")
    fused = [stages.solver.mode for each in readers if each.options.measurements == "camera" and each.solved][:1]
    if stages.solver.mode != SolverOptions().mode and not fused:
        raise InputError(
            f"the mode {stages.solver.mode} changes nothing: no camera poses of the solver are fused",
            fix="fuse camera poses of a log that brings none, or leave it out",
        )
    refuse_unread_by_solver(stages.solver, logs, [*modes, *fused], detections)
    judged = [log for log in logs if references_of(log)]
    refuse(stages.evaluation, EvaluateOptions(), judged, (), "there is no ground truth")


def refuse_unread_by_solver(
    options: SolverOptions, logs: Sequence[Log], modes: Sequence[Mode], detections: Sequence[str] = ()
) -> None:
    """Raise InputError for an option of the solver that none of these modes reads on any of the logs."""
    readers = [
        reader_of(poses, log.landmark_map, options, mode)
        for log in logs
        if log.landmark_map is not None
        for poses in _sets(log, detections)
        for mode in modes
    ]
    if readers or any(log.camera_poses is not None for log in logs):  # else the stage says what is missing
        refuse_solver(options, readers)


def _sets(log: Log, detections: Sequence[str]) -> list[ObjectPoses]:
    return [poses for name, poses in log.object_poses.items() if not detections or name in detections]


def _readers(
    options: FuseOptions, fusions: Sequence[Fusion], logs: Sequence[Log], detections: Sequence[str]
) -> Iterator[Reader]:
    from fusion.motion_source import motion_of
    from fusion.unread_options import Reader

    for log in logs:
        stated = any(poses.covariances is not None for poses in _sets(log, detections))
        given = None if log.camera_poses is None else log.camera_poses.covariances
        unstated = given is None or not np.isfinite(given).all()
        for fusion in fusions:
            choice = with_fusion(options, fusion)
            yield Reader(choice, motion_of(log, choice), log.camera_poses is None, stated, unstated)
