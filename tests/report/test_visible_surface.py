"""BOP's visible surface discrepancy against rays cast one by one, and through `evaluate_poses`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.symmetric_errors import RECALL_SHARES
from poet_loc.data.world.rasterizer import distance_image
from poet_loc.io.bop_results_csv import BopResults, write_bop_results
from poet_loc.io.ply import read_model_mesh
from poet_loc.report.pose_evaluation import evaluate_poses
from poet_loc.report.pose_inputs import EvaluatePosesOptions
from poet_loc.report.pose_tables import pose_tables
from poet_loc.report.visible_surface import VisibleSurface

CAMERA = np.array([[60.0, 0, 31.3], [0, 62.0, 23.8], [0, 0, 1]])
WIDTH, HEIGHT = 64, 48
DIAMETER_M = 0.25
BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.08, 0.06, 0.075]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = [t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))]
SCENE = make_pose(Rotation.from_euler("xyz", [[0.4, 0.3, 0.2], [0.1, -0.7, 0.5]]), [[0.0, 0.02, 0.8], [0.09, 0.0, 0.6]])


def cast(points: np.ndarray) -> np.ndarray:
    """Distance to the nearest triangle along each pixel's ray (T. Moeller, B. Trumbore, 1997), 0 where none is hit."""
    seen = np.zeros((HEIGHT, WIDTH))
    for y in range(HEIGHT):
        for x in range(WIDTH):
            ray = np.linalg.solve(CAMERA, [x, y, 1.0])
            ray /= np.linalg.norm(ray)
            hits = []
            for corners in TRIANGLES:
                a, b, c = points[list(corners)]
                system = np.stack([b - a, c - a, -ray], axis=-1)
                if abs(np.linalg.det(system)) > 1e-12:
                    s, t, distance = np.linalg.solve(system, -a)
                    if min(s, t) >= 0 and s + t <= 1 and distance > 0:
                        hits.append(distance)
            seen[y, x] = min(hits, default=0.0)
    return seen


def vsd_by_pixel(est: np.ndarray, ref: np.ndarray, scene: np.ndarray, tau: float) -> float:
    """The benchmark's definition, pixel by pixel."""

    def visible(model: float, surface: float) -> bool:
        return model > 0 and (surface == 0 or model - surface <= 0.015)

    costs = []
    for e, r, s in zip(est.ravel(), ref.ravel(), scene.ravel()):
        in_ref = visible(r, s)
        in_est = visible(e, s) or (in_ref and e > 0)
        if in_ref and in_est:
            costs.append(0.0 if abs(e - r) < tau else 1.0)
        elif in_ref or in_est:
            costs.append(1.0)
    return float(np.mean(costs)) if costs else 1.0


def write_split(root: Path, depth: np.ndarray | None) -> None:
    """One image of two equal boxes, one before the other."""
    (root / "models").mkdir()
    header = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 6\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(repr, row)) for row in (BOX * 1000).tolist()]
    rows += ["4 " + " ".join(map(str, quad)) for quad in QUADS]
    (root / "models/obj_000001.ply").write_text(header + "\n".join(rows) + "\n")
    info = {"diameter": DIAMETER_M * 1000, **{f"{kind}_{axis}": 1.0 for kind in ("min", "size") for axis in "xyz"}}
    (root / "models/models_info.json").write_text(json.dumps({"1": info}))
    scene = root / "test/000002"
    (scene / "rgb").mkdir(parents=True)
    Image.new("RGB", (WIDTH, HEIGHT)).save(scene / "rgb/000005.png")
    truth = [
        {"obj_id": 1, "cam_R_m2c": pose.rotation.as_matrix().ravel().tolist(), "cam_t_m2c": (t * 1000).tolist()}
        for pose, t in zip(SCENE, SCENE.translation)
    ]
    camera = {"cam_K": CAMERA.ravel().tolist(), "depth_scale": 0.1}
    for name, content in (("scene_gt", truth), ("scene_camera", camera)):
        (scene / f"{name}.json").write_text(json.dumps({"5": content}))
    if depth is not None:
        (scene / "depth").mkdir()
        Image.fromarray((depth * 1e4).round().astype(np.uint16)).save(scene / "depth/000005.png")


def depth_of(distance: np.ndarray) -> np.ndarray:
    """z of points at a distance along their rays."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(CAMERA).T
    return distance / np.linalg.norm(rays, axis=-1)


@pytest.fixture(scope="module")
def scene_distance() -> np.ndarray:
    seen = np.stack([cast(pose.apply(BOX)) for pose in SCENE])
    return np.where(seen > 0, seen, np.inf).min(axis=0)


@pytest.fixture
def split(tmp_path: Path, scene_distance: np.ndarray) -> Path:
    """A wall stands 3 m behind; the sensor is blind in a corner."""
    depth = depth_of(np.where(np.isfinite(scene_distance), scene_distance, 3.0))
    depth[:20, :20] = 0.0
    write_split(tmp_path, depth)
    return tmp_path


def moved(angle: float = 0.15, shift: tuple[float, float, float] = (0.01, 0.0, 0.02)) -> RigidTransform:
    turn = Rotation.from_rotvec([angle, -angle, angle / 2])
    return make_pose(SCENE.rotation * turn, SCENE.translation + shift)


def test_distances_are_those_of_rays() -> None:
    points = SCENE[0].apply(BOX)
    window = (5, 3, 50, 40)
    found = distance_image(points, np.array(TRIANGLES, np.int32), CAMERA, window)
    expected = cast(points)[3:43, 5:55]
    both = (found > 0) & (expected > 0)
    assert both.sum() > 150
    assert ((found > 0) != (expected > 0)).mean() < 0.002  # pixels on an edge
    np.testing.assert_allclose(found[both], expected[both], atol=2e-6)


@pytest.mark.parametrize("source", ["depth", "rendered"])
def test_discrepancies_are_those_of_brute_force(split: Path, scene_distance: np.ndarray, source: str) -> None:
    surface = VisibleSurface(split / "test", split / "models", source)  # type: ignore[arg-type]
    taus = np.array(RECALL_SHARES) * DIAMETER_M
    if source == "depth":
        seen = np.where(np.isfinite(scene_distance), scene_distance, 3.0)
        seen[:20, :20] = 0.0
    else:
        seen = np.where(np.isfinite(scene_distance), scene_distance, 0.0)
    for est, ref in zip(moved(), SCENE):
        shown = cast(est.apply(BOX)), cast(ref.apply(BOX))
        expected = [vsd_by_pixel(*shown, seen, tau) for tau in taus]
        found = surface.errors((2, 5), 1, est, ref, taus)
        np.testing.assert_allclose(found, expected, atol=0.02)
        assert 0.05 < found[-1] < found[0] <= 1.0
        assert (surface.errors((2, 5), 1, ref, ref, taus) == 0).all()


def results(T_cam_obj: RigidTransform) -> BopResults:
    count = len(T_cam_obj)
    ids = [np.full(count, number) for number in (2, 5, 1)]
    return BopResults(*ids, np.ones(count), T_cam_obj, np.zeros(count))


def test_average_recall_of_a_results_file(split: Path, scene_distance: np.ndarray) -> None:
    options = EvaluatePosesOptions(split / "models", vsd="depth")
    write_bop_results(split / "good.csv", results(SCENE))
    write_bop_results(split / "bad.csv", results(moved()))
    write_bop_results(split / "half.csv", results(SCENE[:1]))
    good, bad, half = evaluate_poses([split / f"{n}.csv" for n in ("good", "bad", "half")], split / "test", options)
    assert good.overall["recall_vsd"] == good.overall["recall"] == 100.0
    assert half.classes[0].recall_vsd == 50.0
    surface = VisibleSurface(split / "test", split / "models", "depth")
    taus = np.array(RECALL_SHARES) * DIAMETER_M
    errors = [surface.errors((2, 5), 1, est, ref, taus) for est, ref in zip(moved(), SCENE)]
    hits = [error < theta for row in errors for error in row for theta in RECALL_SHARES]
    assert bad.classes[0].recall_vsd == pytest.approx(100 * np.mean(hits))
    assert 0 < bad.classes[0].recall_vsd < 100
    table = pose_tables([good, bad])[0]
    assert [c.header for c in table.columns[1:8]] == ["ADD-S", "ADD(-S)", "exact", "AR MSSD", "AR MSPD", "AR VSD", "AR"]
    plain = evaluate_poses([split / "good.csv"], split / "test", replace(options, vsd="none"))[0]
    assert "AR VSD" not in [c.header for c in pose_tables([plain])[0].columns]
    assert "recall_vsd" not in plain.overall


def test_objects_outside_the_image_or_behind_the_camera(split: Path) -> None:
    surface = VisibleSurface(split / "test", split / "models", "depth")
    for shift in ([5.0, 0, 1.0], [0, 0, -1.0]):
        away = make_pose(Rotation.identity(), shift)
        assert surface.errors((2, 5), 1, away, away, [0.1]).tolist() == [1.0]
        assert surface.errors((2, 5), 1, away, SCENE[0], [0.1]).tolist() == [1.0]


def test_missing_and_damaged_depth_images(tmp_path: Path) -> None:
    write_split(tmp_path, None)
    write_bop_results(tmp_path / "r.csv", results(SCENE))
    options = EvaluatePosesOptions(tmp_path / "models", vsd="depth")
    with pytest.raises(InputError, match=r"no such depth image.*rendered"):
        evaluate_poses([tmp_path / "r.csv"], tmp_path / "test", options)
    found = evaluate_poses([tmp_path / "r.csv"], tmp_path / "test", replace(options, vsd="rendered"))[0]
    assert found.overall["recall_vsd"] == 100.0
    (tmp_path / "test/000002/depth").mkdir()
    (tmp_path / "test/000002/depth/000005.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(InputError, match="not a whole depth image"):
        evaluate_poses([tmp_path / "r.csv"], tmp_path / "test", options)


def ply(kind: str, faces: list[tuple[int, ...]], colour: bool) -> bytes:
    head = f"ply\nformat {kind} 1.0\ncomment made by hand\nelement vertex 4\n"
    head += "".join(f"property {'double' if axis == 'y' else 'float'} {axis}\n" for axis in "xyz")
    head += "property uchar red\n" * colour + f"element face {len(faces)}\n"
    head += "property uchar flag\nproperty list uchar uint vertex_index\nproperty list uchar float texcoord\n"
    head += "end_header\n"
    points = [(0, 0, 0), (1000, 0, 0), (1000, 2000, 0), (0, 2000, 3)]
    body = b""
    order = ">" if "big" in kind else "<"
    if kind == "ascii":
        lines = [" ".join(map(str, (*p, *([7] * colour)))) for p in points]
        lines += [" ".join(map(str, (1, len(f), *f, 2, 0.5, 0.25))) for f in faces]
        return head.encode() + ("\n".join(lines) + "\n").encode()
    for p in points:
        record = [("x", order + "f4"), ("y", order + "f8"), ("z", order + "f4"), *([("r", "u1")] * colour)]
        body += np.array((*p, *([7] * colour)), record).tobytes()
    for f in faces:
        body += bytes([1, len(f)]) + np.array(f, order + "u4").tobytes()
        body += bytes([2]) + np.array([0.5, 0.25], order + "f4").tobytes()
    return head.encode() + body


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("colour", [False, True])
def test_meshes_in_every_format(tmp_path: Path, kind: str, colour: bool) -> None:
    path = tmp_path / "m.ply"
    path.write_bytes(ply(kind, [(0, 1, 2), (0, 2, 3)], colour))
    points, faces = read_model_mesh(path)
    np.testing.assert_allclose(points[3], [0, 2, 0.003], atol=1e-9)
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    path.write_bytes(ply(kind, [(0, 1, 2, 3)], colour))
    assert read_model_mesh(path)[1].tolist() == [[0, 1, 2], [0, 2, 3]]
    for faces_in, message in (([(0, 1, 2), (0, 1, 2, 3)], "PLY"), ([(0, 1, 4)], "no vertex"), ([], "no faces")):
        path.write_bytes(ply(kind, faces_in, colour))
        with pytest.raises(InputError, match=message):
            read_model_mesh(path)
    path.write_bytes(ply(kind, [(0, 1, 2), (0, 2, 3)], colour)[:-30])
    with pytest.raises(InputError, match="PLY"):
        read_model_mesh(path)
