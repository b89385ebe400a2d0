"""What a checkpoint does on the test videos: the figures of its model card."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.input_error import InputError
from poet_loc.core.object_errors import add_s, area_under_curve
from poet_loc.core.records import ObjectPoses
from poet_loc.data.packed import ObjectModels, load_models
from poet_loc.io.bop import BopScene, read_bop_scene
from poet_loc.io.frames_csv import read_frames
from poet_loc.model.checkpoint import load_model
from poet_loc.model.embedded import EMBEDDED_WEIGHTS
from poet_loc.train.average_precision import mean_average_precision
from poet_loc.train.embedded import Boxes
from poet_loc.train.video_poses import VideoPoses, poses_of_video, true_boxes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MeasureOptions:
    """Which checkpoint to measure on which videos."""

    videos: Path
    """Folder of rendered videos, with models/ (poet-loc render videos)."""
    weights: Path = EMBEDDED_WEIGHTS
    """Checkpoint (safetensors); without it the embedded one."""
    write_poses: bool = True
    """Write object_poses_bb.csv and object_poses_gt.csv into the videos' folders, objects of the map alone."""
    rounds: int | None = None
    """Rounds of the refiner; 0: none, without it as many as the weights were made for."""
    least_visible: float = 0.1
    """Objects less visible than this share are not asked for."""
    jobs: int = 1
    """Processes."""
    progress: bool = True
    """Show a progress bar."""


@dataclass(frozen=True)
class PoseScores:
    """Errors of every object that was there; what was missed has infinite errors."""

    object_ids: NDArray[np.int64]
    translation_m: Array
    rotation_rad: Array
    """About a symmetry axis the axis' error."""
    add_s_m: Array
    error: Array
    """(N, 6) translation and rotation vector in camera axes; nan where missed."""
    sigma: Array
    """(N, 6) what the network claims."""


@dataclass(frozen=True)
class Figures:
    """All that the card says."""

    scores: dict[Boxes, PoseScores]
    mean_average_precision: float
    """IoU 0.5, over whole (amodal) boxes."""
    mean_average_precision_coco: float
    """Mean over IoU 0.5, 0.55 .. 0.95."""
    frames: int
    names: dict[int, str] = field(default_factory=dict)
    silhouette_symmetric: tuple[int, ...] = ()


def measure(options: MeasureOptions) -> Figures:
    """Run a checkpoint over all videos and compare with the truth."""
    from poet_loc.data.world.objects import household_objects
    from poet_loc.io.landmarks_json import read_landmarks
    from poet_loc.io.object_poses_csv import write_object_poses

    folders = sorted(path.parent for path in options.videos.glob("*/frames.csv"))
    if not folders:
        raise InputError("has no rendered videos", path=options.videos, fix="poet-loc render videos --out FOLDER")
    models = load_models(options.videos / "models")
    names = {int(k): v for k, v in json.loads((options.videos / "models" / "names.json").read_text()).items()}
    parts: dict[Boxes, list[PoseScores]] = {"bb": [], "gt": []}
    detections: list[Array] = []
    truth: list[Array] = []
    for folder, found in _poses_of_videos(options, folders):
        scene, frames = read_bop_scene(folder), read_frames(folder / "frames.csv")
        for kind, poses in found.poses.items():
            parts[kind].append(score_poses(poses, scene, models, options.least_visible))
            if options.write_poses:
                on_map = np.isin(poses.object_ids, read_landmarks(folder / "landmarks.json").object_ids)
                write_object_poses(folder / f"object_poses_{kind}.csv", poses[on_map])
        detections += found.detections
        truth += [_boxes_with_class(scene, row, options.least_visible) for row in range(len(frames))]
    coco = tuple(np.arange(0.5, 1.0, 0.05))
    return Figures(
        {kind: _joined(rows) for kind, rows in parts.items()},
        mean_average_precision(detections, truth),
        mean_average_precision(detections, truth, coco),
        len(truth),
        names,
        tuple(thing.object_id for thing in household_objects() if thing.silhouette_symmetric),
    )


def _poses_of_videos(options: MeasureOptions, folders: Sequence[Path]) -> Iterator[tuple[Path, VideoPoses]]:
    from joblib import Parallel, delayed

    from poet_loc.data.render import progress_bar

    workers = Parallel(n_jobs=options.jobs, return_as="generator")
    found = workers(delayed(_poses_of)(options.weights, options.rounds, folder) for folder in folders)
    with progress_bar("measuring", "videos", len(folders), options.progress) as advance:
        for folder, poses in zip(folders, found, strict=True):
            yield folder, poses
            advance(1)


def _poses_of(weights: Path, rounds: int | None, folder: Path) -> VideoPoses:
    network, config = load_model(weights)
    network.refine_in(rounds)
    return poses_of_video(network, config, folder)


def _boxes_with_class(scene: BopScene, row: int, least_visible: float) -> Array:
    rows = true_boxes(scene, row, least_visible).double().numpy()
    return np.asarray(rows[:, [0, 1, 2, 3, 5]])


def score_poses(poses: ObjectPoses, scene: BopScene, models: ObjectModels, least_visible: float) -> PoseScores:
    """Compare a video's poses with every object that is visible enough; the best-scored row of each counts."""
    found = scene.annotations
    assert found is not None
    assert found.visible_fractions is not None
    asked = np.concatenate([true_boxes(scene, row, least_visible)[:, 5].numpy() for row in range(len(scene))])
    frame_of = np.repeat(np.arange(len(scene)), [len(true_boxes(scene, r, least_visible)) for r in range(len(scene))])
    annotated = {(int(i), int(o)): row for row, (i, o) in enumerate(zip(found.image_ids, found.object_ids))}
    answer: dict[tuple[int, int], int] = {}
    for row in np.argsort(poses.scores, kind="stable"):
        answer[int(poses.frames[row]), int(poses.object_ids[row])] = int(row)
    keys = [(int(frame), int(label)) for frame, label in zip(frame_of, asked)]
    count = len(keys)
    error, sigma = np.full((count, 6), np.nan), np.full((count, 6), np.nan)
    add_s_m = np.full(count, np.inf)
    there = np.array([key in answer for key in keys], bool)
    rows, refs = [answer[k] for k in keys if k in answer], [annotated[k] for k in keys if k in answer]
    labels = np.array([key[1] for key in keys], np.int64)
    if rows:
        est, ref = poses.T_cam_obj[np.array(rows)], found.T_cam_obj[np.array(refs)]
        error[there] = _errors(est, ref, models.symmetry_axes[labels[there] - 1])
        add_s_m[there] = _add_s(est, ref, labels[there], models)
        if poses.covariances is not None:
            spread = np.sqrt(np.einsum("nii->ni", poses.covariances[np.array(rows)]))
            sigma[there] = np.concatenate([spread[:, 3:], spread[:, :3]], 1)
    distance, angle = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    missed = np.isnan(distance)
    return PoseScores(
        labels, np.where(missed, np.inf, distance), np.where(missed, np.inf, angle), add_s_m, error, sigma
    )


def _errors(est: RigidTransform, ref: RigidTransform, axes: Array) -> Array:
    """(N, 6) translation and rotation vector of R_est = Exp(e) R_ref, in camera axes; the tilt of a symmetry axis."""
    rotation = (est.rotation * ref.rotation.inv()).as_rotvec()
    symmetric = np.abs(axes).sum(1) > 0
    if symmetric.any():
        a, b = ref.rotation[symmetric].apply(axes[symmetric]), est.rotation[symmetric].apply(axes[symmetric])
        cross = np.cross(a, b)
        sine = np.linalg.norm(cross, axis=1)
        angle = np.arctan2(sine, (a * b).sum(1))
        rotation[symmetric] = cross / np.maximum(sine, 1e-12)[:, None] * angle[:, None]
    return np.concatenate([est.translation - ref.translation, rotation], 1)


def _add_s(est: RigidTransform, ref: RigidTransform, labels: NDArray[np.int64], models: ObjectModels) -> Array:
    result = np.zeros(len(labels))
    for label in np.unique(labels):
        chosen = np.flatnonzero(labels == label)
        result[chosen] = add_s(est[chosen], ref[chosen], models.surface[label - 1])
    return result


def _joined(parts: Sequence[PoseScores]) -> PoseScores:
    names = ("object_ids", "translation_m", "rotation_rad", "add_s_m", "error", "sigma")
    return PoseScores(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def card_table(figures: Figures) -> str:
    """Return the figures as Markdown: medians with everything asked for, misses included, per object and in all."""
    lines = [
        f"{figures.frames} frames; mAP {100 * figures.mean_average_precision:.1f} at IoU 0.5, "
        f"{100 * figures.mean_average_precision_coco:.1f} at 0.5:0.95.",
        "",
        "| object | boxes | asked | found % | t cm | r deg | AUC ADD-S |",
        "|---|---|--:|--:|--:|--:|--:|",
    ]
    for kind, scores in figures.scores.items():
        for label in np.unique(scores.object_ids):
            lines.append(_row(figures.names.get(int(label), str(label)), kind, scores, scores.object_ids == label))
    for kind, scores in figures.scores.items():
        lines.append(_row("**all**", kind, scores, np.ones(len(scores.object_ids), bool)))
        plain = ~np.isin(scores.object_ids, figures.silhouette_symmetric)
        lines.append(_row("**without silhouette symmetry**", kind, scores, plain))
    lines += ["", "| boxes | within one sigma, x y z | about x y z |", "|---|---|---|"]
    for kind, scores in figures.scores.items():
        there = ~np.isnan(scores.error[:, 0])
        inside = 100 * (np.abs(scores.error) < scores.sigma)[there].sum(axis=0) / max(int(there.sum()), 1)
        lines.append(f"| {kind} | {_percents(inside[:3])} | {_percents(inside[3:])} |")
    return "\n".join(lines)


def _row(name: str, kind: str, scores: PoseScores, chosen: NDArray[np.bool_]) -> str:
    found = 100 * np.isfinite(scores.translation_m[chosen]).mean()
    t, r = 100 * np.median(scores.translation_m[chosen]), np.rad2deg(np.median(scores.rotation_rad[chosen]))
    auc = area_under_curve(np.minimum(scores.add_s_m[chosen], 1.0))
    return f"| {name} | {kind} | {int(chosen.sum())} | {found:.1f} | {t:.2f} | {r:.1f} | {auc:.1f} |"


def _percents(values: Array) -> str:
    return " ".join(f"{value:.0f} %" for value in values)


def full_card(options: MeasureOptions, figures: Figures, log: Path) -> str:
    """Return the whole model card as Markdown: what the checkpoint is, its figures, its curve from log.jsonl."""
    _, config = load_model(options.weights, with_detector=False)
    source = config.source
    stages = ", ".join(
        f"{name} {entry['step']:.0f} steps in {entry['cpu_minutes']:.0f} CPU minutes"
        for name, entry in source.items()
        if isinstance(entry, dict) and "step" in entry
    )
    lines = [
        "# Model card: embedded",
        "",
        f"{'Small detector and PoET' if config.refiner is None else 'Small detector, PoET and refiner'} for the ten "
        f"rendered household objects (ids 1..10: {', '.join(config.object_names)}), weights in float16.",
        "",
        f"- Trained from scratch by `poet-loc train --preset embedded`: {stages}.",
        f"- Seeds: data 0, weights 0. {source.get('data', '')}".rstrip(),
        f"- {source.get('machine', '')}".rstrip(),
        f"- Sigmas calibrated on {source.get('images', '?')} validation images for "
        f"{'the true' if source.get('calibrated_for') == 'gt' else 'detected'} boxes; "
        f"factors {source.get('temperatures', '?')} (translation x y z, rotation x y z).",
        *(
            f"- Within one sigma there, {kind} boxes: {_percents(100 * np.array(shares))}."
            for kind, shares in source.get("coverage", {}).items()
        ),
        "- Knows the rendered world alone: real photographs are another domain.",
        "",
        "## Test videos",
        f"`poet-loc model-card --videos FOLDER`; objects at least {100 * options.least_visible:.0f} % visible, "
        "missed ones count as infinitely wrong.",
        "",
        card_table(figures),
        "",
        "## Curve",
        "Running means of the losses (pose losses summed over the decoder's layers) by optimiser step.",
        "",
        "| step | CPU min | centre | depth | rotation | heat | sides | points |",
        "|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    kept = rows[:: max(len(rows) // 12, 1)]
    for row in kept if kept[-1] is rows[-1] else [*kept, rows[-1]]:
        values = " | ".join(f"{row[name]:.3f}" for name in ("centre", "depth", "rotation", "heat", "sides", "points"))
        lines.append(f"| {row['step']:.0f} | {row['cpu_minutes']:.1f} | {values} |")
    return "\n".join(lines) + "\n"
