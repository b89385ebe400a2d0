"""The options of the simulated world: the one home of their defaults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from fusion.detection_errors import NetworkErrors, WhiteErrors
from poet_loc.core import unread_options
from poet_loc.core.input_error import InputError, refuse_other_words, within
from poet_loc.core.records import ImuNoise
from poet_loc.core.unread_options import Rule


@dataclass(frozen=True)
class Displacement:
    """One object that is moved while the log runs; the written map does not know."""

    object: int = -1
    """Which of the objects, counted from 0; -1: none."""
    after_s: float = 30.0
    """When, s from the log's start."""
    until_s: float = float("inf")
    """When it is put back, s from the log's start."""
    distance: float = 0.2
    """How far over the table, in a random direction, m."""
    turn_deg: float = 0.0
    """How far it is turned about the vertical, deg."""


@dataclass(frozen=True)
class SimulationOptions:
    """The world, its sensors and their errors."""

    duration_s: float = 60.0
    """Length of the log, s."""
    rest_s: float = 1.0
    """Time at rest before the flight begins, s."""
    imu_rate_hz: float = 200.0
    """Rate of the IMU, Hz."""
    camera_rate_hz: float = 30.0
    """Rate of the camera and thus of the object poses, Hz."""
    objects: int = 8
    """Objects on the table."""
    symmetric_objects: int = 2
    """How many of them are symmetric: alternately a can (every turn about z) and a box (half turns about z)."""
    seed: int = 0
    """Everything random comes from it."""
    noise: Literal["none", "white", "network"] = "network"
    """Errors of the object poses: none, white with the covariance written, or like a real network's."""
    covariances: bool | None = None
    """Write the object poses' covariances (of the inlier error); None: with white noise only."""
    stated_share: float = 1.0
    """Written covariances, of object and camera poses, state this share of the true 1-sigma."""
    white: WhiteErrors = field(default_factory=WhiteErrors)
    """Errors of `noise` white."""
    network: NetworkErrors = field(default_factory=NetworkErrors)
    """Errors of `noise` network."""
    imu_errors: bool = True
    """Give the IMU white noise and wandering biases; False: exact samples."""
    imu_noise: ImuNoise = field(default_factory=lambda: ImuNoise(1.7e-4, 2.0e-3, 2.0e-5, 3.0e-3, 200.0))
    """Noise densities of the IMU as written to the calibration (its update rate becomes imu_rate_hz)."""
    gyroscope_bias_sigma: float = 0.01
    """1-sigma of the gyroscope's first bias, rad/s."""
    accelerometer_bias_sigma: float = 0.1
    """1-sigma of the accelerometer's first bias, m/s^2."""
    imu_position_in_cam: tuple[float, float, float] = (0.05, -0.02, -0.03)
    """Where the IMU sits in camera axes, m."""
    imu_rotation_in_cam_deg: tuple[float, float, float] = (-85.0, 5.0, 3.0)
    """Rotation vector of T_cam_imu, deg."""
    timeshift_cam_imu_s: float = 0.0
    """t_imu = t_cam + timeshift, written to the calibration, s."""
    stamp_delay_s: float = 0.0
    """Camera stamps are this much later than the exposure and the calibration does not know, s."""
    map_position_sigma_m: float = 0.0
    """1-sigma of the written map's position errors per axis, m; the map then carries its covariance."""
    map_rotation_sigma_deg: float = 0.0
    """1-sigma of the written map's rotation errors per axis, deg."""
    moved: Displacement = field(default_factory=Displacement)
    """An object that is moved on the way."""
    camera_poses: bool = False
    """Also make camera poses at the camera's rate, with white noise and its covariance."""
    camera_pose_position_sigma_m: float = 0.02
    """1-sigma of those camera poses' position per axis, m."""
    camera_pose_rotation_sigma_deg: float = 1.0
    """1-sigma of those camera poses' rotation per axis, deg."""
    odometry: bool = False
    """Also make T_odom_cam, which drifts."""
    odometry_position_drift: float = 0.004
    """Random walk of the odometry's position, m/sqrt(s)."""
    odometry_rotation_drift_deg: float = 0.12
    """Random walk of the odometry's rotation, deg/sqrt(s)."""

    def __post_init__(self) -> None:
        refuse_other_words(self)
        within("[0.5, inf)", self, "duration_s")
        within("(0, inf)", self, "imu_rate_hz", "camera_rate_hz", "stated_share")
        within("[1, inf)", self, "objects")
        within("[-1, inf)", self, "moved.object")
        within("(-inf, inf)", self, "timeshift_cam_imu_s", "stamp_delay_s", "moved.distance", "moved.turn_deg")
        within("(-inf, inf]", self, "moved.after_s", "moved.until_s")
        within("[0, inf)", self, "seed", "symmetric_objects", *_SIZES)
        within("[0, 1]", self, "network.bias_share", "network.correlated_share")
        within("[0, 1)", self, "network.gross_share", "network.flip_share", "network.dropout_share")
        within("(0, inf]", self, "network.correlation_time_s")
        if self.network.bias_share + self.network.correlated_share > 1.0:
            raise InputError("network.bias-share and network.correlated-share add up to more than 1", fix="lower one")
        if self.moved.object >= self.objects:
            what = f"moved.object is {self.moved.object}, and there are {self.objects} objects"
            raise InputError(what, fix="count them from 0")


_SIZES = (
    "rest_s",
    "gyroscope_bias_sigma",
    "accelerometer_bias_sigma",
    "map_position_sigma_m",
    "map_rotation_sigma_deg",
    "camera_pose_position_sigma_m",
    "camera_pose_rotation_sigma_deg",
    "odometry_position_drift",
    "odometry_rotation_drift_deg",
    "white.across_m",
    "white.along_of_depth",
    "white.rotation_deg",
    "network.across_m",
    "network.along_of_depth",
    "network.rotation_deg",
    "network.gross_run_s",
    "network.flip_run_s",
    "network.dropout_run_s",
    "imu_noise.gyroscope_noise_density",
    "imu_noise.accelerometer_noise_density",
    "imu_noise.gyroscope_random_walk",
    "imu_noise.accelerometer_random_walk",
)


def writes_covariances(options: SimulationOptions) -> bool:
    """Tell whether the object poses state their covariances."""
    return options.noise == "white" if options.covariances is None else options.covariances


def refuse_unread(options: SimulationOptions) -> None:
    """Raise InputError for an option that is not at its default although nothing reads it."""
    unread_options.refuse_unread(options, SimulationOptions(), [options], RULES)


def _asked(ask: Callable[[SimulationOptions], Any]) -> Callable[[SimulationOptions], bool]:
    return lambda options: bool(ask(options))


RULES: tuple[Rule[SimulationOptions], ...] = (
    Rule("white.*", "noise white", _asked(lambda o: o.noise == "white" or (o.noise == "none" and o.covariances))),
    Rule("stated_share", "covariances or camera-poses", _asked(lambda o: o.camera_poses or writes_covariances(o))),
    Rule("network.*", "noise network", _asked(lambda o: o.noise == "network")),
    Rule("network.gross_run_s", "network.gross-share", _asked(lambda o: o.network.gross_share)),
    Rule(
        "network.flip_run_s",
        "a network.flip-share of symmetric objects",
        _asked(lambda o: o.network.flip_share and o.symmetric_objects),
    ),
    Rule("network.dropout_run_s", "network.dropout-share", _asked(lambda o: o.network.dropout_share)),
    Rule("gyroscope_bias_sigma accelerometer_bias_sigma", "imu-errors", _asked(lambda o: o.imu_errors)),
    Rule("moved.[!o]*", "moved.object", _asked(lambda o: o.moved.object >= 0)),
    Rule("camera_pose_*", "camera-poses", _asked(lambda o: o.camera_poses)),
    Rule("odometry_*", "odometry", _asked(lambda o: o.odometry)),
)
"""Who reads what."""
