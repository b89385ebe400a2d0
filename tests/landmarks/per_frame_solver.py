"""The solver written plainly, one frame and one vote at a time with scipy: the oracle of the tests and the peer of the
benchmark. Distinct landmarks without symmetry; the same options."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from landmarks.camera_pose import SolverOptions
from poet_loc.core.geometry import make_pose, skew, so3_right_jacobian_inverse
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory


def solve_per_frame(
    object_poses: ObjectPoses, landmark_map: LandmarkMap, options: SolverOptions, reference: Trajectory | None = None
) -> RigidTransform:
    """T_world_cam of every frame, in order of time."""
    solver = {"all": _all, "out": _out, "prev": _out, "best": _best, "robust": _robust}[options.mode]
    order = {landmark.object_id: place for place, landmark in enumerate(landmark_map)}
    state: dict = {"previous": None, "beliefs": [], "stamp": None}
    poses = []
    for stamp in np.unique(object_poses.stamps_ns):
        rows = np.flatnonzero(object_poses.stamps_ns == stamp)
        rows = sorted(rows, key=lambda row: order[int(object_poses.object_ids[row])])
        frame = []
        for row in rows:
            landmark = landmark_map.landmarks[order[int(object_poses.object_ids[row])]]
            T_cam_obj = object_poses.T_cam_obj[row]
            vote = landmark.T_world_obj * T_cam_obj.inv()
            frame.append((vote, landmark.T_world_obj, T_cam_obj, float(object_poses.scores[row])))
        state["now"], state["truth"] = int(stamp), None
        if options.mode == "best":
            truth, _ = reference.interpolate(np.array([stamp]))
            state["truth"] = truth[0]
        state["previous"] = solver(frame, options, state)
        poses.append(state["previous"])
    return RigidTransform.concatenate(poses)


def _mean(votes: list[RigidTransform]) -> RigidTransform:
    rotation = Rotation.concatenate([vote.rotation for vote in votes]).mean()
    return make_pose(rotation, np.mean([vote.translation for vote in votes], axis=0))


def _apart(a: RigidTransform, b: RigidTransform) -> tuple[float, float]:
    return (
        float(np.linalg.norm(a.translation - b.translation)),
        float((a.rotation.inv() * b.rotation).magnitude()),
    )


def _all(frame, options, state):
    return _mean([vote for vote, *_ in frame])


def _best(frame, options, state):
    return min((vote for vote, *_ in frame), key=lambda vote: _apart(vote, state["truth"])[0])


def _out(frame, options, state):
    def agree(i: int, j: int) -> bool:
        distance, angle = _apart(frame[i][0], frame[j][0])
        return distance <= options.distance and angle <= np.radians(options.angle_deg)

    for size in range(len(frame), 0, -1):
        sets = [
            members
            for members in itertools.combinations(range(len(frame)), size)
            if all(agree(i, j) for i, j in itertools.combinations(members, 2))
        ]
        if sets:
            break
    means = {members: _mean([frame[i][0] for i in members]) for members in sets}
    if options.mode == "prev" and state["previous"] is not None:

        def far(members: tuple[int, ...]) -> float:
            distance, angle = _apart(means[members], state["previous"])
            return distance / options.distance + angle / np.radians(options.angle_deg)

        return means[min(sets, key=far)]

    def rule(members: tuple[int, ...]) -> tuple[float, float]:
        score = -sum(frame[i][3] for i in members)
        near = float(np.mean([np.linalg.norm(frame[i][2].translation) for i in members]))
        return score, near

    return means[min(sets, key=rule)]


def _covariance(T_cam_obj: RigidTransform, options: SolverOptions) -> np.ndarray:
    noise, t = options.noise, T_cam_obj.translation
    distance = np.linalg.norm(t)
    ray = t / distance if distance else np.zeros(3)
    across, along = (noise.across * distance) ** 2, (noise.along * distance) ** 2
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.radians(noise.rotation_deg) ** 2 * np.eye(3)
    covariance[3:, 3:] = across * np.eye(3) + (along - across) * np.outer(ray, ray) + noise.least**2 * np.eye(3)
    return covariance + 1e-12 * np.eye(6)


def residual(pose: RigidTransform, T_world_obj: RigidTransform, T_cam_obj: RigidTransform) -> np.ndarray:
    """[e_r, e_t] in camera axes of one detection at a camera pose."""
    predicted = pose.inv() * T_world_obj
    turned = (T_cam_obj.rotation * predicted.rotation.inv()).as_rotvec()
    return np.concatenate([turned, T_cam_obj.translation - predicted.translation])


def _squares(pose: RigidTransform, frame, inverse) -> np.ndarray:
    errors = [residual(pose, T_world_obj, T_cam_obj) for _, T_world_obj, T_cam_obj, _ in frame]
    return np.array([error @ information @ error for error, information in zip(errors, inverse, strict=True)])


def _normal_equations(pose: RigidTransform, frame, inverse, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    normal, of_mean, gradient = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    for (_, T_world_obj, T_cam_obj, _), information in zip(frame, inverse, strict=True):
        error = residual(pose, T_world_obj, T_cam_obj)
        weight = (scale / (scale + error @ information @ error)) ** 2
        jacobian = np.eye(6)
        jacobian[:3, :3] = so3_right_jacobian_inverse(error[:3])
        jacobian[3:, :3] = -skew((pose.inv() * T_world_obj).translation)
        normal += weight * jacobian.T @ information @ jacobian
        of_mean += weight**2 * jacobian.T @ information @ jacobian
        gradient += weight * jacobian.T @ information @ error
    return normal, of_mean, gradient


def _refine(start: RigidTransform, frame, inverse, gate: float):
    pose = start
    for step in range(60):
        normal, _, gradient = _normal_equations(pose, frame, inverse, gate if step else 4.0 * gate)
        change = -np.linalg.solve(normal, gradient)
        change *= min(1.0, 0.5 / max(np.abs(change).max(), 1e-12))
        moved = pose.translation + pose.rotation.apply(change[3:])
        pose = make_pose(pose.rotation * Rotation.from_rotvec(change[:3]), moved)
        if np.abs(change).max() < 1e-8 and step:
            break
    if _loss(pose, frame, inverse, gate) > _loss(start, frame, inverse, gate):
        pose = start
    squares = _squares(pose, frame, inverse)
    weights = (gate / (gate + squares)) ** 2
    normal, of_mean, _ = _normal_equations(pose, frame, inverse, gate)
    inside = weights > 0.25
    excess = max(1.0, squares[inside].sum() / chi2.ppf(0.9, 6 * max(inside.sum() - 1, 1)))
    to_world = np.eye(6)
    to_world[3:, 3:] = pose.rotation.as_matrix()
    factor = to_world @ np.linalg.inv(normal)
    return pose, weights.sum(), excess * factor @ of_mean @ factor.T


def _loss(pose: RigidTransform, frame, inverse, gate: float) -> float:
    squares = _squares(pose, frame, inverse)
    return float(np.sum(squares / (gate + squares)))


def _robust(frame, options, state):
    memory = options.memory
    gate = float(chi2.ppf(options.gate_probability, 6))
    inverse = [np.linalg.inv(_covariance(T_cam_obj, options)) for _, _, T_cam_obj, _ in frame]
    step_s = 0.0 if state["stamp"] is None else (state["now"] - state["stamp"]) * 1e-9
    state["stamp"] = state["now"]
    fade = np.exp(-step_s / memory.evidence_s)
    earlier = [(*b[:3], b[3] + step_s, b[4] * fade) for b in state["beliefs"] if b[3] + step_s <= memory.evidence_s]
    explained = [len(frame) - _loss(vote, frame, inverse, gate) for vote, *_ in frame]
    own, replaced, most = [], set(), 0.0
    for (vote, *_), share in zip(frame, explained, strict=True):
        if share < max(explained) / 3.0:
            continue
        pose, support, covariance = _refine(vote, frame, inverse, gate)
        most = max(most, support)
        v_r, v_t = (memory.white_share * np.trace(block) for block in (covariance[:3, :3], covariance[3:, 3:]))
        inherited = []
        for other, o_r, o_t, age, evidence in earlier:
            distance, angle = _apart(pose, other)
            square = distance**2 / (_both(v_t, o_t) + 3 * (memory.speed * age) ** 2)
            square += angle**2 / (_both(v_r, o_r) + 3 * (np.radians(memory.turn_rate_deg) * age) ** 2)
            inherited.append(evidence * np.exp(-max(square - 2.0, 0.0) / 2.0))
        evidence = support
        if inherited:
            parent = int(np.argmax(inherited))
            evidence += inherited[parent]
            if evidence >= earlier[parent][4]:
                replaced.add(parent)
        if all(max(_apart(pose, other[0])) > 1e-5 for other in own):  # starts that ended in the same pose
            own.append((pose, v_r, v_t, 0.0, evidence))
    beliefs = own + [belief for index, belief in enumerate(earlier) if index not in replaced]
    beliefs.sort(key=lambda belief: (-round(belief[4], 6), belief[2]))
    state["beliefs"] = beliefs[:8]
    oldest_s = memory.hold_s if most < 1.5 else 0.0
    return next(belief for belief in beliefs if belief[3] <= oldest_s)[0]


def _both(a: float, b: float) -> float:
    return min(a, b) + min(max(a, b), 9.0 * min(a, b))
