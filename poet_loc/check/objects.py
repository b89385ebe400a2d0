"""Checks of detections against the map: unknown objects, directions and orders of rotations, landmarks out of place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from landmarks.association import associate
from landmarks.camera_pose import solve
from landmarks.landmark_map import map_arrays
from landmarks.options import SolverOptions
from poet_loc.check.finding import Evidence, Finding
from poet_loc.check.gravity import solved
from poet_loc.check.pose_sources import READINGS, Reading, reread
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log, object_poses_file

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

_LEAST_SEEN = 20
_LEAST_BEHIND, _BEHIND = 5, 0.1
_MOST_ROWS = 1500
_FITS_DEG, _MISFITS_DEG = 15.0, 40.0
_OUT_OF_PLACE_M, _OUT_OF_PLACE_DEG = 0.08, 15.0
_TIMES_OTHERS = 3.0
_STEADY = 2.0  # offset over its own scatter
_TRUTH_APART_M, _TRUTH_APART_DEG = 0.5, 30.0


def check_unknown_objects(log: Log) -> Iterator[Finding]:
    """Yield detections of objects that the map does not have."""
    if log.landmark_map is None:
        return
    known = np.unique(log.landmark_map.object_ids)
    for name, poses in log.object_poses.items():
        unknown = ~np.isin(poses.object_ids, known)
        if not unknown.any():
            continue
        ids, counts = np.unique(poses.object_ids[unknown], return_counts=True)
        evidence: Evidence = {
            "unknown_objects": ", ".join(map(str, ids.tolist())),
            "detections_of_each": ", ".join(map(str, counts.tolist())),
            "of_all_detections": len(poses),
            "objects_of_the_map": ", ".join(map(str, known.tolist())),
        }
        what = "detections of objects that landmarks.json does not have"
        fix = "add the objects to the map, leave their rows out, or correct the numbering of the classes"
        repair = _without(name, ids) if unknown.mean() < 0.5 else None
        yield Finding("unknown-object", "error", object_poses_file(name), what, fix, evidence, repair)


def check_in_front(log: Log) -> Iterator[Finding]:
    """Yield detections behind the camera, where nothing is seen.

    Where all are, and objects lie beside each other as in the map, it is another camera's axes: OpenGL's, it seems.
    """
    for name, poses in log.object_poses.items():
        behind = poses.T_cam_obj.translation[:, 2] <= 0.0
        if np.count_nonzero(behind) < _LEAST_BEHIND or behind.mean() < _BEHIND:
            continue
        evidence: Evidence = {"detections_behind": int(np.count_nonzero(behind)), "of_all_detections": len(poses)}
        what = f"{100.0 * behind.mean():.0f} % of the detections are behind the camera: tz is negative"
        fix = (
            "write T_cam_obj with x right, y down, z forward; OpenGL's camera becomes that by diag(1, -1, -1) T_cam_obj"
        )
        repair = _from_opengl(name) if behind.all() and _fits_map(log, name) else None
        yield Finding("behind-camera", "error", object_poses_file(name), what, fix, evidence, repair)


def _fits_map(log: Log, name: str) -> bool:
    """Tell whether the objects of a set lie beside each other as in the map."""
    misfit = _misfits(log).get(name)
    return misfit is not None and misfit["as is", "as is"] < _FITS_DEG


def check_rotations_against_map(log: Log) -> Iterator[Finding]:
    """Yield detections or a map whose rotations only agree under another order or direction.

    The rotation from one object to another is the same in the detections of a frame and in the map.
    """
    misfits = _misfits(log)
    wrong = [name for name, table in misfits.items() if table["as is", "as is"] >= _MISFITS_DEG]
    if wrong and len(wrong) == len(misfits):  # the map may be what is written otherwise: the best set tells
        best = min(misfits, key=lambda each: min(misfits[each].values()))
        yield from _reading(log, best, misfits[best])
    else:
        for name in wrong:
            as_mapped = {both: misfit for both, misfit in misfits[name].items() if both[1] == "as is"}
            yield from _reading(log, name, as_mapped)


def _reading(log: Log, name: str, table: dict[tuple[Reading, Reading], float]) -> Iterator[Finding]:
    """Yield how a set of detections, or the map, is written, if one reading is clearly right."""
    order = sorted(table, key=lambda both: table[both] + 2.0 * sum(reading != "as is" for reading in both))
    if table[order[0]] >= _FITS_DEG or table[order[1]] <= table[order[0]] + _FITS_DEG:
        return
    of_detections, of_map = order[0]
    evidence: Evidence = {
        "median_misfit_deg": table["as is", "as is"],
        f"misfit_deg_detections_{of_detections}_map_{of_map}": table[order[0]],
        "next_best_deg": table[order[1]],
    }
    for reading, file, T in (
        (of_detections, object_poses_file(name), "T_cam_obj"),
        (of_map, "landmarks.json", "T_world_obj"),
    ):
        if reading == "wxyz":
            what = "quaternions are written w, x, y, z, it seems: only so detections and map agree"
            fix = "write q_xyzw: the scalar comes last"
            yield Finding("quaternion-order", "error", file, what, fix, evidence, _reread(file, name, reading))
        elif reading == "inverse":
            what = "the poses are the other direction, it seems: only inverted detections and map agree"
            yield Finding("poses-inverted", "error", file, what, f"write {T}", evidence, _reread(file, name, reading))


def _misfits(log: Log) -> dict[str, dict[tuple[Reading, Reading], float]]:
    """Return by how much (deg) each set of detections and the map disagree, under each reading of either."""
    misfits: dict[str, dict[tuple[Reading, Reading], float]] = {}
    if log.landmark_map is None or len(log.landmark_map) < 2:
        return misfits
    for name, poses in log.object_poses.items():
        pairs = pairs_in_frames(poses, log.landmark_map)
        if len(pairs[0]) >= _LEAST_SEEN:
            readings = product(READINGS, READINGS)
            misfits[name] = {both: _misfit(poses, log.landmark_map, pairs, *both) for both in readings}
    return misfits


@dataclass(frozen=True)
class _Residual:
    """Where the detections of one landmark put it, seen from where all of them together put the camera."""

    offset_m: float
    turn_deg: float
    spread_m: float
    """Robust scatter of the offset: a landmark that is out of place is so steadily, a wrong detector is not."""
    spread_deg: float
    seen: int
    share_voting: float


def check_landmarks(log: Log) -> Iterator[Finding]:
    """Yield landmarks that every set of detections that sees them puts elsewhere than the map does."""
    if log.landmark_map is None or not log.object_poses or len(log.landmark_map) < 2:
        return
    tables = [residuals for poses in log.object_poses.values() if (residuals := _residuals(poses, log.landmark_map))]
    for index, landmark in enumerate(log.landmark_map):
        seen = [table for table in tables if index in table and len(table) >= 2]
        if not seen or not all(_out_of_line(table, index) for table in seen):
            continue
        best = min(seen, key=lambda table: table[index].offset_m)
        mine = best[index]
        others = [residual for key, residual in best.items() if key != index]
        evidence: Evidence = {
            "object_id": landmark.object_id,
            "instance": landmark.instance,
            "offset_m": mine.offset_m,
            "turn_deg": mine.turn_deg,
            "others_median_offset_m": float(np.median([each.offset_m for each in others])),
            "others_median_turn_deg": float(np.median([each.turn_deg for each in others])),
            "detections": mine.seen,
            "offset_scatter_m": mine.spread_m,
            "share_that_votes": mine.share_voting,
            "sets_that_say_so": len(seen),
        }
        named = f"object {landmark.object_id}" + (f" ({landmark.name})" if landmark.name else "")
        pair = len(best) == 2
        what = f"{named} is not where the map has it" + (", or the other one is not" if pair else "")
        fix = "survey it again, or build the map anew from detections and known camera poses; has it been moved?"
        yield Finding("landmark-out-of-line", "error", "landmarks.json", what, fix, evidence)
        if pair:
            return


def check_ground_truth(log: Log) -> Iterator[Finding]:
    """Yield a ground truth of the camera that the detections contradict altogether, in its own or another reading."""
    if log.T_world_cam is None:
        return
    from_votes = solved(log)
    gaps = {name: gap for name, T in from_votes.items() if (gap := _gap(T, log.T_world_cam, "as is")) is not None}
    distance = min((gap[0] for gap in gaps.values()), default=0.0)
    angle = min((gap[1] for gap in gaps.values()), default=0.0)
    if distance < _TRUTH_APART_M and angle < _TRUTH_APART_DEG:
        return
    name = min(gaps, key=lambda each: gaps[each])
    T, (distance, angle) = from_votes[name], gaps[name]
    evidence: Evidence = {"median_distance_m": distance, "median_angle_deg": angle, "against": object_poses_file(name)}
    for reading in READINGS[1:]:
        gap = _gap(T, log.T_world_cam, reading)
        if gap is not None and gap[0] < 0.3 and gap[1] < _FITS_DEG:
            evidence |= {f"distance_m_{reading}": gap[0], f"angle_deg_{reading}": gap[1]}
            check = "quaternion-order" if reading == "wxyz" else "poses-inverted"
            what = "the ground truth is where the map and the detections are only "
            what += "with quaternions w, x, y, z" if reading == "wxyz" else "when its poses are inverted"
            fix = "write qx, qy, qz, qw" if reading == "wxyz" else "write T_world_cam, the camera's pose in the world"
            repair = _reread("T_world_cam.tum", name, reading)
            yield Finding(check, "error", "T_world_cam.tum", what, fix, evidence, repair)
            return
    what = "the ground truth is far from where the map and the detections put the camera"
    fix = "bring map and ground truth into one world; is it the trajectory of another body (IMU, depth camera)?"
    yield Finding("ground-truth-apart", "error", "T_world_cam.tum", what, fix, evidence)


def pairs_in_frames(poses: ObjectPoses, landmark_map: LandmarkMap) -> tuple[Rows, Rows, Rows, Rows]:
    """Return rows i, j of detections in one frame, and the landmarks a, b that they are; only unsymmetric ones."""
    places = {each.key: index for index, each in enumerate(landmark_map) if each.symmetry is None}
    keys = zip(poses.object_ids.tolist(), poses.instances.tolist(), strict=True)
    landmark = np.array([places.get(key, -1) for key in keys])
    rows = np.flatnonzero(landmark >= 0)
    one = np.concatenate([rows[:-step] for step in (1, 2, 3) if len(rows) > step] or [rows[:0]])
    two = np.concatenate([rows[step:] for step in (1, 2, 3) if len(rows) > step] or [rows[:0]])
    same = (poses.stamps_ns[one] == poses.stamps_ns[two]) & (landmark[one] != landmark[two])
    one, two = one[same], two[same]
    thin = slice(None, None, max(1, -(-len(one) // _MOST_ROWS)))
    return one[thin], two[thin], landmark[one[thin]], landmark[two[thin]]


def _misfit(
    poses: ObjectPoses, landmark_map: LandmarkMap, pairs: tuple[Rows, ...], detections: Reading, mapped: Reading
) -> float:
    """Return how far detections and map are apart on where one object is in another's frame, deg.

    The mean of two medians: of the angle between the two R_obja_objb, and of that between the directions from a to b.
    """
    i, j, a, b = pairs
    seen, there = reread(poses.T_cam_obj, detections), reread(landmark_map.T_world_obj, mapped)
    T_seen, T_there = seen[i].inv() * seen[j], there[a].inv() * there[b]
    angle = (T_seen.rotation.inv() * T_there.rotation).magnitude()
    way, way_there = T_seen.translation, T_there.translation
    lengths = np.linalg.norm(way, axis=1) * np.linalg.norm(way_there, axis=1)
    cosine = np.sum(way * way_there, axis=1) / np.maximum(lengths, 1e-12)
    direction = np.arccos(np.clip(cosine, -1.0, 1.0))
    return float(np.degrees(np.median(angle) + np.median(direction)) / 2.0)


def _residuals(poses: ObjectPoses, landmark_map: LandmarkMap) -> dict[int, _Residual]:
    """Return, for each landmark that is seen often, its offset from the map under the solver's camera poses."""
    stamps = np.unique(poses.stamps_ns)
    several = stamps[np.isin(stamps, poses.stamps_ns[:-1][np.diff(poses.stamps_ns) == 0])]
    kept = several[:: max(1, -(-len(several) // 300))]
    rows = poses[np.isin(poses.stamps_ns, kept)]
    if not len(rows):
        return {}
    arrays = map_arrays(landmark_map)
    association = associate(rows, arrays, SolverOptions())
    solution = solve(rows, landmark_map, SolverOptions(mode="robust"))
    solved_rows = solution.frame_of_detection >= 0
    T_world_cam = solution.camera_poses.T_world_cam
    result = {}
    for index in range(len(landmark_map)):
        mine = np.flatnonzero((association.landmarks == index) & solved_rows)
        if len(mine) < _LEAST_SEEN:
            continue
        cameras = T_world_cam[solution.frame_of_detection[mine]]
        rotations = Rotation.from_matrix(association.R_cam_obj[mine])
        T = cameras * RigidTransform.from_components(rows.T_cam_obj[mine].translation, rotations)
        T_map = landmark_map.landmarks[index].T_world_obj
        offset, spread_m = _middle(T.translation - T_map.translation)
        turn, spread = _middle((T_map.rotation.inv() * T.rotation).as_rotvec())
        voting = float(solution.voted[mine].mean())
        result[index] = _Residual(offset, np.degrees(turn), spread_m, np.degrees(spread), len(mine), voting)
    return result


def _middle(vectors: Array) -> tuple[float, float]:
    """Return the length of the median vector, and the robust scatter about it."""
    middle = np.median(vectors, axis=0)
    scatter = 1.48 * float(np.median(np.linalg.norm(vectors - middle, axis=1)))
    return float(np.linalg.norm(middle)), scatter


def _out_of_line(table: dict[int, _Residual], index: int) -> bool:
    mine, others = table[index], [each for key, each in table.items() if key != index]
    far = mine.offset_m > max(_OUT_OF_PLACE_M, _TIMES_OTHERS * float(np.median([each.offset_m for each in others])))
    turned = mine.turn_deg > max(
        _OUT_OF_PLACE_DEG, _TIMES_OTHERS * float(np.median([each.turn_deg for each in others]))
    )
    steady = far and mine.offset_m > _STEADY * mine.spread_m
    steady |= turned and mine.turn_deg > _STEADY * mine.spread_deg
    return steady and mine.share_voting < 0.5


def _gap(T_world_cam: Trajectory, truth: Trajectory, reading: Reading) -> tuple[float, float] | None:
    """Return median distance (m) and angle (deg) between votes and ground truth."""
    there, inside = truth.interpolate(T_world_cam.stamps_ns, 200_000_000)
    if inside.sum() < 5:
        return None
    there, seen = reread(there, reading), T_world_cam.T_world_body
    distance = np.linalg.norm(there.translation - seen.translation, axis=1)[inside]
    angle = np.degrees((there.rotation.inv() * seen.rotation).magnitude())[inside]
    return float(np.median(distance)), float(np.median(angle))


def _without(name: str, ids: NDArray[np.int64]):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        poses = log.object_poses[name]
        return replace(log, object_poses={**log.object_poses, name: poses[~np.isin(poses.object_ids, ids)]})

    return repair


def _from_opengl(name: str):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        half_turn = RigidTransform.from_rotation(Rotation.from_quat([1.0, 0.0, 0.0, 0.0]))
        poses, covariances = log.object_poses[name], log.object_poses[name].covariances
        if covariances is not None:
            signs = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
            covariances = covariances * np.outer(signs, signs)
        turned = replace(poses, T_cam_obj=half_turn * poses.T_cam_obj, covariances=covariances)
        return replace(log, object_poses={**log.object_poses, name: turned})

    return repair


def _reread(file: str, name: str, reading: Reading):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        if file == "landmarks.json":
            assert log.landmark_map is not None
            landmarks = (replace(each, T_world_obj=reread(each.T_world_obj, reading)) for each in log.landmark_map)
            return replace(log, landmark_map=LandmarkMap(tuple(landmarks)))
        if file == "T_world_cam.tum":
            assert log.T_world_cam is not None
            poses = reread(log.T_world_cam.T_world_body, reading)
            return replace(log, T_world_cam=Trajectory(log.T_world_cam.stamps_ns, poses))
        other = replace(log.object_poses[name], T_cam_obj=reread(log.object_poses[name].T_cam_obj, reading))
        return replace(log, object_poses={**log.object_poses, name: other})

    return repair
