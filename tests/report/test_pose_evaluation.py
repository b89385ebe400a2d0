"""Evaluation of object poses against the official evaluators' figures, and against made-up mistakes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.io.bop_models import BopModel
from poet_loc.io.bop_results_csv import BopResults, write_bop_results
from poet_loc.io.ply import read_model_points
from poet_loc.io.poet_results import PoetResults, write_poet_results
from poet_loc.report.pose_evaluation import class_errors, evaluate_poses, overall_errors
from poet_loc.report.pose_inputs import EvaluatePosesOptions, ObjectModel
from poet_loc.report.pose_tables import pose_tables

CAMERA = np.array([[100.0, 0, 64], [0, 100.0, 48], [0, 0, 1]])


def official_classes(shared_fixtures: Path):
    folder = shared_fixtures / "poet_official" / "eval"
    with np.load(folder / "evaluator_inputs.npz") as archive:
        inputs = dict(archive)
    classes, pooled = [], []
    for k, (name, symmetric) in enumerate((("alpha", False), ("beta", True), ("gamma", False))):
        info = BopModel(float(inputs["diameters_mm"][k]) / 1000, ((0, 0, 0), (1, 1, 1)))
        model = ObjectModel(name, inputs[f"pts_m_{name}"], info, symmetric) if f"pts_m_{name}" in inputs else None
        if f"pred_{name}" not in inputs or len(inputs[f"pred_{name}"]) == 0:
            model = model or ObjectModel(name, np.zeros((1, 3)), info, symmetric)
            none = RigidTransform.identity(1)[:0]
            classes.append(class_errors(model, none, none, np.zeros((0, 3, 3)), 640, 0, 0))
            continue
        est, ref = (
            make_pose(Rotation.from_matrix(m[:, :, :3]), m[:, :, 3])
            for m in (inputs[f"pred_{name}"], inputs[f"gt_{name}"])
        )
        cameras = np.tile(CAMERA, (len(est), 1, 1))
        classes.append(class_errors(model, est, ref, cameras, 640, len(est), 0))
        pooled.append((est, ref))
    return classes, overall_errors(classes, pooled), folder


def test_official_ycbv_figures(shared_fixtures: Path) -> None:
    classes, overall, folder = official_classes(shared_fixtures)
    official = json.loads((folder / "PoseEvaluator_results.json").read_text())
    for errors in classes[:2]:
        accuracy = official["adds"][errors.name]["accuracy"]
        assert errors.auc_add_or_s == pytest.approx(accuracy["auc"], abs=1e-9)
        assert errors.within_m == pytest.approx([accuracy[k] for k in ("0.02", "0.05", "0.10")])
        assert errors.auc_add == pytest.approx(official["add"][errors.name]["accuracy"]["auc"], abs=1e-9)
        assert errors.auc_add_s == pytest.approx(official["adi"][errors.name]["accuracy"]["auc"], abs=1e-9)
        assert errors.translation_m == pytest.approx(official["avg_t_error"][errors.name])
        assert np.rad2deg(errors.rotation_rad) == pytest.approx(official["avg_rot_error"][errors.name])
    mean = official["adds"]["accuracy"]
    assert overall["auc_add_or_s"] == pytest.approx(mean["auc"], abs=1e-9)
    assert [overall[f"within_{k}cm"] for k in (2, 5, 10)] == pytest.approx([mean[k] for k in ("0.02", "0.05", "0.10")])
    assert overall["auc_add"] == pytest.approx(official["add"]["accuracy"]["auc"], abs=1e-9)
    assert overall["translation_m"] == pytest.approx(official["avg_t_error"]["mean"][0])
    assert np.rad2deg(overall["rotation_rad"]) == pytest.approx(official["avg_rot_error"]["mean"][0])


def test_official_lmo_figures(shared_fixtures: Path) -> None:
    classes, overall, folder = official_classes(shared_fixtures)
    official = json.loads((folder / "PoseEvaluatorLMO_results.json").read_text())["adds"]
    for errors in classes[:2]:
        accuracy = official[errors.name]["accuracy"]
        assert errors.within_diameter == pytest.approx([accuracy[k] for k in ("0.02", "0.05", "0.10")])
    found = [overall[f"within_{k}_percent"] for k in (2, 5, 10)]
    assert found == pytest.approx([official["accuracy"][k] for k in ("0.02", "0.05", "0.10")])


def write_ply(path: Path, points_mm: np.ndarray, binary: bool) -> None:
    kind = "binary_little_endian" if binary else "ascii"
    header = f"ply\nformat {kind} 1.0\nelement vertex {len(points_mm)}\nproperty uchar red\n"
    header += "property float x\nproperty float y\nproperty float z\nelement face 1\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    if binary:
        rows = np.zeros(len(points_mm), [("red", "u1"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
        rows["x"], rows["y"], rows["z"] = points_mm.T
        path.write_bytes(header.encode() + rows.tobytes() + b"\x03\0\0\0\0\0\0\0\0\0\0\0\0")
    else:
        path.write_text(header + "".join(f"7 {x} {y} {z}\n" for x, y, z in points_mm) + "3 0 1 2\n")


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """Two images with object 1 twice and object 2 once; models of both, one symmetric."""
    rng = np.random.default_rng(0)
    (tmp_path / "models").mkdir()
    infos = {}
    for number in (1, 2):
        points = rng.normal(size=(60, 3)) * 30
        points = np.concatenate([points, points * [-1, -1, 1]]) if number == 2 else points
        write_ply(tmp_path / f"models/obj_{number:06d}.ply", points, binary=number == 2)
        infos[number] = {"diameter": 200.0, **{f"{k}_{a}": 1.0 for k in ("min", "size") for a in "xyz"}}
    infos[2]["symmetries_discrete"] = [np.diag([-1.0, -1, 1, 1]).ravel().tolist()]
    (tmp_path / "models/models_info.json").write_text(json.dumps(infos))
    scene = tmp_path / "test/000003"
    scene.mkdir(parents=True)
    truth, info = {}, {}
    for image in (1, 2):
        truth[image], info[image] = [], []
        for k, number in enumerate((1, 1, 2)):
            rotation = Rotation.random(rng=rng).as_matrix().ravel().tolist()
            truth[image].append(
                {"obj_id": number, "cam_R_m2c": rotation, "cam_t_m2c": [200.0 * k, 10.0 * image, 900.0]}
            )
            info[image].append({"visib_fract": 0.9, "bbox_obj": [1, 1, 5, 5], "bbox_visib": [1, 1, 5, 5]})
    cameras = {image: {"cam_K": CAMERA.ravel().tolist(), "depth_scale": 1.0} for image in (1, 2)}
    for name, content in (("scene_camera", cameras), ("scene_gt", truth), ("scene_gt_info", info)):
        (scene / f"{name}.json").write_text(json.dumps(content))
    return tmp_path


def perfect(split: Path) -> BopResults:
    truth = json.loads((split / "test/000003/scene_gt.json").read_text())
    rows = [(int(image), entry) for image, entries in truth.items() for entry in reversed(entries)]
    return BopResults(
        np.full(len(rows), 3),
        np.array([image for image, _ in rows]),
        np.array([entry["obj_id"] for _, entry in rows]),
        np.ones(len(rows)),
        make_pose(
            Rotation.from_matrix([np.reshape(entry["cam_R_m2c"], (3, 3)) for _, entry in rows]),
            np.array([entry["cam_t_m2c"] for _, entry in rows]) / 1000,
        ),
        np.full(len(rows), 0.1),
    )


def evaluated(split: Path, results: BopResults):
    write_bop_results(split / "results.csv", results)
    return evaluate_poses([split / "results.csv"], split / "test", EvaluatePosesOptions(split / "models"))[0]


def test_perfect_results(split: Path) -> None:
    found = evaluated(split, perfect(split))
    assert [c.matched for c in found.classes] == [4, 2]
    assert [c.missed + c.false for c in found.classes] == [0, 0]
    assert found.overall["auc_add_or_s"] == pytest.approx(99.858, abs=1e-3)
    assert found.overall["auc_add_or_s_exact"] == pytest.approx(100.0)
    assert found.overall["recall_mssd"] == found.overall["recall_mspd"] == 100.0


def test_results_json_is_evaluated_too(split: Path) -> None:
    results = perfect(split)
    (split / "classes.json").write_text('{"1": "first", "2": "second"}')
    images = np.unique(results.image_ids)
    found = PoetResults(
        tuple(f"{image:06d}" for image in images),
        np.searchsorted(images, results.image_ids),
        results.object_ids,
        results.T_cam_obj,
        np.full((len(results), 4), 0.5),
    )
    write_poet_results(split / "results.json", found)
    options = EvaluatePosesOptions(split / "models", names=split / "classes.json", scene=3)
    evaluation = evaluate_poses([split / "results.json"], split / "test", options)[0]
    assert [c.name for c in evaluation.classes] == ["first", "second"]
    assert evaluation.overall["auc_add_or_s_exact"] == pytest.approx(100.0)
    with pytest.raises(InputError, match="does not tell its scene"):
        evaluate_poses([split / "results.json"], split / "test", replace(options, scene=None))


def test_a_half_turn_of_the_symmetric_object_is_no_error(split: Path) -> None:
    results = perfect(split)
    half_turn = RigidTransform.from_rotation(Rotation.from_rotvec([0, 0, np.pi]))
    rows = [pose * half_turn if i == 2 else pose for pose, i in zip(results.T_cam_obj, results.object_ids)]
    found = evaluated(split, replace(results, T_cam_obj=RigidTransform.concatenate(rows))).classes[1]
    assert found.auc_add_or_s_exact == pytest.approx(100.0)
    assert found.rotation_rad == pytest.approx(np.pi)
    assert found.rotation_reduced_rad == pytest.approx(0.0, abs=1e-6)
    assert found.turn_rad == pytest.approx(np.pi)
    assert found.axis_tilt_rad == pytest.approx(0.0, abs=1e-6)
    assert found.recall_mssd == 100.0


def test_missed_and_false_detections_count(split: Path) -> None:
    results = perfect(split)
    keep = np.array([0, 1, 3, 4, 5])  # one object 1 of the first image is missing
    some = BopResults(
        *(getattr(results, n)[keep] for n in ("scene_ids", "image_ids", "object_ids", "scores", "T_cam_obj", "times_s"))
    )
    wrong = make_pose(some.T_cam_obj.rotation, some.T_cam_obj.translation + [0, 0, 5.0])
    both = BopResults(
        *(np.concatenate([getattr(some, n)] * 2) for n in ("scene_ids", "image_ids", "object_ids")),
        np.concatenate([np.ones(5), np.full(5, 0.3)]),
        RigidTransform.concatenate([some.T_cam_obj, wrong]),
        np.zeros(10),
    )
    first, second = evaluated(split, both).classes
    assert (first.true, first.matched, first.missed, first.false) == (4, 4, 0, 2)  # the spare one takes the gap
    assert (second.true, second.matched, second.missed, second.false) == (2, 2, 0, 2)
    first, second = evaluated(split, some).classes
    assert (first.matched, first.missed, first.false) == (3, 1, 0)
    assert first.recall_mssd == 75.0
    assert first.auc_add_or_s_exact == pytest.approx(100.0)


def test_tables_have_a_row_per_class_and_a_group_per_file(split: Path) -> None:
    write_bop_results(split / "gt.csv", perfect(split))
    write_bop_results(split / "detected.csv", perfect(split))
    options = EvaluatePosesOptions(split / "models")
    tables = pose_tables(evaluate_poses([split / "gt.csv", split / "detected.csv"], split / "test", options))
    assert [len(table.rows) for table in tables] == [3] * 4
    assert {c.group for c in tables[0].columns} == {"", "gt", "detected"}
    assert "99.86" in tables[0].markdown()
    assert all(table.latex() and table.markdown() for table in tables)
    assert "gt ADD-S [%]" in tables[0].markdown()
    assert "detected ADD-S [%]" in tables[0].markdown()


def test_files_of_one_name_are_told_apart_by_their_folders(split: Path) -> None:
    for folder in ("true_boxes", "detected_boxes"):
        (split / folder).mkdir()
        write_bop_results(split / folder / "bop_results.csv", perfect(split))
    files = [split / folder / "bop_results.csv" for folder in ("true_boxes", "detected_boxes")]
    found = evaluate_poses(files, split / "test", EvaluatePosesOptions(split / "models"))
    assert [e.name for e in found] == ["true_boxes", "detected_boxes"]


def test_models_in_text_and_binary(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(20, 3)) * 50
    for binary in (False, True):
        write_ply(tmp_path / "m.ply", points, binary)
        np.testing.assert_allclose(read_model_points(tmp_path / "m.ply"), points / 1000, atol=1e-8)
    (tmp_path / "bad.ply").write_text("solid stl")
    with pytest.raises(InputError, match="not a PLY model"):
        read_model_points(tmp_path / "bad.ply")


def test_mistakes(split: Path) -> None:
    write_bop_results(split / "r.csv", replace(perfect(split), scene_ids=np.full(6, 9)))
    options = EvaluatePosesOptions(split / "models")
    with pytest.raises(InputError, match="has no scene of test"):
        evaluate_poses([split / "r.csv"], split / "test", options)
    with pytest.raises(InputError, match="no folders like"):
        evaluate_poses([split / "r.csv"], split / "models", options)
    with pytest.raises(InputError, match="visible enough"):
        evaluate_poses([split / "r.csv"], split / "test", replace(options, least_visible=0.95))
