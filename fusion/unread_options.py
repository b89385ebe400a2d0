"""Options that nothing reads: where a choice of estimator, measurements or motion leaves one without effect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from fusion.motion_source import Kind
from fusion.options import FuseOptions
from fusion.prepare import WITH_IMU, re_estimates
from poet_loc.core import unread_options
from poet_loc.core.unread_options import Rule


@dataclass(frozen=True)
class Reader:
    """One estimate that is to be made with the options."""

    options: FuseOptions
    motion: Kind
    """What moves its state."""
    solved: bool = True
    """Where it fuses camera poses: these are the solver's, not the log's own."""
    stated: bool = True
    """Where it fuses objects: some detections bring a covariance."""
    unstated: bool = True
    """Where it fuses the log's own camera poses: some bring no covariance."""


def refuse_unread(options: FuseOptions, readers: Sequence[Reader]) -> None:
    """Raise InputError for an option that is not at its default although none of the estimates reads it."""
    unread_options.refuse_unread(options, FuseOptions(), readers, RULES, "nothing is fused")


def _estimator(*names: str) -> Callable[[Reader], bool]:
    return lambda reader: reader.options.estimator in names


def _motion(*kinds: Kind) -> Callable[[Reader], bool]:
    return lambda reader: reader.motion in kinds


def _measurements(name: str) -> Callable[[Reader], bool]:
    return lambda reader: reader.options.measurements == name


def _asked(ask: Callable[[FuseOptions], Any]) -> Callable[[Reader], bool]:
    return lambda reader: bool(ask(reader.options))


_OF_OBJECTS = (
    "noise.* bias.* moved.* meeting.* estimate.map prior.map_* start.min_objects start.min_places start.max_speed"
)

RULES: tuple[Rule[Reader], ...] = (
    Rule("graph.*", "the estimators graph and batch", _estimator("graph", "batch")),
    Rule("graph.gnc graph.max_iterations graph.rounds", "the estimator batch", _estimator("batch")),
    Rule("graph.lag_s graph.relinearize*", "the estimator graph", _estimator("graph")),
    Rule("graph.relinearize", "a graph with relinearize-every", _asked(lambda o: o.graph.relinearize_every > 0)),
    Rule("graph.kernel_width", "a kernel, or gnc", _asked(lambda o: o.graph.kernel != "none" or o.graph.gnc)),
    Rule("moved.then", "the estimator eskf", _estimator("eskf")),
    Rule("moved.[!r]*", "moved.release", _asked(lambda o: o.moved.release)),
    Rule(_OF_OBJECTS, "--measurements objects", _measurements("objects")),
    Rule("camera_noise.* start.max_camera_speed", "--measurements camera", _measurements("camera")),
    Rule("camera_noise.solver_correlation_s", "camera poses of the solver", lambda reader: reader.solved),
    Rule("camera_noise.[!s]*", "camera poses of the log's own", lambda reader: not reader.solved),
    Rule("camera_noise.position camera_noise.rotation_deg", "camera poses without covariance", lambda r: r.unstated),
    Rule("noise.stated_*", "detections with covariances", lambda reader: reader.stated),
    Rule("bias.[!u]* noise.stated_over", "bias.use", _asked(lambda o: o.bias.use)),
    Rule("gate.max_noise_scale", "a gate with adaptation", _asked(lambda o: o.gate.adaptation > 0.0)),
    Rule("meeting.*", "an unknown estimate.map", _asked(lambda o: o.estimate.map == "unknown" or re_estimates(o))),
    Rule("meeting.replace", "an unknown estimate.map", _asked(lambda o: o.estimate.map == "unknown")),
    Rule("prior.map_*", "an approximate estimate.map", _asked(lambda o: o.estimate.map == "approximate")),
    Rule("prior.extrinsic_*", "estimate.extrinsics", _asked(lambda o: o.estimate.extrinsics)),
    Rule("prior.time_offset", "estimate.time-offset", _asked(lambda o: o.estimate.time_offset)),
    Rule("prior.gravity_deg", "estimate.gravity", _asked(lambda o: o.estimate.gravity)),
    Rule("imu.* gap.acc* prior.*_bias start.max_tilt_deg start.min_places", "an IMU", _motion(*WITH_IMU)),
    Rule("gap.*", "an IMU or odometry", _motion(*WITH_IMU, "odometry")),
    Rule("prior.velocity", "another motion than odometry", _motion(*WITH_IMU, "constant-velocity")),
    Rule("odometry.* gap.speed", "odometry", _motion("odometry", "imu+odometry")),
    Rule("odometry.step_s", "odometry beside an IMU", _motion("imu+odometry")),
    Rule("constant_velocity.*", "the motion constant-velocity", _motion("constant-velocity")),
    Rule(
        "start.min_votes start.few_* start.min_share start.min_objects start.min_places start.min_span_s",
        "a start without start.pose",
        _asked(lambda o: o.start.pose is None),
    ),
)
"""Who reads what."""
