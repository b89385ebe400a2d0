"""Short problems for the tests of the filters, and a run of either filter with everything it writes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import memory
from fusion.detection_errors import gauss_markov
from fusion.fuse import loop_columns
from fusion.measurements import ray_aligned_covariance, viewing_axes
from fusion.nav_state import StateLayout
from fusion.options import FuseOptions
from fusion.prepare import Problem, fill_memory, pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import Log

LAYOUTS = {
    "no biases": StateLayout(n_objects=3),
    "one bias": StateLayout(n_objects=3, bias_kinds=1),
    "extrinsics and gravity": StateLayout(n_objects=3, extrinsics=True, gravity=True, bias_kinds=1),
    "time offset": StateLayout(n_objects=3, time_offset=True),
    "objects": StateLayout(n_objects=3, objects=True),
    "everything": StateLayout(n_objects=3, extrinsics=True, time_offset=True, gravity=True, objects=True, bias_kinds=2),
}


@dataclass(frozen=True)
class FilterRun:
    """What a loop over a whole log wrote, and the memory it left."""

    decisions: np.ndarray
    nis: np.ndarray
    stamps: np.ndarray
    core: np.ndarray
    sigma: np.ndarray
    covariance: np.ndarray
    memory: memory.Memory


def simulated(
    measurements: str = "objects", layout: StateLayout | None = None, options: FuseOptions | None = None, **simulation
) -> Problem:
    """Return a problem of six seconds at low rates: three objects, one of them a can."""
    wanted = {"duration_s": 6.0, "imu_rate_hz": 100.0, "camera_rate_hz": 15.0, "objects": 3, "symmetric_objects": 1}
    log = simulate(SimulationOptions(**(wanted | {"camera_poses": measurements == "camera"} | simulation)))
    problem = pose_problem(log, options or FuseOptions(measurements=measurements))
    return problem if layout is None else replace(problem, layout=layout)


def memory_of(problem: Problem, options: FuseOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the filled memory, with a prior on everything that is switched on."""
    floats, integers = fill_memory(problem, options)
    m = memory.views.py_func(floats, integers)
    m.prior[m.prior == 0.0] = 0.02
    return floats, integers


def run(loop: Callable[..., int], problem: Problem, options: FuseOptions) -> FilterRun:
    """Run `filter_loop.run_log` or its plain twin."""
    floats, integers = memory_of(problem, options)
    log, rows = loop_columns(problem)
    written = loop(floats, integers, log, rows)
    kept = (column[:written] for column in rows)
    return FilterRun(log.decisions, log.nis, *kept, memory.views.py_func(floats, integers))


def assert_same(one: FilterRun, other: FilterRun, tolerance: float = 1e-9) -> None:
    """Hold every number of two runs together: states against 1, covariances against their own size."""
    np.testing.assert_array_equal(one.decisions, other.decisions)
    np.testing.assert_array_equal(one.stamps, other.stamps)
    np.testing.assert_allclose(one.nis, other.nis, rtol=1e-7)  # quotients of small numbers
    np.testing.assert_allclose(one.core, other.core, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(one.sigma, other.sigma, rtol=tolerance)
    np.testing.assert_allclose(one.memory.x, other.memory.x, rtol=tolerance, atol=tolerance)
    for P, Q in ((one.memory.P, other.memory.P), *zip(*(r.covariance.reshape(-1, 6, 6) for r in (one, other)))):
        scale = np.sqrt(np.diag(P))
        size = np.where(scale > 0.0, scale, 1.0)
        np.testing.assert_allclose(P / np.outer(size, size), Q / np.outer(size, size), rtol=0, atol=tolerance)
    np.testing.assert_array_equal(one.memory.counters, other.memory.counters)
    for part in ("tallies", "places", "known"):
        np.testing.assert_allclose(getattr(one.memory, part), getattr(other.memory, part), rtol=1e-7, atol=1e-9)


def differing(seed: int, stated: bool) -> Log:
    """Return a log whose objects' rotations err by 1 to 16 deg, biased, with or without covariances that say so."""
    log = simulate(SimulationOptions(seed=seed, objects=5, symmetric_objects=0, noise="none", duration_s=15.0))
    poses, rng = log.object_poses[""], np.random.default_rng(seed)
    frames, frame = np.unique(poses.stamps_ns, return_inverse=True)
    sizes = np.radians([1.0, 2.0, 4.0, 8.0, 16.0])[poses.object_ids - 1]
    slow = np.sqrt(0.4) * gauss_markov(len(frames), (5, 6), 1.0 / 30.0 / 3.0, rng)
    slow += np.sqrt(0.4) * rng.standard_normal((1, 5, 6))
    errors = slow[frame, poses.object_ids - 1] + np.sqrt(0.2) * rng.standard_normal((len(poses), 6))
    t = poses.T_cam_obj.translation
    axes, far = viewing_axes(t), np.linalg.norm(t, axis=1)[:, None]
    shift = np.einsum("nij,nj->ni", axes, far * [0.004, 0.004, 0.025] * errors[:, 3:])
    turn = Rotation.from_rotvec(sizes[:, None] * errors[:, :3])
    covariances = ray_aligned_covariance(t, 0.004, 0.025, 1.0)
    covariances[:, :3, :3] *= sizes[:, None, None] ** 2
    T_cam_obj = RigidTransform.from_components(t + shift, turn * poses.T_cam_obj.rotation)
    poses = replace(poses, T_cam_obj=T_cam_obj, covariances=covariances if stated else None)
    return replace(log, object_poses={"": poses})
