"""Options of the solver that nothing reads, with the modes and the detections that there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from landmarks.options import Mode, SolverOptions
from poet_loc.core import unread_options
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.core.unread_options import Rule


@dataclass(frozen=True)
class Reader:
    """One set of detections that one mode solves."""

    options: SolverOptions
    stated: float
    """Share of the detections that bring a covariance."""
    twins: bool
    """The map has several objects of one class."""
    unclear: bool
    """It may take the votes to tell which object a detection is, or in which symmetric turn."""


def reader_of(object_poses: ObjectPoses, landmark_map: LandmarkMap, options: SolverOptions, mode: Mode) -> Reader:
    """Return what one mode reads with these detections."""
    given = object_poses.covariances
    stated = 0.0 if given is None else float(np.isfinite(given).all(axis=(-1, -2)).mean())
    classes = [landmark.object_id for landmark in landmark_map]
    known = np.isin(object_poses.object_ids, classes)
    seen = np.stack([object_poses.stamps_ns[known], object_poses.object_ids[known]])
    twins = len(set(classes)) < len(classes)
    doubled = np.unique(seen, axis=1).shape[1] < seen.shape[1]
    symmetric = any(landmark.symmetry is not None for landmark in landmark_map)
    return Reader(replace(options, mode=mode), stated, twins, twins or doubled or symmetric)


def refuse_unread(options: SolverOptions, readers: Sequence[Reader]) -> None:
    """Raise InputError for an option that is not at its default although none of the readers reads it."""
    usual = SolverOptions(mode=options.mode)
    options = SolverOptions(**{each.name: getattr(options, each.name) for each in fields(SolverOptions)})
    unread_options.refuse_unread(options, usual, readers, RULES, "no object poses are localised")


def _mode(*modes: Mode) -> Callable[[Reader], bool]:
    return lambda reader: reader.options.mode in modes


RULES: tuple[Rule[Reader], ...] = (
    Rule(
        "distance angle_deg",
        "the modes out and prev, or with objects that are symmetric or several of one class",
        lambda reader: reader.unclear or reader.options.mode in ("out", "prev"),
    ),
    Rule("tie_rule", "the modes out and prev", _mode("out", "prev")),
    Rule("position_average rotation_average vote_weights", "the modes all, out and prev", _mode("all", "out", "prev")),
    Rule("trust_instances", "several objects of one class", lambda reader: reader.twins),
    Rule(
        "noise.[!u]*",
        "detections without covariances",
        lambda reader: reader.stated < 1.0 or not reader.options.noise.use_detections,
    ),
    Rule("noise.use_detections", "detections with covariances", lambda reader: reader.stated > 0.0),
    Rule("gate_probability memory.*", "the mode robust", _mode("robust")),
    Rule("memory.[!e]*", "memory.evidence-s above 0", lambda reader: reader.options.memory.evidence_s > 0.0),
)
"""Who reads what."""
