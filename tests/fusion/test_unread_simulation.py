"""What `simulate` refuses as unread changes no number of the log, and what changes one is not refused."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from functools import reduce

import numpy as np
import pytest

from fusion.detection_errors import NetworkErrors
from fusion.simulate import SimulationOptions, simulate
from fusion.simulation_options import Displacement, refuse_unread
from poet_loc.core.input_error import InputError

GROUPS = ("white", "network", "moved")
SHORT = SimulationOptions(duration_s=3.0, imu_rate_hz=50.0, camera_rate_hz=10.0, objects=4)


def with_other(options: SimulationOptions, name: str) -> SimulationOptions:
    group, _, option = name.rpartition(".")
    if not group:
        return replace(options, **{option: 1.2 * getattr(options, option)})
    inside = getattr(options, group)
    value = getattr(inside, option)
    return replace(options, **{group: replace(inside, **{option: 1.2 * value if 0.0 < value < 1e9 else 0.3})})


def names() -> list[str]:
    plain = [each.name for each in fields(SHORT) if each.name.startswith(("camera_pose_", "odometry_"))]
    inside = [f"{group}.{each.name}" for group in GROUPS for each in fields(getattr(SHORT, group))]
    assert all(is_dataclass(getattr(SHORT, group)) for group in GROUPS)
    return [
        *plain,
        "stated_share",
        "gyroscope_bias_sigma",
        "accelerometer_bias_sigma",
        *(n for n in inside if n != "moved.object"),
    ]


def is_refused(base: SimulationOptions, name: str) -> bool:
    try:
        refuse_unread(with_other(base, name))
    except InputError as error:
        return name.replace("_", "-") in error.what
    return False


def numbers(options: SimulationOptions) -> np.ndarray:
    log = simulate(options)
    poses = [*log.object_poses.values()]
    parts = [log.imu.specific_force, log.imu.angular_velocity, *(each.T_cam_obj.as_matrix() for each in poses)]
    parts += [each.covariances for each in poses if each.covariances is not None]
    parts += [] if log.camera_poses is None else [log.camera_poses.T_world_cam.as_matrix()]
    parts += [] if log.camera_poses is None else [log.camera_poses.covariances]
    parts += [] if log.T_odom_cam is None else [log.T_odom_cam.T_world_body.as_matrix()]
    return np.concatenate([part.ravel() for part in parts])


CHOICES = {
    "network": SHORT,
    "white": replace(SHORT, noise="white"),
    "exact": replace(SHORT, noise="none", imu_errors=False),
    "exact with covariances": replace(SHORT, noise="none", covariances=True),
    "no symmetry, no gross errors": replace(SHORT, symmetric_objects=0, network=NetworkErrors(gross_share=0.0)),
    "everything": replace(SHORT, moved=Displacement(1, after_s=1.0), camera_poses=True, odometry=True),
}


@pytest.mark.parametrize("choice", CHOICES)
def test_what_is_refused_changes_no_number(choice):
    base = CHOICES[choice]
    refused = [name for name in names() if is_refused(base, name)]
    assert len(refused) > (2 if choice == "everything" else 5)
    np.testing.assert_array_equal(numbers(reduce(with_other, refused, base)), numbers(base))


FELT = {
    "network": ["network.across_m", "network.gross_run_s", "network.correlation_time_s", "gyroscope_bias_sigma"],
    "white": ["white.across_m", "white.rotation_deg", "stated_share"],
    "exact with covariances": ["white.along_of_depth"],
    "everything": [
        "moved.distance",
        "moved.until_s",
        "stated_share",
        "camera_pose_position_sigma_m",
        "odometry_position_drift",
    ],
}


@pytest.mark.parametrize("choice", FELT)
def test_what_changes_the_log_is_not_refused(choice):
    base = CHOICES[choice]
    for name in FELT[choice]:
        assert not is_refused(base, name), name
        assert not np.array_equal(numbers(with_other(base, name)), numbers(base)), name
