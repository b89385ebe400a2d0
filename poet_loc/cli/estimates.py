"""Every estimate of one log: all modes of the solver, all estimators of the fusion, and their errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np

from fusion.health import troubles
from fusion.odometry import expected_of
from fusion.options import FuseOptions
from fusion.result import FuseResult
from landmarks.localize import LocalizeOptions, LocalizeResult, localize
from landmarks.options import MODES, ORACLES, Mode, SolverOptions
from poet_loc.check.objects import check_in_front, check_rotations_against_map
from poet_loc.check.odometry import breaks_of, check_odometry_scale
from poet_loc.check.units import check_accelerometer, check_gyroscope
from poet_loc.cli.terminal import Report
from poet_loc.core.input_error import InputError
from poet_loc.core.records import CameraPoses
from poet_loc.io.log_folder import Log
from poet_loc.report.evaluate import Estimate, EvaluateOptions, Evaluation
from poet_loc.report.log_evaluation import evaluate_log, on_camera_clock, references_of
from poet_loc.report.run_record import RunRecord
from poet_loc.report.seen_images import images_of

Fusion = Literal[
    "eskf/objects",
    "eskf/camera",
    "eskf-smoothed/objects",
    "eskf-smoothed/camera",
    "graph/objects",
    "graph/camera",
    "batch/objects",
    "batch/camera",
]
"""<estimator>/<measurements>, as in the name of the estimate."""

_TOLD_BREAKS = 3
_REFUSED = ("accelerometer-unit", "no-gravity", "gyroscope-degrees")  # where certain

FUSIONS: tuple[Fusion, ...] = ("eskf/objects", "eskf/camera", "graph/objects")


@dataclass(frozen=True)
class StageOptions:
    """The options of every stage that a log goes through."""

    solver: SolverOptions = field(default_factory=SolverOptions)
    """How votes become a camera pose; its mode is the one whose camera poses are fused."""
    fusion: FuseOptions = field(default_factory=FuseOptions)
    """How poses and a motion source become a trajectory."""
    evaluation: EvaluateOptions = field(default_factory=EvaluateOptions)
    """When an estimate counts at a frame."""


@dataclass(frozen=True)
class Estimates:
    """What was made of one log with one set of detections."""

    log: Log
    detections: str | None
    """Name of the set of detections; None where the log's own camera poses were taken."""
    localized: tuple[LocalizeResult, ...]
    fused: tuple[FuseResult, ...]
    evaluation: Evaluation | None
    """None without ground truth."""
    solver_mode: Mode
    """Of the solver whose camera poses are fused where the log brings none."""

    @property
    def record(self) -> RunRecord:
        """What figures, recordings and files take."""
        calibration = self.log.calibration
        found = (None if each.calibrated is None else each.calibrated.landmark_map for each in self.fused)
        return RunRecord(
            estimates=_estimates(self.log, self.localized, self.fused, self.solver_mode),
            references=references_of(self.log),
            evaluation=self.evaluation,
            fused=tuple(on_camera_clock(self.log, result) for result in self.fused),
            landmark_map=self.log.landmark_map or next((each for each in found if each is not None), None),
            detections=None if self.detections is None else self.log.object_poses[self.detections],
            voted={result.name: result.estimates.voted for result in self.localized},
            camera=None if calibration is None else calibration.camera,
            T_cam_imu=None if calibration is None else calibration.T_cam_imu,
            images=images_of(self.log, self.detections),
        )


def estimate_log(
    log: Log,
    detections: str | None,
    options: StageOptions,
    report: Report,
    modes: Sequence[Mode] = MODES,
    fusions: Sequence[Fusion] = FUSIONS,
    strict: bool = False,
) -> Estimates:
    """Localise in these modes, fuse by these estimators, and evaluate; what the log lacks is noted and left out.

    Raises InputError where nothing at all can be estimated; if strict, for the first thing that cannot.
    """
    from fusion.first_map import lacks_map

    name, own_world = None, lacks_map(log, options.fusion)
    if own_world:
        log = replace(log, T_world_cam=None, T_world_imu=None)
    if log.object_poses and (log.landmark_map is not None or own_world):
        name = log.detections(detections)[0]
        _tell_of_other_axes(log, name, report)
    elif detections is not None or log.camera_poses is None:
        log.detections(detections)
    attempt = _Attempt(report, strict)
    localized = tuple(_localized(log, name, options.solver, attempt, modes)) if name is not None else ()
    fused = tuple(_fused(log, name, localized, options, attempt, fusions))
    if not localized and not fused:
        raise attempt.last or InputError("nothing can be estimated of this log", path=log.path)
    attempt.tell()
    if fused and log.imu is None and options.fusion.motion == "auto":
        report.note(f"{log.path}: no imu.csv: fused on {fused[0].motion.replace('-', ' ')} instead")
    for result in fused:
        _tell_of_moved_objects(log, result, report)
    _tell_of_troubles(log, fused, report)
    _tell_of_odometry(log, fused, options.fusion, report)
    _tell_of_unused_covariances(log, fused, options.fusion, report)
    evaluation = None
    if own_world:
        what = "no landmarks.json: the world is that of the object that anchors it, in which ground truth says nothing"
        report.note(f"{log.path}: {what}; poet-loc evaluate --align se3 compares trajectories")
    else:
        all_estimates = _estimates(log, localized, fused, options.solver.mode)
        evaluation = evaluate_estimates(log, name, all_estimates, options.evaluation, report)
    return Estimates(log, name, localized, fused, evaluation, options.solver.mode)


def _tell_of_other_axes(log: Log, detections: str, report: Report) -> None:
    """Note detections, or a map, that only make sense written otherwise: a filter may get along with their places."""
    log = replace(log, object_poses={detections: log.object_poses[detections]})
    for finding in (*check_rotations_against_map(log), *check_in_front(log)):
        report.note(f"{log.path / finding.file}: {finding.what}; {finding.fix}")


def _tell_of_moved_objects(log: Log, result: FuseResult, report: Report) -> None:
    if result.health is None:
        return
    names = {each.key: each.name or f"object {each.object_id}" for each in log.landmark_map or ()}
    begin_ns = int(result.health.since_ns[0])
    for key, first, last in result.health.released:
        span = f"left out from {(first - begin_ns) * 1e-9:.1f} s to {(last - begin_ns) * 1e-9:.1f} s"
        report.note(f"{log.path}: {names.get(key, f'object {key[0]}')} was moved: {span} ({result.name})")


def _tell_of_troubles(log: Log, fused: Sequence[FuseResult], report: Report) -> None:
    """Note what the first estimate with any trouble has, and how many others have some: they mostly share it."""
    told = [(result.name, found) for result in fused if (found := troubles(result))]
    if told:
        others = f" ({len(told) - 1} other{'s' if len(told) > 2 else ''} likewise)" if len(told) > 1 else ""
        what = " and ".join([", ".join(told[0][1][:-1]), told[0][1][-1]] if len(told[0][1]) > 1 else told[0][1])
        report.note(f"{log.path}: {told[0][0]} {what}{others}; poet-loc check says what looks wrong in a log")


def _tell_of_odometry(log: Log, fused: Sequence[FuseResult], options: FuseOptions, report: Report) -> None:
    """Note where the odometry that was used jumps or has holes."""
    if log.T_odom_cam is None or not any("odometry" in result.motion for result in fused):
        return
    breaks = breaks_of(log, expected_of(options))
    begin_ns = min([int(log.T_odom_cam.stamps_ns[0]), *(each.after_ns for each in breaks)])
    told = ", ".join(f"{each.text} at {(each.after_ns - begin_ns) * 1e-9:.1f} s" for each in breaks[:_TOLD_BREAKS])
    if breaks:
        more = f" and {len(breaks) - _TOLD_BREAKS} more" if len(breaks) > _TOLD_BREAKS else ""
        report.note(f"{log.path}: T_odom_cam.tum has {told}{more}: not taken for motion")


def _tell_of_unused_covariances(log: Log, fused: Sequence[FuseResult], options: FuseOptions, report: Report) -> None:
    """Note a map that says how unsure it is and is taken as exact all the same."""
    stated = [each.covariance for each in log.landmark_map or () if each.covariance is not None]
    if not stated or options.estimate.map != "known" or not any(each.name.endswith("/objects") for each in fused):
        return
    sigma = 1e3 * np.sqrt(max(np.trace(covariance[3:, 3:]) / 3.0 for covariance in stated))
    what = f"landmarks.json states 1-sigmas of up to {sigma:.1f} mm, and fusion takes it as exact"
    report.note(f"{log.path}: {what}; see --estimate.map approximate")


def steps(modes: Sequence[Mode] = MODES, fusions: Sequence[Fusion] = FUSIONS) -> int:
    """Return how many steps `estimate_log` announces at most."""
    return len(modes) + len(fusions) + 1


def evaluate_estimates(
    log: Log,
    detections: str | None,
    estimates: Sequence[Estimate],
    options: EvaluateOptions,
    report: Report,
) -> Evaluation | None:
    """Return the errors of the estimates; None, with a note, where the log has no ground truth for any of them."""
    report.step("evaluate")
    evaluation = evaluate_log(log, detections, estimates, options)
    if evaluation is None:
        report.note(f"{log.path}: no ground truth of the camera or the IMU: no errors")
        return None
    missing = {estimate.body for estimate in estimates} - references_of(log).keys()
    if missing:
        report.note(f"{log.path}: no T_world_{missing.pop()}.tum and no extrinsics: no errors of what follows it")
    for reason in dict.fromkeys(row.why_none for row in evaluation.rows if row.why_none):
        names = ", ".join(row.name for row in evaluation.rows if row.why_none == reason)
        report.note(f"{log.path}: no errors of {names}: {reason}")
    return evaluation


class _Attempt:
    """What cannot be done is raised if strict, else noted: one line for each reason."""

    def __init__(self, report: Report, strict: bool) -> None:
        self.report, self.strict = report, strict
        self.last: InputError | None = None
        self._left_out: dict[str, list[str]] = {}

    def failed(self, error: InputError, name: str) -> None:
        if self.strict:
            raise error
        self.last = error
        names = self._left_out.setdefault(str(error), [])
        if name not in names:
            names.append(name)

    def tell(self) -> None:
        for reason, names in self._left_out.items():
            self.report.note(f"{reason}: no {', '.join(names)}")


def _localized(
    log: Log, detections: str | None, options: SolverOptions, attempt: _Attempt, modes: Sequence[Mode]
) -> Iterator[LocalizeResult]:
    for mode in modes:
        attempt.report.step(f"localize {mode}")
        try:
            yield localize(log, _localize_options(options, mode, detections))
        except InputError as error:
            attempt.failed(error, f"localize/{mode}")


def _fused(
    log: Log,
    detections: str | None,
    localized: Sequence[LocalizeResult],
    options: StageOptions,
    attempt: _Attempt,
    fusions: Sequence[Fusion],
) -> Iterator[FuseResult]:
    from fusion.fuse import fuse

    choices = [with_fusion(options.fusion, fusion) for fusion in fusions]
    wanted = any(choice.measurements == "camera" for choice in choices)
    from_solver = _solved(log, detections, localized, options.solver, attempt) if wanted else None
    object_poses = None if detections is None else log.object_poses[detections]
    with_imu = any(map(_takes_imu, choices))
    refused = _refused_units(log, detections, attempt.report) if with_imu else None
    if with_imu and refused is None:
        _tell_of_time_offset(log, detections, options.fusion, attempt.report)
    if any(map(_takes_odometry, choices)):
        _tell_of_odometry_scale(log, detections, attempt.report)
    there = {"objects": object_poses is not None, "camera": log.camera_poses is not None or from_solver is not None}
    for fusion, choice in zip(fusions, choices, strict=True):
        if not there[choice.measurements] and not attempt.strict:
            continue
        attempt.report.step(f"fuse {fusion}")
        try:
            if refused is not None and _takes_imu(choice):
                raise refused
            yield fuse(log, choice, camera_poses=from_solver, object_poses=object_poses)
        except InputError as error:
            attempt.failed(error, f"fuse/{fusion}")


def _takes_imu(options: FuseOptions) -> bool:
    return options.motion in ("auto", "imu", "imu+odometry")


def _takes_odometry(options: FuseOptions) -> bool:
    return options.motion in ("auto", "odometry", "imu+odometry")


def _refused_units(log: Log, detections: str | None, report: Report) -> InputError | None:
    """Return what is wrong where the IMU is in other units for sure; note where it only seems so.

    The ground truth, which no estimate may look at, has no say.
    """
    poses = {} if detections is None else {detections: log.object_poses[detections]}
    log = replace(log, object_poses=poses, T_world_cam=None, T_world_imu=None)
    for finding in (*check_accelerometer(log), *check_gyroscope(log)):
        if finding.severity == "error" and finding.check in _REFUSED:
            return InputError(finding.what, path=log.path / finding.file, fix=finding.fix)
        if finding.check.startswith("gyroscope"):
            report.note(f"{log.path / finding.file}: {finding.what}; {finding.fix}")
    return None


def _tell_of_time_offset(log: Log, detections: str | None, options: FuseOptions, report: Report) -> None:
    """Note where the poses turn with the gyroscope at another time offset than the calibration's."""
    from fusion.coarse_offset import coarse_offset

    stated = 0.0 if log.calibration is None else log.calibration.timeshift_cam_imu_s
    match = coarse_offset(log, object_poses=None if detections is None else log.object_poses[detections])
    if match is None or not match.contradicts(stated):
        return
    found = f"{match.offset.offset_s:.3f} s (to {1e3 * match.offset_error_s:.0f} ms)"
    what = f"the poses turn as the gyroscope does at timeshift_cam_imu: {found}, not at {stated:g} s"
    fix = "put it into calibration.yaml, or see --estimate.time-offset"
    report.note(f"{log.path}: {what}; {'the estimate begins there' if options.estimate.time_offset else fix}")


def _tell_of_odometry_scale(log: Log, detections: str | None, report: Report) -> None:
    """Note where the odometry's unit of length is not the detections'."""
    poses = {} if detections is None else {detections: log.object_poses[detections]}
    for finding in check_odometry_scale(replace(log, object_poses=poses)):
        report.note(f"{log.path / finding.file}: {finding.what}; {finding.fix}")


def _solved(
    log: Log, detections: str | None, localized: Sequence[LocalizeResult], options: SolverOptions, attempt: _Attempt
) -> CameraPoses | None:
    """Return the camera poses of the solver's mode; None where the log brings its own or there is nothing to solve."""
    if log.camera_poses is not None or detections is None:
        return None
    among = [result for result in localized if result.name == f"localize/{options.mode}"]
    found = next(iter(among or _localized(log, detections, options, attempt, [options.mode])), None)
    # poses that only repeat an earlier one bring nothing
    return None if found is None else found.estimates.camera_poses[~found.estimates.held]


def with_fusion(options: FuseOptions, fusion: Fusion) -> FuseOptions:
    """Return the options with the estimator and the measurements that a name says."""
    estimator, measurements = fusion.split("/")
    return replace(
        options,
        estimator=estimator.removesuffix("-smoothed"),  # type: ignore[arg-type]
        smooth=estimator.endswith("-smoothed"),
        measurements=measurements,  # type: ignore[arg-type]
    )


def fusion_of(options: FuseOptions) -> Fusion:
    """Return the name of what the options ask for."""
    smoothed = "-smoothed" if options.smooth else ""
    return f"{options.estimator}{smoothed}/{options.measurements}"  # type: ignore[return-value]


def refuse_one_estimator(options: FuseOptions) -> None:
    """Raise InputError where the options name an estimator although the command takes several."""
    if fusion_of(options) != fusion_of(FuseOptions()):
        raise InputError(f"several estimators run here, not {fusion_of(options)} alone", fix="name them with --fusions")


def _localize_options(options: SolverOptions, mode: Mode, detections: str | None) -> LocalizeOptions:
    values = {each.name: getattr(options, each.name) for each in fields(SolverOptions)}
    return LocalizeOptions(**values | {"mode": mode}, detections=detections)


def _estimates(
    log: Log, localized: Sequence[LocalizeResult], fused: Sequence[FuseResult], solver_mode: Mode
) -> tuple[Estimate, ...]:
    given = [] if log.camera_poses is None else [Estimate.of_camera_poses("localize/given", log.camera_poses)]
    solved = [
        Estimate.of_camera_poses(
            result.name,
            result.estimates.camera_poses,
            result.runtime_s,
            oracle=result.name.removeprefix("localize/") in ORACLES,
        )
        for result in localized
    ]
    by_truth = log.camera_poses is None and solver_mode in ORACLES
    filtered = [
        replace(Estimate.of_fused(result), body=result.body, oracle=by_truth and result.name.endswith("/camera"))
        for result in (on_camera_clock(log, each) for each in fused)
    ]
    return (*given, *solved, *filtered)
