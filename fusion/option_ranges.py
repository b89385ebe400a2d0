"""What the numbers of the estimators' options may be; what is impossible ends in one line, not in a traceback."""

from __future__ import annotations

import math

from poet_loc.core.input_error import InputError, within

RANGES: dict[str, tuple[str, ...]] = {
    "(0, inf)": (
        "noise.rotation_deg",
        "noise.stated_scale",
        "camera_noise.position",
        "camera_noise.rotation_deg",
        "moved.memory_s",
        "imu.noise_scale",
        "odometry.rotation_walk_deg",
        "odometry.translation_walk",
        "constant_velocity.acceleration",
        "constant_velocity.angular_acceleration",
        "constant_velocity.rate_hz",
        "graph.keyframe_rate_hz",
        "graph.idle_s",
        "graph.kernel_width",
    ),
    "(0, inf]": (
        "bias.correlation_across_s",
        "bias.correlation_along_s",
        "bias.correlation_rotation_s",
        "bias.gross",
        "meeting.lead",
        "meeting.max_angle_deg",
        "meeting.max_distance",
        "start.lead",
        "start.window_s",
        "start.longest_window_s",
        "start.max_angle_deg",
        "start.max_distance",
        "start.lost_window_s",
        "gap.longest_s",
    ),
    "[0, inf)": (
        "camera_noise.solver_correlation_s",
        "camera_noise.correlation_s",
        "noise.across",
        "noise.along",
        "noise.floor",
        "bias.across",
        "bias.along",
        "bias.rotation_deg",
        "bias.steady_across",
        "bias.steady_along",
        "bias.steady_rotation_deg",
        "bias.scatter_rotation_deg",
        "bias.scatter_across",
        "bias.scatter_along",
        "bias.scatter_exponent",
        "bias.jump",
        "gate.adaptation",
        "prior.attitude_deg",
        "prior.position",
        "prior.velocity",
        "prior.gyroscope_bias",
        "prior.accelerometer_bias",
        "prior.extrinsic_rotation_deg",
        "prior.extrinsic_position",
        "prior.time_offset",
        "prior.gravity_deg",
        "prior.map_position",
        "prior.map_rotation_deg",
        "imu.walk_scale",
        "gap.angular_rate",
        "gap.acceleration",
        "gap.speed",
        "odometry.step_s",
        "graph.lag_s",
        "graph.relinearize",
    ),
    "[0, inf]": (
        "gate.settled",
        "moved.distance",
        "moved.angle_deg",
        "moved.sigmas",
        "moved.scatter",
        "moved.after_s",
        "moved.min_others",
        "meeting.min_span_s",
        "meeting.max_lever",
        "health.coasting_after_s",
        "health.lost_sigma",
        "start.few_span_s",
        "start.min_span_s",
        "start.max_lever",
        "start.max_speed",
        "start.max_camera_speed",
        "start.max_tilt_deg",
        "graph.relinearize_every",
        "graph.rounds",
    ),
    "[1, inf]": (
        "bias.scatter_margin",
        "bias.jump_after",
        "noise.stated_over",
        "gate.max_noise_scale",
        "moved.min_poses",
        "meeting.min_poses",
        "health.lost_refused",
        "start.min_votes",
        "start.few_votes",
        "start.min_objects",
        "start.lost_min_votes",
        "graph.max_iterations",
    ),
    "[0, 2)": ("bias.white_below",),
    "(0, 1]": ("gate.probability",),
    "[0, 1]": ("start.min_share", "start.min_places", "start.lost_share"),
}
"""Every number of `FuseOptions`, by the interval that it must lie in."""


def refuse_impossible(options: object) -> None:
    """Raise InputError for a number of `FuseOptions` outside its range, and for detections without any noise."""
    for interval, names in RANGES.items():
        within(interval, options, *names)
    noise, means = options.noise, options.bias.means  # type: ignore[attr-defined]
    for row in means:
        if not all(map(math.isfinite, row)) or max(map(abs, row[1:4])) > 90.0 or max(map(abs, row[4:])) > 0.5:
            raise InputError(
                f"bias.means of object {row[0]} is {row[1:]}",
                fix="give three angles, at most 90 deg, and three shares of the distance, at most 0.5",
            )
    if len({row[0] for row in means}) < len(means):
        raise InputError("bias.means has an object twice", fix="give each object one mean error")
    if noise.floor + min(noise.across, noise.along) == 0.0:
        raise InputError("noise.floor is 0 and so is another part of the noise", fix="give one of them more than 0")
