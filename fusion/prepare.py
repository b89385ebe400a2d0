"""From a log and options to what the filter reads: measurements, layout, memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion import ballot, filter_update, imu, meeting, memory, object_biases, odometry, place_watch
from fusion.bias_spread import spread_model, white_part
from fusion.imu_noise import imu_rows
from fusion.known_errors import known_errors
from fusion.lasting_share import begin_pairs
from fusion.measurements import CAMERA_POSE, OBJECT_POSE, Measurements, ray_aligned_covariance
from fusion.motion_source import Kind, motion_source, odometry_steps
from fusion.nav_state import ACCEL_BIAS_ERROR, CORE, GYRO_BIAS_ERROR, VELOCITY_ERROR, StateLayout, nominal_state
from fusion.noise_scale import FOLLOWED
from fusion.options import DetectionBias, FuseOptions
from fusion.scatter import LAST_NS, usual_scatter
from poet_loc.core.consistency import chi_square_quantile
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, CameraPoses, ImuNoise, ImuSamples, LandmarkMap, ObjectPoses
from poet_loc.core.stamp_unit import FASTEST_CAMERA_HZ, FASTEST_IMU_HZ, refuse_other_units
from poet_loc.io.log_folder import Log

Array = NDArray[np.float64]

WITH_IMU: tuple[Kind, ...] = ("imu", "imu+odometry")
NEAREST_OBJECT = 1e-3  # m
LEAST_BIAS = 1e-6
"""1-sigma of a bias that is said to be none, rad or share of the distance: errors are measured in it."""
STANDARD_GRAVITY = 9.81  # m/s^2
_LEAST_ANGLE = 1e-6  # rad: below it the cosine is 1
VELOCITY_OF_ODOMETRY = 0.05  # m/s, reported beside the velocity that odometry gives


@dataclass(frozen=True)
class Problem:
    """All that an estimator needs of a log, checked."""

    path: Path
    imu: ImuSamples
    """Samples of the motion: the IMU's, or what stands in their place (`motion_source.MotionSource`)."""
    imu_noise: ImuNoise
    calibration: Calibration
    measurements: Measurements
    layout: StateLayout
    landmark_map: LandmarkMap | None
    motion: Kind = "imu"
    body: Literal["imu", "cam"] = "imu"
    doubts: Array | None = None
    """odometry: what is not known of each sample (`odometry.believed_samples`)."""
    lasting_s: float = 0.0
    """How long the camera poses' errors are taken to last, s: their covariances are so much larger than stated."""

    @property
    def rows(self) -> Array:
        """Samples as the filter reads them (N, 9): `imu_noise.imu_rows`, or odometry's with its doubts."""
        rows = imu_rows(self.imu)
        if self.doubts is not None:
            rows[:, odometry.ROTATION_DOUBT : odometry.TRANSLATION_DOUBT + 1] = self.doubts
        return rows

    @property
    def keys(self) -> list[tuple[int, int]]:
        """(object_id, instance) of each object that a measurement may name."""
        return [] if self.landmark_map is None else [landmark.key for landmark in self.landmark_map]


def pose_problem(
    log: Log, options: FuseOptions, camera_poses: CameraPoses | None = None, object_poses: ObjectPoses | None = None
) -> Problem:
    """Return what the options ask to be fused of a log.

    Raises InputError where motion, calibration, map or poses are missing, or stamps are no nanoseconds.
    """
    calibration = log.calibration or Calibration()
    layout, lasting_s = layout_for(log.landmark_map, options), 0.0
    if options.measurements == "camera":
        poses = camera_poses if camera_poses is not None else log.camera_poses
        if poses is None:
            raise InputError("there are no camera poses to fuse", path=log.path, fix="localize first, or fuse objects")
        noise = options.camera_noise
        lasting_s = noise.correlation_s if camera_poses is None else noise.solver_correlation_s
        measured = camera_measurements(poses, calibration, options, lasting_s)
    else:
        if log.landmark_map is None:
            fix = "fuse camera poses instead (--measurements camera)"
            raise InputError("there is no landmarks.json", path=log.path, fix=fix)
        detections = object_poses if object_poses is not None else log.detections(None)[1]
        measured = object_measurements(detections, log.landmark_map, calibration, options, log.path)
    refuse_other_units(measured.stamps_ns, FASTEST_CAMERA_HZ, log.path)
    if log.imu is not None:
        refuse_other_units(log.imu.stamps_ns, FASTEST_IMU_HZ, log.path / "imu.csv")
    source = motion_source(log, calibration, options, measured)
    if source.kind == "imu+odometry":
        layout = replace(layout, clone=True)
        measured = Measurements.merged(odometry_steps(log, calibration, options), measured)
    if source.kind not in WITH_IMU and options.estimate.gravity:
        raise InputError(f"{source.kind} feels no gravity", fix="do not estimate its direction")
    motion = (source.samples, source.noise, calibration, measured, layout, log.landmark_map, source.kind, source.body)
    return Problem(log.path, *motion, source.doubts, lasting_s)


def landmark_of_detection(poses: ObjectPoses, landmark_map: LandmarkMap) -> NDArray[np.int64]:
    """Return (N,) the landmark each detection names, -1 where the map has none.

    Where a class has one landmark the instance number does not matter.
    """
    found = np.full(len(poses), -1, dtype=np.int64)
    ids = landmark_map.object_ids
    for k, landmark in enumerate(landmark_map):
        same = poses.object_ids == landmark.object_id
        if np.count_nonzero(ids == landmark.object_id) > 1:
            same &= poses.instances == landmark.instance
        found[same] = k
    return found


def object_measurements(
    poses: ObjectPoses,
    landmark_map: LandmarkMap,
    calibration: Calibration,
    options: FuseOptions,
    path: Path | None = None,
) -> Measurements:
    """Return the detections that belong to a landmark, by stamp and landmark, with default noise where they bring none.

    A detection in or behind the image plane (real networks write those when they fail) is left out. Raises InputError,
    with the log's path, where none is left.
    """
    landmark = landmark_of_detection(poses, landmark_map)
    usable = (landmark >= 0) & (poses.T_cam_obj.translation[:, 2] > NEAREST_OBJECT)
    if not usable.any():
        raise InputError(
            f"none of {len(poses)} detections is of an object of the map and in front of the camera",
            path=path,
            fix="z of T_cam_obj points forward, in metres; object ids are those of landmarks.json",
        )
    poses, landmark = poses[usable], landmark[usable]
    order = np.lexsort((landmark, poses.stamps_ns))
    poses, landmark = poses[order], landmark[order]
    noise, known = options.noise, known_errors(options.bias, landmark_map)
    R, t = poses.T_cam_obj.rotation, poses.T_cam_obj.translation
    if known is not None:
        R, t = known.taken_off(landmark, R, t)
    covariances = ray_aligned_covariance(t, noise.across, noise.along, math.radians(noise.rotation_deg), noise.floor)
    if poses.covariances is not None:
        given = np.isfinite(poses.covariances).all(axis=(1, 2))
        covariances[given] = white_part(poses.covariances[given], t[given], noise, options.bias)
    return Measurements(
        poses.stamps_ns + calibration.timeshift_ns,
        np.full(len(poses), OBJECT_POSE, dtype=np.int64),
        landmark,
        R.as_matrix().reshape(-1, 9),
        np.ascontiguousarray(t),
        covariances,
    )


def camera_measurements(
    poses: CameraPoses, calibration: Calibration, options: FuseOptions, lasting_s: float = 0.0
) -> Measurements:
    """Return camera poses as measurements, with the options' noise where they bring none.

    Where their errors are a Gauss-Markov process of this correlation time, s, the variances are so many times larger
    that as many poses, taken for white, tell no more: (1 + phi) / (1 - phi), phi being what is left of an error at the
    next pose.
    """
    noise = options.camera_noise
    sigma = np.r_[np.full(3, math.radians(noise.rotation_deg)), np.full(3, noise.position)]
    covariances = np.tile(np.diag(sigma**2), (len(poses), 1, 1))
    if poses.covariances is not None:
        given = np.isfinite(poses.covariances).all(axis=(1, 2))
        covariances[given] = poses.covariances[given]
    stamps = np.unique(poses.stamps_ns)
    if lasting_s > 0.0 and len(stamps) > 1:
        covariances /= np.tanh(0.5e-9 * np.median(np.diff(stamps)) / lasting_s)
    return Measurements(
        poses.stamps_ns + calibration.timeshift_ns,
        np.full(len(poses), CAMERA_POSE, dtype=np.int64),
        np.full(len(poses), -1, dtype=np.int64),
        poses.T_world_cam.rotation.as_matrix().reshape(-1, 9),
        np.ascontiguousarray(poses.T_world_cam.translation),
        covariances,
    )


def layout_for(landmark_map: LandmarkMap | None, options: FuseOptions) -> StateLayout:
    """Return which states the options ask for."""
    estimate = options.estimate
    objects = options.measurements == "objects" and landmark_map is not None
    return StateLayout(
        n_objects=len(landmark_map) if objects and landmark_map is not None else 0,
        extrinsics=estimate.extrinsics,
        time_offset=estimate.time_offset,
        gravity=estimate.gravity,
        objects=objects and (estimate.map != "known" or re_estimates(options)),
        bias_kinds=_bias_kinds(options.bias) if objects else 0,
    )


def re_estimates(options: FuseOptions) -> bool:
    """Tell whether object poses are states because moved objects are estimated anew."""
    return options.estimator == "eskf" and options.moved.release and options.moved.then == "re-estimate"


def _bias_kinds(bias: DetectionBias) -> int:
    if not bias.use:
        return 0
    return 1 + (max(bias.steady_across, bias.steady_along, bias.steady_rotation_deg) > 0.0)


def fill_memory(problem: Problem, options: FuseOptions) -> tuple[Array, NDArray[np.int64]]:
    """Return the buffers of a filter that has not begun yet."""
    layout, landmark_map, calibration = problem.layout, problem.landmark_map, problem.calibration
    floats, integers = memory.allocate(layout)
    m = memory.views.py_func(floats, integers)
    T_imu_cam = None if calibration.T_cam_imu is None else calibration.T_cam_imu.inv()
    T_world_obj = landmark_map.T_world_obj if layout.n_objects and landmark_map is not None else None
    gravity = STANDARD_GRAVITY if problem.motion in WITH_IMU else 0.0
    m.x[:] = nominal_state(layout, T_imu_cam=T_imu_cam, T_world_obj=T_world_obj, gravity=gravity)
    m.noise[:] = motion_noise(problem, options)
    m.limits[: filter_update.SETTLED + 1] = _limits(options)
    m.start[: ballot.IS_GIVEN] = _start(options)
    if options.start.pose is not None:
        _start_at(options.start.pose, options, m)
    m.spread_model[:] = spread_model(options.noise)
    m.usual_scatter[:] = usual_scatter(options.bias) if layout.bias_kinds else 0.0
    m.scatter[:, :3], m.scatter[:, LAST_NS], m.stated[:] = m.usual_scatter[:3], -math.inf, 1.0
    m.bias_model[:] = _bias_model(options.bias)
    m.moved[: place_watch.MIN_POSES + 1] = _moved(options)
    m.meeting[: meeting.REPLACE + 1] = _meeting(options)
    m.prior[:] = _prior(layout, options)
    _without_imu(problem, options, m)
    if landmark_map is not None and layout.objects and options.estimate.map == "approximate":
        _map_prior(landmark_map, layout, m.prior)
    m.known[:] = 1.0
    if options.estimate.map == "unknown" and layout.n_objects:
        _check_anchor(problem)
        m.known[:] = 0.0
    if landmark_map is not None and layout.n_objects:
        for k, landmark in enumerate(landmark_map):
            if landmark.symmetry is not None:
                m.axes[k] = landmark.symmetry.axis
                m.orders[k] = 0 if landmark.symmetry.order == "continuous" else landmark.symmetry.order
    m.scales[:, :FOLLOWED] = 1.0
    begin_pairs(m, options.bias.white_below)
    return floats, integers


def motion_noise(problem: Problem, options: FuseOptions) -> Array:
    """Return the noise of what carries the filter, in its places (`imu.py`, `odometry.py`)."""
    noise, own, gap, with_imu = np.zeros(12), problem.imu_noise, options.gap, problem.motion in WITH_IMU
    noise[[imu.GYRO_NOISE, imu.ACCEL_NOISE]] = own.gyroscope_noise_density, own.accelerometer_noise_density
    noise[[imu.GYRO_WALK, imu.ACCEL_WALK]] = own.gyroscope_random_walk, own.accelerometer_random_walk
    noise[[imu.GAP_RATE, imu.GAP_ACCEL]] = gap.angular_rate, gap.acceleration
    noise[imu.GAP_S] = gap.longest_s if with_imu else math.inf
    noise[imu.MEASURED], noise[imu.GUESSED] = options.imu.measured and with_imu, problem.motion == "constant-velocity"
    if problem.motion == "odometry":
        noise[odometry.IS_ODOMETRY] = 1.0
        noise[odometry.ROTATION_WALK] = math.radians(options.odometry.rotation_walk_deg)
        noise[odometry.TRANSLATION_WALK] = options.odometry.translation_walk
    return noise


def _without_imu(problem: Problem, options: FuseOptions, m: memory.Memory) -> None:
    """Change what an IMU has and another source of motion has not."""
    if problem.motion in WITH_IMU:
        return
    m.start[ballot.MAX_TILT] = math.pi
    m.prior[GYRO_BIAS_ERROR:CORE] = 1e-9
    if problem.motion == "constant-velocity":
        m.prior[GYRO_BIAS_ERROR:ACCEL_BIAS_ERROR] = math.radians(60.0)  # minus the angular velocity
        return
    m.prior[VELOCITY_ERROR:GYRO_BIAS_ERROR] = VELOCITY_OF_ODOMETRY


def _map_prior(landmark_map: LandmarkMap, layout: StateLayout, sigma: Array) -> None:
    """Put the landmarks' own covariances into the prior: rotation in object axes, position in world axes."""
    for k, landmark in enumerate(landmark_map):
        if landmark.covariance is not None:
            R_world_obj = landmark.T_world_obj.rotation.as_matrix()
            position = R_world_obj @ landmark.covariance[3:, 3:] @ R_world_obj.T
            variances = np.r_[np.diag(landmark.covariance)[:3], np.diag(position)]
            sigma[layout.error_slice("objects", k)] = np.sqrt(variances)


def _check_anchor(problem: Problem) -> None:
    """Raise InputError where no object could anchor a world whose map is unknown (`meeting.choose_anchor`).

    Online, where nothing has been seen yet, any object of the map may be.
    """
    landmarks = [] if problem.landmark_map is None else list(problem.landmark_map)
    seen = np.unique(problem.measurements.objects[problem.measurements.kinds == OBJECT_POSE])
    if all(landmarks[k].symmetry is not None for k in (seen if len(seen) else range(len(landmarks)))):
        raise InputError("no object without symmetry is seen, so none can anchor the world", path=problem.path)


def _limits(options: FuseOptions) -> list[float]:
    gate = options.gate
    both, half = (float(chi_square_quantile(gate.probability, freedom)) for freedom in (6, 3))
    return [
        both,
        half,
        half,
        float(("none", "position", "both").index(gate.partial)),
        gate.adaptation,
        gate.max_noise_scale,
        options.bias.jump_after,
        3.0 * gate.settled**2,
    ]


def _bias_model(bias: DetectionBias) -> list[float]:
    varying = {
        object_biases.BIAS_ROTATION: max(math.radians(bias.rotation_deg), LEAST_BIAS),
        object_biases.BIAS_ACROSS: max(bias.across, LEAST_BIAS),
        object_biases.BIAS_ALONG: max(bias.along, LEAST_BIAS),
        object_biases.BIAS_TAU + object_biases.BIAS_ROTATION: bias.correlation_rotation_s,
        object_biases.BIAS_TAU + object_biases.BIAS_ACROSS: bias.correlation_across_s,
        object_biases.BIAS_TAU + object_biases.BIAS_ALONG: bias.correlation_along_s,
        object_biases.BIAS_JUMP: bias.jump,
        object_biases.BIAS_JUMP_AT: bias.gross,
    }
    steady = {
        object_biases.BIAS_ROTATION: max(math.radians(bias.steady_rotation_deg), LEAST_BIAS),
        object_biases.BIAS_ACROSS: max(bias.steady_across, LEAST_BIAS),
        object_biases.BIAS_ALONG: max(bias.steady_along, LEAST_BIAS),
    }
    steady |= {object_biases.BIAS_TAU + i: math.inf for i in range(3)}
    return [model.get(i, 0.0) for model in (varying, steady) for i in range(object_biases.BIAS_MODEL_SIZE)]


def _start(options: FuseOptions) -> list[float]:
    start = options.start
    values = {
        ballot.MIN_VOTES: start.min_votes,
        ballot.LONGEST_WINDOW_S: start.longest_window_s,
        ballot.MAX_ANGLE: min(max(math.radians(start.max_angle_deg), _LEAST_ANGLE), math.pi),
        ballot.MAX_DISTANCE: start.max_distance,
        ballot.MAX_LEVER: start.max_lever,
        ballot.MAX_SPEED: start.max_camera_speed if options.measurements == "camera" else start.max_speed,
        ballot.MAX_TILT: math.radians(start.max_tilt_deg),
        ballot.START_WINDOW_S: start.window_s,
        ballot.START_MIN_SPAN_S: start.min_span_s,
        ballot.LOST_WINDOW_S: start.lost_window_s,
        ballot.LOST_SHARE: start.lost_share,
        ballot.LOST_MIN_VOTES: start.lost_min_votes,
        ballot.MIN_SHARE: start.min_share,
        ballot.MIN_OBJECTS: start.min_objects,
        ballot.MIN_PLACES: start.min_places,
        ballot.LEAD: start.lead,
        ballot.LOST_SIGMA: options.health.lost_sigma,
        ballot.FEW_VOTES: start.few_votes,
        ballot.FEW_SPAN_S: start.few_span_s,
    }
    return [float(values[i]) for i in range(len(values))]


def _start_at(pose: Sequence[float], options: FuseOptions, m: memory.Memory) -> None:
    """Let the filter start at a pose (x, y, z, qx, qy, qz, qw) of its body in the world."""
    if options.estimate.map == "unknown":
        raise InputError("start.pose and an unknown map: its first object is what makes the world", fix="leave one out")
    rotation = Rotation.from_quat(pose[3:]).as_matrix().ravel()
    m.start[ballot.IS_GIVEN] = 1.0
    m.start[ballot.GIVEN_POSE : ballot.GIVEN_POSE + ballot.GIVEN_POSE_SIZE] = np.r_[rotation, pose[:3]]


def _moved(options: FuseOptions) -> list[float]:
    moved = options.moved
    values = {
        place_watch.RELEASE: moved.release,
        place_watch.RE_ESTIMATE: re_estimates(options),
        place_watch.DISTANCE: moved.distance,
        place_watch.ANGLE: math.radians(moved.angle_deg),
        place_watch.SIGMAS: moved.sigmas,
        place_watch.SCATTER: moved.scatter,
        place_watch.AFTER_S: moved.after_s,
        place_watch.SEEN_AT_HOME: moved.seen_at_home,
        place_watch.MIN_OTHERS: moved.min_others,
        place_watch.MEMORY_S: moved.memory_s,
        place_watch.MIN_POSES: moved.min_poses,
    }
    return [float(values[i]) for i in range(len(values))]


def _meeting(options: FuseOptions) -> list[float]:
    chosen = options.meeting
    values = {
        meeting.UNKNOWN_MAP: options.estimate.map == "unknown",
        meeting.MIN_POSES: chosen.min_poses,
        meeting.MIN_SPAN_S: chosen.min_span_s,
        meeting.LEAD: chosen.lead,
        meeting.MAX_ANGLE: math.radians(chosen.max_angle_deg),
        meeting.MAX_DISTANCE: chosen.max_distance,
        meeting.MAX_LEVER: chosen.max_lever,
        meeting.REPLACE: chosen.replace and options.estimate.map == "unknown",
    }
    return [float(values[i]) for i in range(len(values))]


def _prior(layout: StateLayout, options: FuseOptions) -> Array:
    """Return the 1-sigma of the error state at the start; of object poses where the map brings no covariance."""
    prior, sigma = options.prior, np.zeros(layout.n_error)
    sigma[0:3] = math.radians(prior.attitude_deg)
    sigma[3:6] = prior.position
    sigma[6:9] = prior.velocity
    sigma[9:12] = prior.gyroscope_bias
    sigma[12:15] = prior.accelerometer_bias
    if layout.extrinsics:
        rotation = math.radians(prior.extrinsic_rotation_deg)
        sigma[layout.error_slice("extrinsics")] = np.r_[[rotation] * 3, [prior.extrinsic_position] * 3]
    if layout.time_offset:
        sigma[layout.error_slice("time_offset")] = prior.time_offset
    if layout.gravity:
        sigma[layout.error_slice("gravity")] = math.radians(prior.gravity_deg)
    if layout.objects and options.estimate.map == "approximate":
        for k in range(layout.n_objects):
            rotation = math.radians(prior.map_rotation_deg)
            sigma[layout.error_slice("objects", k)] = np.r_[[rotation] * 3, [prior.map_position] * 3]
    return sigma
