"""Estimates against ground truth: errors per axis, coverage, common frames, and whether the sigmas are true."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.consistency import pose_nees
from poet_loc.core.errors import attitude_error, position_error, rotation_angle
from poet_loc.core.input_error import InputError, within
from poet_loc.core.records import CameraPoses
from poet_loc.core.trajectory import Trajectory, nearest_stamps
from poet_loc.report.fused import Fused

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]
Body = Literal["cam", "imu"]

ERROR_AXES = ("x", "y", "z", "yaw", "pitch", "roll")
"""The columns of `Row.errors` and `Row.sigmas`: m in world axes, rad as `core.errors.attitude_error` defines them."""

_BY_CHANCE = 0.2  # clocks that only beat, or jitter, meet more seldom: mostly 1 ms in more than 25 ms

_LONG_GAP = 10  # intervals of the sensor; it misses frames now and then


@dataclass(frozen=True)
class Estimate:
    """A trajectory to be judged, with what it believes of its own errors."""

    name: str
    """`localize/<mode>` or `fuse/<estimator>/<measurements>`."""
    trajectory: Trajectory
    body: Body
    """What the trajectory follows: it is compared with the ground truth of that body, on the same clock."""
    pose_covariances: Array | None = None
    """(N, 6, 6) of [e_r, e_t]: rotation on the right, translation in world axes; rad^2, m^2; NaN: unknown."""
    runtime_s: float | None = None
    oracle: bool = False
    """Whether it looked at the ground truth."""

    @classmethod
    def of_camera_poses(
        cls, name: str, poses: CameraPoses, runtime_s: float | None = None, oracle: bool = False
    ) -> Estimate:
        """Return the estimate that camera poses are."""
        trajectory = Trajectory(poses.stamps_ns, poses.T_world_cam)
        return cls(name, trajectory, "cam", poses.covariances, runtime_s, oracle)

    @classmethod
    def of_fused(cls, fused: Fused) -> Estimate:
        """Return the estimate that a fused trajectory is."""
        trajectory = Trajectory(fused.stamps_ns, fused.T_world_imu)
        return cls(fused.name, trajectory, "imu", fused.pose_covariances, fused.runtime_s)


@dataclass(frozen=True)
class EvaluateOptions:
    """When an estimate counts at a frame, and how wide the bounds are."""

    max_offset_s: float = 0.0005
    """s; a pose this near a frame's stamp counts for the frame."""
    max_gap_s: float = 0.025
    """s; between poses at most this far apart, and nearer than 1.5 frame intervals, an estimate is interpolated. So a
    trajectory at the IMU's rate has a pose at every frame, and poses at frames never speak for a frame they missed."""
    confidence: float = 0.95
    """Probability that a consistent estimate's NEES lies within its bounds."""

    def __post_init__(self) -> None:
        within("[0, inf]", self, "max_offset_s", "max_gap_s")
        within("(0, 1)", self, "confidence")


@dataclass(frozen=True)
class Row:
    """The errors of one estimate at the frames that it covers."""

    name: str
    body: Body
    oracle: bool
    runtime_s: float | None
    frames_in_span: int
    """Ground-truth frames within the sensor's span: those it could have covered."""
    stamps_ns: Stamps
    """(n,) of the frames that it covers."""
    errors: Array
    """(n, 6) estimate minus truth, the columns of ERROR_AXES."""
    angles: Array
    """(n,) rad, the angle of the attitude error."""
    sigmas: Array | None
    """(n, 6) 1-sigma of the errors, to first order; NaN where the estimate brings none."""
    nees: Array | None
    """(n,) pose NEES per degree of freedom; NaN where the estimate brings no covariance."""
    on_common: Mask
    """(n,) whether every row of the comparison covers the frame."""
    frames_of: str = "the ground truth"
    """Whose stamps the frames are."""
    why_none: str = ""
    """Why no frame could be compared, although it has poses; empty where some were."""

    @property
    def coverage(self) -> float:
        """Share of the ground-truth frames that have an estimate."""
        return len(self.stamps_ns) / self.frames_in_span if self.frames_in_span else 0.0

    def common(self) -> Row:
        """Return the row on the common frames only."""
        keep = self.on_common
        return replace(
            self,
            stamps_ns=self.stamps_ns[keep],
            errors=self.errors[keep],
            angles=self.angles[keep],
            sigmas=None if self.sigmas is None else self.sigmas[keep],
            nees=None if self.nees is None else self.nees[keep],
            on_common=keep[keep],
        )


@dataclass(frozen=True)
class Evaluation:
    """The rows of one comparison, over one log or pooled over several."""

    rows: tuple[Row, ...]
    options: EvaluateOptions = field(default_factory=EvaluateOptions)

    def __getitem__(self, name: str) -> Row:
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(name)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the rows, in order."""
        return tuple(row.name for row in self.rows)


def evaluate(
    estimates: Sequence[Estimate],
    references: Mapping[Body, Trajectory],
    sensor_span_ns: tuple[int, int],
    options: EvaluateOptions | None = None,
    frame_stamps_ns: Stamps | None = None,
    frames_of: str = "the ground truth",
) -> Evaluation:
    """Compare estimates with the ground truth of their own bodies at the frames within the sensor's span.

    The frames are the ground truth's stamps (the camera's, else the IMU's), or frame_stamps_ns where ground truth and
    camera tick differently: it is interpolated there by the same rule as the estimates; frames_of names whose stamps
    they are.  A row without any estimate takes no part in the common frames; its coverage is 0.
    Raises InputError if no frame lies within the span, ValueError for a body without ground truth or a name twice.
    """
    options = options or EvaluateOptions()
    names = [estimate.name for estimate in estimates]
    if len(set(names)) < len(names):
        raise ValueError(f"every estimate needs its own name, not {names}")
    if frame_stamps_ns is None:
        frame_stamps_ns = next(references[body].stamps_ns for body in ("cam", "imu") if body in references)
    start_ns, end_ns = sensor_span_ns
    frames_ns = frame_stamps_ns[(frame_stamps_ns >= start_ns) & (frame_stamps_ns <= end_ns)]
    if len(frames_ns) == 0:
        raise InputError(
            "no ground-truth frame lies within the sensor's span", fix="check that both run on the same clock"
        )
    truths = {body: _poses_at(reference, frames_ns, options) for body, reference in references.items()}
    rows, covered = [], []
    for estimate in estimates:
        if estimate.body not in references:
            raise ValueError(f"{estimate.name} follows the {estimate.body}, for which there is no ground truth")
        row, covers = _row(estimate, frames_ns, *truths[estimate.body], options)
        row = replace(row, frames_of=frames_of)
        if len(estimate.trajectory) and not covers.any():
            missing = estimate.trajectory if row.frames_in_span else references[estimate.body]
            whose = "its" if row.frames_in_span else "the ground truth's"
            row = replace(row, why_none=_why_none(whose, missing.stamps_ns, frames_ns, frames_of, options))
        rows.append(row)
        covered.append(covers)
    common = np.all([covers for covers in covered if covers.any()], axis=0)  # all of nothing is one True
    return Evaluation(
        tuple(
            replace(row, on_common=np.broadcast_to(common, covers.shape)[covers])
            for row, covers in zip(rows, covered, strict=True)
        ),
        options,
    )


def frames_to_compare(truth_ns: Stamps, sensor_ns: Stamps, options: EvaluateOptions | None = None) -> Stamps:
    """Return the stamps to compare at: the ground truth's own, where its frames are the sensor's.

    Where it ticks faster than the sensor or beside it (motion capture), the sensor's stamps, each once; what the sensor
    then missed altogether is nobody's frame, so where the log has every image's stamp (frames.csv), compare there, else
    also at the `stamps_in_gaps`.
    Truth that is too sparse for the sensor's stamps is compared at its own: a trajectory at an IMU's rate has poses
    there.
    """
    options = options or EvaluateOptions()
    sensor_ns = np.unique(sensor_ns)
    if len(sensor_ns) < 2 or len(truth_ns) < 2:
        return truth_ns
    if too_sparse(truth_ns, sensor_ns, options):
        return truth_ns
    shared = np.mean(_near(truth_ns, sensor_ns, options)) > 0.5
    # a low percentile, since the sensor misses frames
    faster = np.percentile(np.diff(sensor_ns), 5) > 1.5 * _interval_ns(truth_ns)
    return truth_ns if shared and not faster else sensor_ns


def stamps_in_gaps(truth_ns: Stamps, sensor_ns: Stamps) -> Stamps:
    """Return stamps of the ground truth where the sensor had none for long, about as often as it has them elsewhere."""
    sensor_ns = np.unique(sensor_ns)
    interval_ns = _interval_ns(sensor_ns)
    gaps = np.flatnonzero(np.diff(sensor_ns) > _LONG_GAP * interval_ns)
    ticks = [np.arange(sensor_ns[i] + interval_ns, sensor_ns[i + 1] - interval_ns / 2, interval_ns) for i in gaps]
    wanted = np.concatenate([np.empty(0), *ticks]).astype(np.int64)
    found = truth_ns[nearest_stamps(wanted, truth_ns)]
    return np.unique(found[np.abs(found - wanted) <= interval_ns / 2])


def too_sparse(truth_ns: Stamps, frames_ns: Stamps, options: EvaluateOptions) -> bool:
    """Return whether the truth has poses among the frames, but none at them nor near enough to be interpolated."""
    among = (truth_ns >= frames_ns.min()) & (truth_ns <= frames_ns.max())
    return bool(among.any() and _only_beats(truth_ns, frames_ns, options))


def pool(evaluations: Iterable[Evaluation]) -> Evaluation:
    """Return one evaluation over the frames of several logs.

    A row is pooled over the logs that have it; its common frames are those of the logs that have every row, so that
    rows are still compared on the same frames.  Runtimes add up.
    """
    evaluations = tuple(evaluations)
    names = tuple(dict.fromkeys(name for evaluation in evaluations for name in evaluation.names))
    rows = []
    for name in names:
        parts = []
        for evaluation in evaluations:
            if name in evaluation.names:
                complete = len(evaluation.names) == len(names)
                part = evaluation[name]
                parts.append(replace(part, on_common=part.on_common & complete))
        rows.append(_concatenated(parts))
    return Evaluation(tuple(rows), evaluations[0].options if evaluations else EvaluateOptions())


def references_for_both_bodies(
    references: Mapping[Body, Trajectory], T_cam_imu: RigidTransform | None
) -> dict[Body, Trajectory]:
    """Return the ground truth of camera and IMU, the missing one by way of the extrinsics where they are known."""
    both = dict(references)
    if T_cam_imu is not None:
        if "cam" in both and "imu" not in both:
            both["imu"] = both["cam"].to_body(T_cam_imu)
        elif "imu" in both and "cam" not in both:
            both["cam"] = both["imu"].to_body(T_cam_imu.inv())
    return both


def _row(
    estimate: Estimate, frames_ns: Stamps, T_ref: RigidTransform, has_truth: Mask, options: EvaluateOptions
) -> tuple[Row, Mask]:
    """The row of one estimate and which frames it covers, (F,)."""
    if len(estimate.trajectory) == 0:
        covers = np.zeros(len(frames_ns), dtype=bool)
        T_est, covariances = T_ref[:0], None if estimate.pose_covariances is None else np.empty((0, 6, 6))
    else:
        T_est, covers = _poses_at(estimate.trajectory, frames_ns, options)
        covers &= has_truth
        T_est = T_est[covers]
        covariances = _covariances_at(estimate, frames_ns[covers])
    T_ref = T_ref[covers]
    errors = np.concatenate([position_error(T_est, T_ref), attitude_error(T_est, T_ref)], axis=1)
    sigmas = nees = None
    if covariances is not None:
        diagonal = np.diagonal(covariances, axis1=1, axis2=2)
        # for small errors yaw, pitch, roll are the z, y, x components of the rotation error in body axes
        sigmas = np.sqrt(np.maximum(diagonal[:, [3, 4, 5, 2, 1, 0]], 0.0))
        nees = pose_nees(T_est, T_ref, covariances)
    row = Row(
        name=estimate.name,
        body=estimate.body,
        oracle=estimate.oracle,
        runtime_s=estimate.runtime_s,
        frames_in_span=int(has_truth.sum()),
        stamps_ns=frames_ns[covers],
        errors=errors,
        angles=rotation_angle(T_est, T_ref),
        sigmas=sigmas,
        nees=nees,
        on_common=np.ones(int(covers.sum()), dtype=bool),
    )
    return row, covers


def _poses_at(trajectory: Trajectory, frames_ns: Stamps, options: EvaluateOptions) -> tuple[RigidTransform, Mask]:
    """The poses at the frames, interpolated where neighbours are near, and which frames have one."""
    interpolated, between = trajectory.interpolate(frames_ns, int(_max_gap_ns(frames_ns, options)))
    nearest = nearest_stamps(frames_ns, trajectory.stamps_ns)
    near = _near(trajectory.stamps_ns, frames_ns, options)
    both = RigidTransform.concatenate([interpolated, trajectory.T_world_body[nearest]])
    index = np.arange(len(frames_ns))
    covers = (between | near) & (not _only_beats(trajectory.stamps_ns, frames_ns, options))
    return both[np.where(between, index, index + len(frames_ns))], covers


def _interval_ns(stamps_ns: Stamps) -> float:
    """The usual time between stamps; infinite for a single one."""
    return float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else np.inf


def _max_gap_ns(frames_ns: Stamps, options: EvaluateOptions) -> float:
    """The longest gap over which a trajectory is interpolated at the frames."""
    return min(options.max_gap_s * 1e9, 1.5 * _interval_ns(frames_ns))


def _near(stamps_ns: Stamps, frames_ns: Stamps, options: EvaluateOptions) -> Mask:
    """Which frames have a stamp near, (F,)."""
    apart_ns = np.abs(stamps_ns[nearest_stamps(frames_ns, stamps_ns)] - frames_ns)
    return np.asarray(apart_ns <= options.max_offset_s * 1e9)


def _only_beats(stamps_ns: Stamps, frames_ns: Stamps, options: EvaluateOptions) -> bool:
    """Whether stamps too sparse for the frames meet no more of them than chance would have it."""
    start_ns, end_ns = max(stamps_ns[0], frames_ns[0]), min(stamps_ns[-1], frames_ns[-1])
    could = min(np.count_nonzero((each >= start_ns) & (each <= end_ns)) for each in (stamps_ns, frames_ns))
    met = np.count_nonzero(_near(stamps_ns, frames_ns, options))
    sparse = _interval_ns(stamps_ns) > _max_gap_ns(frames_ns, options)
    return sparse and bool(met <= _BY_CHANCE * could)


def _why_none(whose: str, stamps_ns: Stamps, frames_ns: Stamps, frames_of: str, options: EvaluateOptions) -> str:
    """Say why none of a trajectory's poses counts at any frame."""
    shared = f"share no stamp with {frames_of}{_rate(frames_ns)} to {1e3 * options.max_offset_s:g} ms"
    why = f"{whose} poses{_rate(stamps_ns)} {shared}"
    if stamps_ns[-1] < frames_ns[0] or stamps_ns[0] > frames_ns[-1]:
        return f"{whose} poses share no time with {frames_of}"
    interval_ns, limit_ns = _interval_ns(stamps_ns), _max_gap_ns(frames_ns, options)
    if limit_ns < interval_ns < np.inf:
        why += f" and are too sparse to interpolate ({interval_ns * 1e-9:.3f} s > {limit_ns * 1e-9:.3f} s)"
    return why


def _rate(stamps_ns: Stamps) -> str:
    return f" ({1e9 / _interval_ns(stamps_ns):.1f} Hz)" if len(stamps_ns) > 1 else ""


def _covariances_at(estimate: Estimate, stamps_ns: Stamps) -> Array | None:
    """The covariance of the pose nearest each stamp."""
    if estimate.pose_covariances is None:
        return None
    return estimate.pose_covariances[nearest_stamps(stamps_ns, estimate.trajectory.stamps_ns)]


def _concatenated(parts: Sequence[Row]) -> Row:
    def joined(arrays: list[Array | None], width: tuple[int, ...]) -> Array | None:
        if all(array is None for array in arrays):
            return None
        lengths = [len(part.stamps_ns) for part in parts]
        filled = [np.full((n, *width), np.nan) if a is None else a for a, n in zip(arrays, lengths, strict=True)]
        return np.concatenate(filled)

    runtimes = [part.runtime_s for part in parts if part.runtime_s is not None]
    return replace(
        parts[0],
        runtime_s=sum(runtimes) if runtimes else None,
        frames_in_span=sum(part.frames_in_span for part in parts),
        frames_of=" or ".join(dict.fromkeys(part.frames_of for part in parts)),
        stamps_ns=np.concatenate([part.stamps_ns for part in parts]),
        errors=np.concatenate([part.errors for part in parts]),
        angles=np.concatenate([part.angles for part in parts]),
        sigmas=joined([part.sigmas for part in parts], (6,)),
        nees=joined([part.nees for part in parts], ()),
        on_common=np.concatenate([part.on_common for part in parts]),
    )
