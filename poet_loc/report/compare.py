"""One trajectory against another: errors per axis, APE and RPE after a stated alignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from poet_loc.core.alignment import Alignment, AlignmentKind, align
from poet_loc.core.errors import (
    Relation,
    Statistics,
    absolute_pose_error,
    pairs_by_frames,
    pairs_by_metres,
    relative_pose_error,
    statistics,
)
from poet_loc.core.input_error import InputError, within
from poet_loc.core.trajectory import Trajectory, match_stamps
from poet_loc.report.evaluate import Estimate, Evaluation, evaluate


@dataclass(frozen=True)
class CompareOptions:
    """How two trajectories are matched, aligned and compared."""

    align: AlignmentKind = "none"
    """none where both live in one world, as with a known map; origin, yaw (worlds that share gravity), se3 or sim3."""
    max_offset_s: float = 0.01
    """s; a pose of the estimate counts for the nearest reference pose up to this far away."""
    rpe_delta: float = 1.0
    """What lies between the poses of a pair, in rpe_unit."""
    rpe_unit: Literal["m", "frames"] = "m"
    """Metres along the estimate's path, or frames."""
    rpe_all_pairs: bool = False
    """Pairs from every pose instead of one after the other."""

    def __post_init__(self) -> None:
        within("[0, inf)", self, "max_offset_s")
        within("(0, inf)", self, "rpe_delta")


@dataclass(frozen=True)
class Comparison:
    """The numbers of `poet-loc evaluate EST.tum REF.tum`."""

    options: CompareOptions
    alignment: Alignment
    estimate: Trajectory
    """Matched and aligned, on the reference's stamps."""
    reference: Trajectory
    """Matched."""
    evaluation: Evaluation
    """One row, `estimate`: the errors per axis."""
    ape: dict[Relation, Statistics]
    rpe: dict[Relation, Statistics]
    rpe_pairs: int


def compare_trajectories(
    estimate: Trajectory, reference: Trajectory, options: CompareOptions | None = None
) -> Comparison:
    """Compare an estimate with a reference of the same body.

    Raises InputError if no stamps match or the alignment asked for is not determined.
    """
    options = options or CompareOptions()
    i, j = match_stamps(estimate.stamps_ns, reference.stamps_ns, round(options.max_offset_s * 1e9))
    if len(i) == 0:
        fix = "check that both use the same clock and seconds, or raise --max-offset-s"
        raise InputError(f"no stamps of the two trajectories match within {options.max_offset_s} s", fix=fix)
    matched_ref = reference[j]
    matched_est = Trajectory(matched_ref.stamps_ns, estimate.T_world_body[i])
    alignment = align(matched_est, matched_ref, options.align)
    aligned = alignment.apply(matched_est)
    span_ns = (int(matched_ref.stamps_ns[0]), int(matched_ref.stamps_ns[-1]))
    evaluation = evaluate([Estimate("estimate", aligned, "cam")], {"cam": reference}, span_ns)
    T_est, T_ref = aligned.T_world_body, matched_ref.T_world_body
    if options.rpe_unit == "m":
        pairs = pairs_by_metres(T_est.translation, options.rpe_delta, options.rpe_all_pairs)
    else:
        pairs = pairs_by_frames(len(T_est), _whole_frames(options.rpe_delta), options.rpe_all_pairs)
    relations: tuple[Relation, ...] = get_args(Relation)
    absolute = relations[:-1]  # a ratio of distances needs pairs
    return Comparison(
        options=options,
        alignment=alignment,
        estimate=aligned,
        reference=matched_ref,
        evaluation=evaluation,
        ape={relation: statistics(absolute_pose_error(T_est, T_ref, relation)) for relation in absolute},
        rpe={relation: statistics(relative_pose_error(T_est, T_ref, pairs, relation)) for relation in relations},
        rpe_pairs=len(pairs[0]),
    )


def _whole_frames(delta: float) -> int:
    if delta < 1 or delta != int(delta):
        raise InputError(f"{delta} frames are no whole number of frames", fix="give --rpe-delta 1, 2, 3 ...")
    return int(delta)
