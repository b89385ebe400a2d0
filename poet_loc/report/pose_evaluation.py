"""Object poses of a results file against the truth, class by class: the stage behind `poet-loc evaluate-poses`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import RigidTransform

from poet_loc.core.input_error import InputError
from poet_loc.core.object_errors import (
    add,
    add_s,
    area_under_curve,
    area_under_curve_published,
    average_rotation_error,
    average_translation_error,
)
from poet_loc.core.symmetric_errors import (
    RECALL_PIXELS,
    RECALL_SHARES,
    average_recall,
    axis_tilt,
    mspd,
    mssd,
    rotation_angle_up_to_symmetry,
    symmetry_transforms,
    turn_about_axis,
)
from poet_loc.io.bop_results_csv import BopResults
from poet_loc.report.pose_inputs import (
    EvaluatePosesOptions,
    ObjectModel,
    Truth,
    read_models,
    read_results,
    read_truth,
)
from poet_loc.report.visible_surface import VisibleSurface

Array = NDArray[np.float64]
Places = dict[tuple[int, int, int], list[int]]

YCBV_THRESHOLDS_M = (0.02, 0.05, 0.10)
LMO_THRESHOLDS = (0.02, 0.05, 0.10)
"""In shares of the diameter."""


@dataclass(frozen=True)
class ClassErrors:
    """Errors of one class: of its matched objects, and what was missed or made up."""

    name: str
    true: int
    """Objects that are there."""
    matched: int
    missed: int
    false: int
    """Estimates without an object."""
    auc_add: float
    """Percent, up to 10 cm, the published Simpson rule; likewise the next two."""
    auc_add_s: float
    auc_add_or_s: float
    """ADD(-S): ADD-S for symmetric objects, else ADD."""
    auc_add_or_s_exact: float
    """The exact integral."""
    within_m: tuple[float, ...]
    """Percent of ADD(-S) below 2, 5, 10 cm."""
    within_diameter: tuple[float, ...]
    """Percent of ADD(-S) below 2, 5, 10 % of the diameter."""
    translation_m: float
    """Mean distance."""
    rotation_rad: float
    """Mean angle."""
    rotation_reduced_rad: float
    """Mean angle to the nearest rotation that looks like the true one."""
    axis_tilt_rad: float
    """Mean angle between the symmetry axes; NaN without one."""
    turn_rad: float
    """Mean turn about the symmetry axis; NaN without one."""
    recall_mssd: float
    """BOP's average recall, missed objects counted, percent."""
    recall_mspd: float
    recall_vsd: float
    """NaN where it was not measured."""


@dataclass(frozen=True)
class PoseEvaluation:
    """One results file against the truth."""

    name: str
    classes: tuple[ClassErrors, ...]
    overall: dict[str, float] = field(default_factory=dict)
    """Means over the classes (those without an estimate count as 0, as published), and pooled errors."""

    def to_json(self) -> dict[str, object]:
        """Return all numbers, None where there is none."""
        classes = [{key: _or_none(value) for key, value in asdict(c).items()} for c in self.classes]
        return {"name": self.name, "classes": classes, "overall": self.overall}


def evaluate_poses(results: Sequence[Path], truth: str | Path, options: EvaluatePosesOptions) -> list[PoseEvaluation]:
    """Compare results files (BOP csv, or PoET's results.json) with a BOP split folder.

    In every image the estimates of an object are assigned to its instances by distance, the best scores first where
    there are more estimates than instances.  Raises InputError for files that do not fit each other.
    """
    there = read_truth(truth, options)
    models = read_models(options, sorted(set(there.object_ids.tolist())))
    surface = None if options.vsd == "none" else VisibleSurface(Path(truth), options.models, options.vsd)
    stems = [Path(path).stem for path in results]
    found = []
    for path, stem in zip(results, stems):
        name = stem if stems.count(stem) == 1 else Path(path).absolute().parent.name
        estimates = read_results(path, options)
        if not set(estimates.scene_ids.tolist()) & set(there.scene_ids.tolist()):
            raise InputError(f"has no scene of {Path(truth).name}", path=path)
        found.append(compare(name, estimates, there, models, surface))
    return found


def compare(
    name: str,
    estimates: BopResults,
    truth: Truth,
    models: Mapping[int, ObjectModel],
    surface: VisibleSurface | None = None,
) -> PoseEvaluation:
    """Match estimates with the truth and measure them; with `surface` also how much of what is visible agrees."""
    images = set(zip(truth.scene_ids.tolist(), truth.image_ids.tolist()))
    est_rows, ref_rows = match_estimates(estimates, truth)
    seen = None if surface is None else surface_errors(surface, estimates, truth, models, est_rows, ref_rows)
    classes, pooled = [], []
    for number, model in models.items():
        chosen = truth.object_ids[ref_rows] == number
        est, ref = estimates.T_cam_obj[est_rows[chosen]], truth.T_cam_obj[ref_rows[chosen]]
        there = int(np.count_nonzero(truth.object_ids == number))
        told = [
            (scene, image) in images
            for scene, image, i in zip(estimates.scene_ids.tolist(), estimates.image_ids.tolist(), estimates.object_ids)
            if i == number
        ]
        cameras = truth.cameras[ref_rows[chosen]]
        errors = class_errors(model, est, ref, cameras, truth.image_width, there, sum(told) - len(est))
        if seen is not None:
            recalls = [average_recall(column, RECALL_SHARES, there) for column in seen[chosen].T]
            errors = replace(errors, recall_vsd=float(np.mean(recalls)))
        classes.append(errors)
        pooled.append((est, ref))
    return PoseEvaluation(name, tuple(classes), overall_errors(classes, pooled))


def surface_errors(
    surface: VisibleSurface,
    estimates: BopResults,
    truth: Truth,
    models: Mapping[int, ObjectModel],
    est_rows: NDArray[np.intp],
    ref_rows: NDArray[np.intp],
) -> Array:
    """Return VSD of pairs of rows, one column for each tolerance of `RECALL_SHARES` of the diameter (K, 10)."""
    errors = np.empty((len(est_rows), len(RECALL_SHARES)))
    for k, (i, j) in enumerate(zip(est_rows.tolist(), ref_rows.tolist(), strict=True)):
        number = int(truth.object_ids[j])
        place = int(truth.scene_ids[j]), int(truth.image_ids[j])
        taus = np.array(RECALL_SHARES) * models[number].info.diameter_m
        errors[k] = surface.errors(place, number, estimates.T_cam_obj[i], truth.T_cam_obj[j], taus)
    return errors


def match_estimates(estimates: BopResults, truth: Truth) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return pairs of rows (estimate, truth)."""
    est = _places(estimates.scene_ids, estimates.image_ids, estimates.object_ids)
    ref = _places(truth.scene_ids, truth.image_ids, truth.object_ids)
    pairs: list[tuple[int, int]] = []
    for place, true_rows in ref.items():
        rows = sorted(est.get(place, []), key=lambda row: -estimates.scores[row])[: len(true_rows)]
        if not rows:
            continue
        a, b = estimates.T_cam_obj[np.array(rows)].translation, truth.T_cam_obj[np.array(true_rows)].translation
        for i, j in zip(*linear_sum_assignment(np.linalg.norm(a[:, None] - b[None], axis=-1)), strict=True):
            pairs.append((rows[i], true_rows[j]))
    index = np.array(pairs, np.intp).reshape(-1, 2)
    return index[:, 0], index[:, 1]


def class_errors(
    model: ObjectModel, est: RigidTransform, ref: RigidTransform, cameras: Array, width: int, true: int, false: int
) -> ClassErrors:
    """Measure the matched poses of one class."""
    counts = model.name, true, len(est), true - len(est), false
    if len(est) == 0:
        nan = float("nan")
        return ClassErrors(*counts, 0.0, 0.0, 0.0, 0.0, (0.0,) * 3, (0.0,) * 3, nan, nan, nan, nan, nan, 0.0, 0.0, nan)
    distances, nearest = add(est, ref, model.points), add_s(est, ref, model.points)
    chosen = nearest if model.symmetric else distances
    symmetry, info = model.info.symmetry, model.info
    turned = est.rotation, ref.rotation
    alike = symmetry_transforms(info.symmetries_discrete, info.symmetries_continuous, step=0.05)
    surface = mssd(est, ref, model.points, alike) / info.diameter_m
    pixels = np.array(
        [mspd(est[i : i + 1], ref[i : i + 1], model.points, alike, cameras[i])[0] for i in range(len(est))]
    )
    thresholds = [pixel * width / 640.0 for pixel in RECALL_PIXELS]
    return ClassErrors(
        *counts,
        area_under_curve_published(distances),
        area_under_curve_published(nearest),
        area_under_curve_published(chosen),
        area_under_curve(chosen),
        shares_below(chosen, YCBV_THRESHOLDS_M),
        shares_below(chosen, [share * info.diameter_m for share in LMO_THRESHOLDS]),
        average_translation_error(est, ref),
        average_rotation_error(est, ref),
        float(rotation_angle_up_to_symmetry(*turned, symmetry).mean()),
        float("nan") if symmetry is None else float(axis_tilt(*turned, symmetry.axis).mean()),
        float("nan") if symmetry is None else float(turn_about_axis(*turned, symmetry.axis).mean()),
        average_recall(surface, RECALL_SHARES, true),
        average_recall(pixels, thresholds, true),
        float("nan"),
    )


def shares_below(errors: Array, thresholds: Sequence[float]) -> tuple[float, ...]:
    """Return the percentage of errors below each threshold."""
    return tuple(100.0 * float(np.mean(errors < threshold)) for threshold in thresholds)


def overall_errors(
    classes: Sequence[ClassErrors], pooled: Sequence[tuple[RigidTransform, RigidTransform]]
) -> dict[str, float]:
    """Return means over the classes, and mean translation and rotation errors over all poses, as published."""
    names = ("auc_add", "auc_add_s", "auc_add_or_s", "auc_add_or_s_exact", "recall_mssd", "recall_mspd")
    overall = {name: float(np.mean([getattr(c, name) for c in classes])) for name in names}
    if classes and not np.isnan([c.recall_vsd for c in classes]).any():
        overall["recall_vsd"] = float(np.mean([c.recall_vsd for c in classes]))
        overall["recall"] = float(np.mean([overall[f"recall_{name}"] for name in ("mssd", "mspd", "vsd")]))
    for k, share in enumerate(YCBV_THRESHOLDS_M):
        overall[f"within_{round(100 * share)}cm"] = float(np.mean([c.within_m[k] for c in classes]))
        overall[f"within_{round(100 * share)}_percent"] = float(np.mean([c.within_diameter[k] for c in classes]))
    some = [(est, ref) for est, ref in pooled if len(est)]
    if some:
        est = RigidTransform.concatenate([e for e, _ in some])
        ref = RigidTransform.concatenate([r for _, r in some])
        overall["translation_m"] = average_translation_error(est, ref)
        overall["rotation_rad"] = average_rotation_error(est, ref)
        matched = [c for c in classes if c.matched]
        weights = [c.matched for c in matched]
        overall["rotation_reduced_rad"] = float(np.average([c.rotation_reduced_rad for c in matched], weights=weights))
    for name in ("true", "matched", "missed", "false"):
        overall[name] = float(sum(getattr(c, name) for c in classes))
    return overall


def _or_none(value: object) -> object:
    return None if isinstance(value, float) and np.isnan(value) else value


def _places(scenes: NDArray[np.int64], images: NDArray[np.int64], objects: NDArray[np.int64]) -> Places:
    places: Places = defaultdict(list)
    for row, place in enumerate(zip(scenes.tolist(), images.tolist(), objects.tolist(), strict=True)):
        places[place].append(row)
    return places
