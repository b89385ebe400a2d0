"""Options on a command line that change nothing are told, not ignored."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fusion.options import FuseOptions
from landmarks.options import Mode, SolverOptions
from poet_loc.cli.estimates import Fusion, with_fusion
from poet_loc.core.input_error import InputError
from poet_loc.io.log_folder import Log

if TYPE_CHECKING:
    from fusion.unread_options import Reader


def refuse_unread(
    options: FuseOptions,
    fusions: Sequence[Fusion],
    logs: Sequence[Log],
    mode: Mode = "robust",
    noise_from: Path | None = None,
    detections: str | None = None,
) -> None:
    """Raise InputError for what was asked of fusions that none of them reads on any of the logs.

    options are as they were typed; mode is that of the solver whose camera poses are fused.
    """
    from fusion.unread_options import refuse_unread as refuse

    readers = list(_readers(options, fusions, logs, detections))
    refuse(options, readers)
    objects = any(reader.options.measurements == "objects" for reader in readers)
    if noise_from is not None and not objects:
        raise InputError("--noise-from changes nothing: no object poses are fused", path=noise_from, fix="leave it out")
    solved = any(reader.options.measurements == "camera" and reader.solved for reader in readers)
    if mode != SolverOptions().mode and not solved:
        raise InputError(
            f"the mode {mode} changes nothing: no camera poses of the solver are fused",
            fix="fuse camera poses of a log that brings none, or leave it out",
        )


def _readers(
    options: FuseOptions, fusions: Sequence[Fusion], logs: Sequence[Log], detections: str | None
) -> Iterator[Reader]:
    from fusion.motion_source import motion_of
    from fusion.unread_options import Reader

    for log in logs:
        named = [poses for name, poses in log.object_poses.items() if detections in (None, name)]
        stated = any(poses.covariances is not None for poses in named)
        for fusion in fusions:
            choice = with_fusion(options, fusion)
            yield Reader(choice, motion_of(log, choice), log.camera_poses is None, stated)
