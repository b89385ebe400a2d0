"""The stages as Python calls: a log goes in, a result comes out that can show and write itself.

log = poet_loc.read_log("logs/desk")
fused = poet_loc.fuse(log)
fused.to_tum("T_world_imu.tum")
poet_loc.evaluate(poet_loc.localize(log), fused).plot()
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from fusion.options import FuseOptions
from landmarks.options import ORACLES, SolverOptions
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log, read_log
from poet_loc.io.tum import write_tum
from poet_loc.report.error_tables import Block, consistency_table, error_table
from poet_loc.report.evaluate import Estimate, EvaluateOptions, Evaluation
from poet_loc.report.html import figure_html, fragment, table_html
from poet_loc.report.log_evaluation import evaluate_log, on_camera_clock, references_of
from poet_loc.report.run_record import RunRecord
from poet_loc.report.summary import Summary, to_summary
from poet_loc.report.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fusion.calibrated import Calibrated
    from fusion.result import FuseResult
    from landmarks.localize import LocalizeOptions, LocalizeResult

Picture = Literal["errors", "trajectory", "top view", "consistency", "landmarks", "distribution"]
"""errors: per axis over time with 3 sigma; trajectory: per axis against the truth; top view: the paths from above;
consistency: NEES, and NIS where there is a gate; landmarks: who was seen when and used; distribution: share of frames
below an error. errors, consistency and distribution need ground truth."""


@dataclass(frozen=True)
class Result:
    """What a stage made of a log: a trajectory with its covariances, and its errors where the log has ground truth."""

    log: Log
    detections: str | None
    """Name of the set of detections, "" for object_poses.csv; None where the log's camera poses were fused."""
    estimate: Estimate
    """Name, trajectory (on the camera's clock), body (cam or imu), (N, 6, 6) pose covariances, runtime."""

    @property
    def name(self) -> str:
        """`localize/<mode>` or `fuse/<estimator>/<measurements>`."""
        return self.estimate.name

    @property
    def trajectory(self) -> Trajectory:
        """Stamps and poses: T_world_cam of localize, T_world_imu of fuse on the IMU's clock."""
        return self.estimate.trajectory

    @cached_property
    def evaluation(self) -> Evaluation | None:
        """Errors against the log's ground truth, None where it has none."""
        return evaluate_log(self.log, self.detections, [self.estimate], EvaluateOptions())

    @property
    def record(self) -> RunRecord:
        """What figures and recordings are made from."""
        return _record((self,), self.evaluation)

    def plot(self, picture: Picture | None = None) -> Figure:
        """Return a figure: that which is asked for, else the errors, else (no ground truth) the trajectory.

        Raises InputError where the log lacks what the picture shows.
        """
        return _draw(self.record, picture or ("errors" if self.evaluation else "trajectory"))

    def to_rerun(self, path: str | Path) -> Path:
        """Write a recording that `rerun` and `poet-loc view` open; return its path."""
        return _write_recording(self.record, path, self.name)

    def to_tum(self, path: str | Path) -> Path:
        """Write the trajectory as a TUM file (seconds, x y z, q_xyzw); return its path."""
        write_tum(path, self.trajectory)
        return Path(path)

    def _repr_html_(self) -> str:
        return _page(self.record, self._tables(), self.plot())

    def _tables(self) -> list[Table]:
        if self.evaluation is not None:
            return _tables(self.evaluation)
        return []

    def __repr__(self) -> str:
        seconds = (self.trajectory.stamps_ns[-1] - self.trajectory.stamps_ns[0]) * 1e-9 if len(self.trajectory) else 0.0
        text = f"<{self.name}: {len(self.trajectory)} poses over {seconds:.1f} s of the {self.estimate.body}"
        if self.evaluation is None:
            return text + ", no ground truth>"
        errors = to_summary(self.evaluation)[self.name]
        position, attitude = errors["position_error_mm"]["norm"]["rmse"], errors["attitude_error_deg"]["angle"]["rmse"]
        if position is None:
            why = self.evaluation[self.name].why_none
            return text + (f", no errors: {why}>" if why else ">")
        return text + f", RMSE {position:.1f} mm, {attitude:.2f} deg>"


@dataclass(frozen=True, repr=False)
class Localization(Result):
    """Camera poses of one mode of the solver."""

    result: LocalizeResult = field(kw_only=True)
    """Everything that the solver says: covariances, who voted, which poses are held."""


@dataclass(frozen=True, repr=False)
class FusedTrajectory(Result):
    """The trajectory of one estimator."""

    result: FuseResult = field(kw_only=True)
    """Everything that the estimator says: velocity, biases, sigmas, covariances, gate decisions."""

    @property
    def trajectory(self) -> Trajectory:
        """Stamps and poses: T_world_imu on the IMU's clock."""
        return self.result.trajectory

    @property
    def calibrated(self) -> Calibrated | None:
        """Extrinsics, time offset, gravity and map, each with its sigma, as far as options.estimate asks for them."""
        return self.result.calibrated


@dataclass(frozen=True)
class Comparison:
    """Several results of one log on the frames that all of them have."""

    results: tuple[Result, ...]
    evaluation: Evaluation

    @property
    def summary(self) -> Summary:
        """By name: errors in mm and deg per axis, coverage, NEES; what summary.json of a run holds."""
        return to_summary(self.evaluation)

    @property
    def tables(self) -> list[Table]:
        """Errors, and consistency where sigmas are known; each has markdown() and latex()."""
        return _tables(self.evaluation)

    @property
    def record(self) -> RunRecord:
        """What figures and recordings are made from."""
        return _record(self.results, self.evaluation)

    def plot(self, picture: Literal["distribution", "trajectory", "top view"] = "distribution") -> Figure:
        """Return a figure that has every result in it."""
        return _draw(self.record, picture)

    def to_rerun(self, path: str | Path) -> Path:
        """Write one recording with every result, side by side; return its path."""
        return _write_recording(self.record, path, "comparison")

    def to_tum(self, folder: str | Path) -> list[Path]:
        """Write each trajectory to <folder>/<name with _ for />.tum; return the paths.  The folder is made."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        return [result.to_tum(folder / f"{result.name.replace('/', '_')}.tum") for result in self.results]

    def _repr_html_(self) -> str:
        return _page(self.record, self.tables, self.plot())

    def __repr__(self) -> str:
        return "\n".join(map(repr, self.results))


def localize(log: Log | str | Path, options: LocalizeOptions | None = None) -> Localization:
    """Turn a log's object poses and landmark map into camera poses.

    Raises InputError where the log lacks detections or the map, and where the oracle `best` finds no ground truth.
    """
    from landmarks.localize import localize as run

    log = _log(log, options.detections if options is not None else None)
    result = run(log, options)
    mode = result.name.removeprefix("localize/")
    estimate = Estimate.of_camera_poses(
        result.name, result.estimates.camera_poses, result.runtime_s, oracle=mode in ORACLES
    )
    return Localization(log, result.detections, estimate, result=result)


def fuse(
    log: Log | str | Path,
    options: FuseOptions | None = None,
    *,
    detections: str | None = None,
    solver: SolverOptions | None = None,
) -> FusedTrajectory:
    """Fuse a log's object poses, or camera poses, with its IMU (else its odometry, else constant velocity).

    detections names object_poses_NAME.csv; solver makes the camera poses where options.measurements is "camera" and
    the log brings none. Where the map is unknown and the log has none, the world is an object's, in which the log's
    ground truth says nothing. Raises InputError where the log lacks what the options need, or where the start's
    conditions are never met.
    """
    from fusion.first_map import lacks_map
    from fusion.fuse import fuse as run

    options = options or FuseOptions()
    log = _log(log, detections, unmapped=options.estimate.map == "unknown")
    if lacks_map(log, options):
        log = replace(log, T_world_cam=None, T_world_imu=None)
    object_poses = camera_poses = name = None
    solver, by_truth = solver or SolverOptions(), False
    if options.measurements == "objects" or log.camera_poses is None:
        name, object_poses = log.detections(detections)
        if options.measurements == "camera":
            solved = localize(log, _with_detections(solver, name)).result.estimates
            camera_poses, by_truth = solved.camera_poses[~solved.held], solver.mode in ORACLES
    result = run(log, options, camera_poses=camera_poses, object_poses=object_poses)
    estimate = replace(Estimate.of_fused(on_camera_clock(log, result)), body=result.body, oracle=by_truth)
    return FusedTrajectory(log, name, estimate, result=result)


def evaluate(*results: Result, options: EvaluateOptions | None = None) -> Comparison:
    """Compare results of one log with its ground truth, on the frames that all of them have.

    Position errors are in world axes without alignment. Raises InputError for results of different logs, for two of
    one name, and without ground truth.
    """
    if not results:
        raise InputError("there is nothing to evaluate", fix="give results of localize or fuse")
    log, name = results[0].log, next((each.detections for each in results if each.detections is not None), None)
    if any(each.log is not log for each in results):
        raise InputError("the results are of different logs", fix="evaluate each log by itself")
    names = [each.name for each in results]
    if len(set(names)) < len(names):
        raise InputError(f"two results have one name: {', '.join(names)}", fix="evaluate them one by one")
    evaluation = evaluate_log(log, name, [each.estimate for each in results], options or EvaluateOptions())
    if evaluation is None:
        raise InputError("has no ground truth", path=log.path, fix="add T_world_cam.tum or T_world_imu.tum")
    return Comparison(results, evaluation)


def _log(log: Log | str | Path, detections: str | None, unmapped: bool = False) -> Log:
    return log if isinstance(log, Log) else read_log(log, detections, unmapped)


def _with_detections(options: SolverOptions, name: str) -> LocalizeOptions:
    from dataclasses import fields

    from landmarks.localize import LocalizeOptions

    values = {each.name: getattr(options, each.name) for each in fields(SolverOptions)}
    return LocalizeOptions(**values, detections=name)


def _record(results: Sequence[Result], evaluation: Evaluation | None) -> RunRecord:
    log = results[0].log
    name = next((each.detections for each in results if each.detections is not None), None)
    calibration = log.calibration
    return RunRecord(
        estimates=tuple(each.estimate for each in results),
        references=references_of(log),
        evaluation=evaluation,
        fused=tuple(on_camera_clock(log, each.result) for each in results if isinstance(each, FusedTrajectory)),
        landmark_map=log.landmark_map,
        detections=None if name is None else log.object_poses[name],
        voted={each.name: each.result.estimates.voted for each in results if isinstance(each, Localization)},
        camera=None if calibration is None else calibration.camera,
        T_cam_imu=None if calibration is None else calibration.T_cam_imu,
    )


def _draw(record: RunRecord, picture: Picture) -> Figure:
    from poet_loc.report import figures

    estimate = record.estimates[0]
    if picture == "trajectory":
        return figures.trajectory_figure(record, estimate.body)
    if picture == "top view":
        return figures.top_view_figure(record)
    if picture == "landmarks":
        if estimate.name not in record.decisions:
            raise InputError("no landmarks were used", fix="choose another picture")
        return figures.landmark_figure(record, record.decisions[estimate.name], estimate.name)
    if record.evaluation is None or not len(record.evaluation.rows[0].stamps_ns):
        raise InputError(f"there is no ground truth for the picture '{picture}'", fix="choose 'trajectory'")
    if picture == "errors":
        return figures.error_figure(record.evaluation[estimate.name], record.start_ns)
    if picture == "distribution":
        return figures.distribution_figure(record.evaluation)
    if picture == "consistency":
        gates = {fused.name: fused.gate for fused in record.fused}
        return figures.consistency_figure(record.evaluation[estimate.name], gates.get(estimate.name), record.start_ns)
    raise InputError(f"unknown picture '{picture}'", fix="errors, trajectory, top view, consistency or landmarks")


def _write_recording(record: RunRecord, path: str | Path, name: str) -> Path:
    from poet_loc.report.rerun_log import write_recording

    write_recording(record, path, name)
    return Path(path)


def _tables(evaluation: Evaluation) -> list[Table]:
    blocks = [Block(to_summary(evaluation))]
    return [table for table in (error_table(blocks), consistency_table(blocks)) if table.rows]


def _page(record: RunRecord, tables: Sequence[Table], figure: Figure) -> str:
    names = ", ".join(estimate.name for estimate in record.estimates)
    return fragment(*map(table_html, tables), figure_html(figure, names))
