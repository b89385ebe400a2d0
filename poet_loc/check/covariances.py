"""Checks that detections err no more than the covariances that come with them state."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from poet_loc.check.finding import Evidence, Finding
from poet_loc.check.objects import pairs_in_frames
from poet_loc.core.consistency import chi_square_quantile
from poet_loc.core.geometry import skew
from poet_loc.core.records import LandmarkMap, ObjectPoses
from poet_loc.io.log_folder import Log, object_poses_file

Array = NDArray[np.float64]

_LEAST_PAIRS, _TOO_SMALL = 20, 2.0


def check_covariances(log: Log) -> Iterator[Finding]:
    """Yield detections whose stated errors are too small for how far two objects of a frame disagree with the map."""
    landmark_map = log.landmark_map
    if landmark_map is None or any(each.covariance is not None for each in landmark_map):
        return
    for name, poses in log.object_poses.items():
        stated = _stated(poses)
        nis = _disagreement(stated, landmark_map)
        if len(nis) < _LEAST_PAIRS:
            continue
        factor = float(np.sqrt(np.quantile(nis, 0.25) / chi_square_quantile(0.25, 6)))
        if factor > _TOO_SMALL:
            evidence: Evidence = {"times_too_small": factor, "pairs_of_detections": len(nis)}
            what = "the stated covariances are too small: objects of a frame disagree by more"
            fix = "state the whole error (poet-loc calibrate); the fusion widens them as it runs, the solver does not"
            yield Finding("covariance-too-small", "warning", object_poses_file(name), what, fix, evidence)


def _stated(poses: ObjectPoses) -> ObjectPoses:
    if poses.covariances is None:
        return poses[:0]
    return poses[np.asarray(np.isfinite(poses.covariances).all(axis=(1, 2)))]


def _disagreement(poses: ObjectPoses, landmark_map: LandmarkMap) -> Array:
    """Return the NIS (6 dof) of where an object of a frame is against where another one and the map put it.

    In camera axes, to first order, with errors e = [e_r, e_t] of objects i and j and the way w from i to j:
    e_r = e_rj - e_ri, e_t = e_tj - e_ti + w x e_ri.
    """
    i, j, a, b = pairs_in_frames(poses, landmark_map)
    if poses.covariances is None or not len(i):
        return np.zeros(0)
    T, T_world_obj = poses.T_cam_obj, landmark_map.T_world_obj
    T_there = T[i] * T_world_obj[a].inv() * T_world_obj[b]
    turn = (T[j].rotation * T_there.rotation.inv()).as_rotvec()
    residual = np.hstack([turn, T[j].translation - T_there.translation])
    J = np.tile(-np.eye(6), (len(i), 1, 1))
    J[:, 3:, :3] = skew(T_there.translation - T[i].translation)
    S = poses.covariances[j] + J @ poses.covariances[i] @ np.swapaxes(J, 1, 2)
    return np.asarray(np.einsum("ni,ni->n", residual, np.linalg.solve(S, residual[..., None])[..., 0]))
