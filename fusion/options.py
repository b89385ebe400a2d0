"""The options of the estimators: the one home of their defaults."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from fusion.option_ranges import refuse_impossible
from poet_loc.core.input_error import InputError, refuse_other_words


@dataclass(frozen=True)
class DetectionNoise:
    """White noise of object poses that bring no covariance of their own: aligned with the viewing ray."""

    across: float = 0.005
    """1-sigma across the ray, as a share of the distance."""
    along: float = 0.018
    """1-sigma along the ray, as a share of the distance."""
    floor: float = 0.006
    """1-sigma of position in every direction beside that, m: what stays of the error near an object."""
    rotation_deg: float = 3.0
    """1-sigma of rotation per axis, deg."""
    stated_scale: float = 1.1
    """The 1-sigma that a detection states of itself is taken so many times larger. It is of the whole error: split into
    white noise and biases by the shares that these options and those of the biases give, object by object."""
    stated_over: int = 100
    """So many of an object's detections make the mean by which its biases are larger or smaller than the options'."""


@dataclass(frozen=True)
class CameraNoise:
    """White noise of camera poses that bring no covariance of their own."""

    position: float = 0.03
    """1-sigma of position per axis, m."""
    rotation_deg: float = 2.0
    """1-sigma of rotation per axis, deg."""
    solver_correlation_s: float = 2.4
    """The errors of the solver's own poses last so long, s. A filter that takes them for white believes itself too
    much, so their 1-sigma is larger by about the square root of twice that time in poses: by 12 at 30 Hz. 0: white."""
    correlation_s: float = 0.0
    """The same of the log's own camera poses (of a relocaliser, PnP, another SLAM), s; online, feed wider ones."""


@dataclass(frozen=True)
class DetectionBias:
    """What a pose network gets wrong for seconds and longer: two bias states per object, in camera axes.

    Measured on real networks (`poet-loc fit-noise`): of the error that is no gross error about a fifth is white, the
    rest is correlated over seconds or stays for a whole sequence.
    """

    use: bool = True
    """Estimate a bias per object."""
    across: float = 0.006
    """1-sigma across the ray, as a share of the distance."""
    along: float = 0.025
    """1-sigma along the ray, as a share of the distance."""
    rotation_deg: float = 2.5
    """1-sigma of rotation per axis, deg."""
    correlation_across_s: float = 4.0
    """Correlation time of its part across the ray, s."""
    correlation_along_s: float = 4.0
    """Of its part along the ray, s."""
    correlation_rotation_s: float = 12.0
    """Of its rotation, s: networks turn an object wrong for as long as it is seen from about the same side."""
    steady_across: float = 0.010
    """1-sigma of a second bias that never changes, across the ray, as a share of the distance; 0: no such bias."""
    steady_along: float = 0.020
    """The same along the ray."""
    steady_rotation_deg: float = 3.0
    """The same in rotation per axis, deg."""
    means: tuple[tuple[int, float, float, float, float, float, float], ...] = ()
    """What is known of the steady one, and taken off the detections: for each object its id and the mean error of its
    rotation x y z, deg in camera axes, and of its place across the ray x y and along it, shares of the distance.
    `fit-noise` finds it from two logs or more; the steady 1-sigma is then of what is left."""
    scatter_rotation_deg: float = 0.8
    """How much the rotations of an object's detections usually scatter from one to the next, 1-sigma per axis, deg:
    where its own scatter more, its biases are larger, where less, smaller (`fit-noise` finds it); 0: not known."""
    scatter_across: float = 0.002
    """The same of places across the ray, as a share of the distance,"""
    scatter_along: float = 0.009
    """and along it."""
    scatter_exponent: float = 0.33
    """Biases grow with this power of an object's scatter over the usual, from network to network; within one, with the
    square root, which `fit-noise` writes,"""
    scatter_margin: float = 1.5
    """where it is more than so many times larger or smaller, as what is usual is a guess; `fit-noise` writes 1."""
    jump_after: int = 20
    """An object refused so often in a row has another bias: the old one is forgotten."""
    jump: float = 5.0
    """The new one's 1-sigma, in units of the varying bias's."""
    white_below: float = 1.07
    """Where two objects' detections disagree with the map by no more than so many times what this changes by from frame
    to frame (variances), nothing lasts of their errors, and next to no biases are looked for; from twice as much on
    biases are as large as said here, between in proportion (`fusion/lasting_share.py`); 0: always as said here."""
    gross: float = 5.0
    """A varying bias beyond so many sigma is a gross error in a run: it does not fade, it jumps."""


@dataclass(frozen=True)
class Gate:
    """What is refused."""

    probability: float = 0.99
    """Share of good measurements that pass; 1 switches the gate off."""
    partial: Literal["none", "position", "both"] = "position"
    """Use the position of a detection whose rotation is refused; both: and the rotation of one whose position is."""
    settled: float = 0.02
    """While the position is less sure than this 1-sigma per axis, m, what fits best at a stamp is taken in first, and
    the position of a grossly turned detection is refused: that of a flipped one is wrong too, and the gate is wide."""
    adaptation: float = 0.06
    """How fast noise that is larger than stated widens what was stated (`fusion/noise_scale.py`): from a pose whose
    innovation is beyond the lower quartile of what was expected, the 1-sigma of all poses grows by an eighth of this,
    from any other it falls by three eighths (the first poses of all count more); 0: not at all."""
    max_noise_scale: float = 10.0
    """Largest factor of the 1-sigma that this may reach."""


@dataclass(frozen=True)
class Moved:
    """An object that stands elsewhere than the map says, while all others agree, is released from the map.

    It is told from a network's gross errors by standing still in the world while the camera moves, and from its biases
    by their size. A released object corrects nothing, and one that was turned where it stands only by its position,
    until it is found at its place in the map again.
    """

    release: bool = True
    """Release objects that were moved."""
    then: Literal["leave-out", "re-estimate"] = "leave-out"
    """re-estimate (eskf): where a released object stands still, its pose is estimated anew as that of an unknown
    object, and the objects' poses are states from the start on."""
    distance: float = 0.05
    """An object has been moved where the mean of its detections is further off the map than this, m,"""
    angle_deg: float = 15.0
    """or turned by more than this, deg,"""
    sigmas: float = 5.0
    """and by more 1-sigma of noise and biases than this,"""
    scatter: float = 0.5
    """and the detections scatter about that mean by less than this share of it,"""
    after_s: float = 3.0
    """all this for so long, s,"""
    seen_at_home: bool = True
    """provided that it was where the map says for as long before; what never was is left to the gate;"""
    min_others: int = 2
    """while at least so many others are where they belong, and at least as many as are not."""
    memory_s: float = 2.0
    """Time constant of mean and scatter, s."""
    min_poses: int = 10
    """So many detections make a mean."""


@dataclass(frozen=True)
class Meeting:
    """Where an object of an unknown map is put: at a pose that its detections agree on.

    Every pose that it may have is kept with the number of detections that showed it, also after one was chosen: a first
    sight that was flipped or grossly wrong is outnumbered later.
    """

    min_poses: int = 8
    """So many detections must agree on a pose"""
    min_span_s: float = 0.3
    """over so long a time, s,"""
    lead: float = 1.5
    """and be so many times as many as those on any other pose."""
    max_angle_deg: float = 15.0
    """Detections agree within this angle, deg,"""
    max_distance: float = 0.05
    """and this distance, m,"""
    max_lever: float = 0.08
    """plus this share of the object's distance."""
    replace: bool = True
    """Put an object elsewhere when another pose has come to lead by as much; where it is the one that anchors the
    world, start again, all others unknown."""


@dataclass(frozen=True)
class HealthOptions:
    """When an estimator is called coasting or lost."""

    coasting_after_s: float = 0.5
    """Without an accepted pose for so long it is coasting, s;"""
    lost_sigma: float = 0.5
    """coasting, it is lost where the position's 1-sigma along an axis is beyond this, m; so unsure, and refusing all
    that it saw for --start.lost-window-s, it waits for a new start;"""
    lost_refused: int = 60
    """it is lost, too, where so many poses in a row were refused."""


@dataclass(frozen=True)
class Start:
    """When the filter starts and starts again: votes that agree, or the first detection where a pose is given."""

    pose: tuple[float, float, float, float, float, float, float] | None = None
    """Where the IMU (without one, the camera) is in the world at the first detection: x y z, m, and the quaternion
    qx qy qz qw. The filter then starts there, standing still, with the spread of --prior. None: from votes."""
    min_votes: int = 7
    """Votes that must agree before anything is published,"""
    few_votes: int = 4
    """or so many where they span"""
    few_span_s: float = 1.5
    """this time, s: votes of a slow sensor are fewer and worth more, as a network's errors last."""
    min_share: float = 0.3
    """Share of the window's votes that must agree."""
    min_objects: int = 3
    """Where so many objects are where the map says from one pose, however they seem turned, their places will do,"""
    min_places: float = 0.6
    """if this share of the window's detections shows them there."""
    lead: float = 1.2
    """A pose is believed if it has so many times the support of any quite other one."""
    min_span_s: float = 0.26
    """Time that they must span, s; none where two objects agree whole, or min_objects are at their places, and no time
    offset is estimated."""
    window_s: float = 1.0
    """Votes so young count, s."""
    longest_window_s: float = 8.0
    """A slow sensor's votes count for so long, s."""
    max_angle_deg: float = 12.0
    """Votes agree within this angle, deg,"""
    max_distance: float = 0.08
    """and this distance, m,"""
    max_lever: float = 0.04
    """plus this share of the object's distance,"""
    max_speed: float = 0.3
    """plus so much per second between them, m/s,"""
    max_camera_speed: float = 1.0
    """and votes that are camera poses, whose errors tell speeds better, plus so much, m/s."""
    max_tilt_deg: float = 8.0
    """A vote that tilts the measured gravity by more is refused, deg."""
    lost_window_s: float = 4.0
    """The filter is lost if in this time, s (or since its start, where that is less: a wrong one is mended soon),"""
    lost_share: float = 0.2
    """less than this share of the detections was used"""
    lost_min_votes: int = 12
    """and more than so many refused ones agree with each other."""

    def __post_init__(self) -> None:
        if self.pose is None:
            return
        if not all(map(math.isfinite, self.pose)):
            raise InputError(f"start.pose is {self.pose}", fix="give seven finite numbers: x y z qx qy qz qw")
        if abs(math.hypot(*self.pose[3:]) - 1.0) > 1e-3:
            raise InputError(f"start.pose has the rotation {self.pose[3:]}", fix="give a unit quaternion qx qy qz qw")


@dataclass(frozen=True)
class Prior:
    """1-sigma of what is not known at the start."""

    attitude_deg: float = 5.0
    """Attitude, deg."""
    position: float = 0.08
    """Position, m."""
    velocity: float = 0.2
    """Velocity, m/s."""
    gyroscope_bias: float = 0.02
    """Gyroscope bias, rad/s."""
    accelerometer_bias: float = 0.15
    """Accelerometer bias, m/s^2."""
    extrinsic_rotation_deg: float = 3.0
    """Camera-IMU rotation where it is estimated, deg."""
    extrinsic_position: float = 0.03
    """Camera-IMU translation where it is estimated, m."""
    time_offset: float = 0.03
    """Camera-IMU time offset where it is estimated, s."""
    gravity_deg: float = 0.5
    """Direction of gravity where it is estimated, deg."""
    map_position: float = 0.05
    """Landmark position of an approximate map without covariances, m."""
    map_rotation_deg: float = 5.0
    """Landmark rotation of an approximate map without covariances, deg per axis."""


@dataclass(frozen=True)
class Estimate:
    """What is estimated beside motion and IMU biases."""

    extrinsics: bool = False
    """Where the camera sits on the IMU."""
    time_offset: bool = False
    """The camera's time offset against the IMU, beside the calibration's; a whole log begins at what its turn rates say
    where they contradict the calibration, online begins at the calibration's."""
    gravity: bool = False
    """The direction of gravity in the world."""
    map: Literal["known", "approximate", "unknown"] = "known"
    """Object poses: known as they are in the map; approximate: the map with its covariances (or the priors below);
    unknown: only that of the first object seen, which anchors the world, the others where they are first seen. Without
    landmarks.json the anchor stands at the origin, upright by the IMU, and gravity's direction is estimated too."""


@dataclass(frozen=True)
class Odometry:
    """How odometry drifts, in place of an IMU or beside it: measured on visual odometry (ORB-SLAM3) of YCB-V."""

    rotation_walk_deg: float = 0.25
    """deg per square root of a second, per axis."""
    translation_walk: float = 0.005
    """m per square root of a second, per axis."""
    step_s: float = 0.3
    """Beside an IMU: each relative pose reaches back so far at least, s."""


@dataclass(frozen=True)
class Imu:
    """How far the IMU's noise in calibration.yaml is to be believed: data sheets know an IMU at rest."""

    measured: bool = True
    """Take the noise densities at least as large as the samples themselves show, by the mean square of their fourth
    differences over the last seconds: aloft that may be ten and fifty times the data sheet's."""
    noise_scale: float = 1.0
    """The stated noise densities are taken so many times larger."""
    walk_scale: float = 1.0
    """The biases' random walks likewise."""


@dataclass(frozen=True)
class ConstantVelocity:
    """How a camera moves of which nothing is known, where neither IMU nor odometry is there.

    What a hand or a small drone does, and more: measured are 0.03 to 0.07 and 0.06 to 0.18 by hand on YCB-V's training
    videos, 0.2 and 0.3 aloft on EuRoC.
    """

    acceleration: float = 0.3
    """m/s^2 per square root of Hz."""
    angular_acceleration: float = 0.6
    """rad/s^2 per square root of Hz."""
    rate_hz: float = 60.0
    """Steps per second, Hz."""


@dataclass(frozen=True)
class Gap:
    """How an interruption of the IMU or of odometry is bridged: what a camera may do that nobody sees."""

    longest_s: float = 0.1
    """An interval longer than this is a gap, s; of odometry it is longer than three times what most are too."""
    angular_rate: float = 0.5
    """1-sigma of the angular rate inside a gap, rad/s."""
    acceleration: float = 2.0
    """1-sigma of the acceleration inside a gap of the IMU, m/s^2."""
    speed: float = 0.3
    """1-sigma of the speed per axis inside a gap of odometry, m/s."""


@dataclass(frozen=True)
class Graph:
    """The factor graph."""

    keyframe_rate_hz: float = 10.0
    """Keyframes at camera stamps, at most so many per second, Hz; measurements between them are kept."""
    idle_s: float = 0.5
    """Without measurements there is a keyframe after so long, s."""
    lag_s: float = 2.0
    """How far back the fixed-lag smoother still changes its mind, s."""
    kernel: Literal["none", "huber", "cauchy"] = "huber"
    """Robust kernel of the measurements that passed the gate: huber leaves good ones their whole weight."""
    kernel_width: float = 3.5
    """Where it begins to bend, in 1-sigma of all six rows."""
    gnc: bool = False
    """The batch does not begin with what passed the filter's gate, but finds by graduated non-convexity what the most
    measurements agree on, those beyond kernel_width cut off; for logs on which the filter follows gross errors."""
    relinearize_every: int = 0
    """The fixed-lag smoother linearises anew once in so many keyframes; 0: never, each factor once, at the prediction.

    Where old keyframes are marginalised, first estimates keep what cannot be observed unobservable: more accurate on
    real logs.
    """
    relinearize: float = 0.01
    """It linearises anew what has moved by more, rad and m."""
    max_iterations: int = 20
    """Steps of the batch optimiser."""
    rounds: int = 3
    """How often the batch decides anew, from its own trajectory, which measurements pass the gate."""


@dataclass(frozen=True)
class FuseOptions:
    """Camera or object poses and an IMU become a trajectory."""

    estimator: Literal["eskf", "graph", "batch"] = "eskf"
    """eskf: error-state Kalman filter; graph: fixed-lag smoother; batch: the whole log at once."""
    smooth: bool = False
    """eskf: let every state know the whole log; not causal, and named fuse/eskf-smoothed."""
    measurements: Literal["camera", "objects"] = "objects"
    """camera: the solver's (or the log's own) camera poses; objects: each object's pose directly."""
    motion: Literal["auto", "imu", "odometry", "imu+odometry", "constant-velocity"] = "auto"
    """What carries the state between measurements; auto: the IMU, with the log's odometry beside it where there is
    one, else the odometry, else constant velocity.

    imu+odometry: the IMU carries it, and the odometry's relative poses are measurements: against a cloned pose in the
    eskf, between keyframes in the graph.
    """
    noise: DetectionNoise = field(default_factory=DetectionNoise)
    camera_noise: CameraNoise = field(default_factory=CameraNoise)
    bias: DetectionBias = field(default_factory=DetectionBias)
    gate: Gate = field(default_factory=Gate)
    moved: Moved = field(default_factory=Moved)
    meeting: Meeting = field(default_factory=Meeting)
    health: HealthOptions = field(default_factory=HealthOptions)
    start: Start = field(default_factory=Start)
    prior: Prior = field(default_factory=Prior)
    estimate: Estimate = field(default_factory=Estimate)
    imu: Imu = field(default_factory=Imu)
    gap: Gap = field(default_factory=Gap)
    odometry: Odometry = field(default_factory=Odometry)
    constant_velocity: ConstantVelocity = field(default_factory=ConstantVelocity)
    graph: Graph = field(default_factory=Graph)

    def __post_init__(self) -> None:
        refuse_other_words(self)
        refuse_impossible(self)
