"""Hypothesis strategies of records: any int64 stamp, any pose of a sensible size."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.records import ObjectPoses
from poet_loc.core.trajectory import Trajectory

INT64 = st.integers(-(2**63) + 1, 2**63 - 1)
CLOCK = st.integers(-(2**62), 2**62 - 1)  # differences of two stay within 64 bits
STAMPS = st.lists(CLOCK, min_size=1, max_size=8, unique=True).map(lambda stamps: np.array(sorted(stamps), np.int64))
SEEDS = st.integers(0, 2**32 - 1)


def random_poses(count: int, seed: int):
    rng = np.random.default_rng(seed)
    q_xyzw = rng.normal(size=(count, 4))
    return pose_from_quaternion(rng.normal(size=(count, 3)) * 3, q_xyzw / np.linalg.norm(q_xyzw, axis=1)[:, None])


def random_covariances(count: int, seed: int) -> np.ndarray:
    factors = np.random.default_rng(seed).normal(size=(count, 6, 6)) * 0.01
    return factors @ factors.transpose(0, 2, 1) + 1e-6 * np.eye(6)


@st.composite
def trajectories(draw) -> Trajectory:
    stamps = draw(STAMPS)
    return Trajectory(stamps, random_poses(len(stamps), draw(SEEDS)))


@st.composite
def object_poses(draw) -> ObjectPoses:
    """Two objects and two instances at each stamp, with covariances or without."""
    stamps, seed = draw(STAMPS), draw(SEEDS)
    ids = draw(st.lists(INT64, min_size=2, max_size=2, unique=True))
    count = 4 * len(stamps)
    return ObjectPoses(
        stamps_ns=np.repeat(stamps, 4),
        frames=np.repeat(np.array([draw(INT64) for _ in stamps], np.int64), 4),
        object_ids=np.tile(np.repeat(np.array(ids, np.int64), 2), len(stamps)),
        instances=np.tile(np.array([0, 1], np.int64), 2 * len(stamps)),
        scores=np.random.default_rng(seed).uniform(size=count),
        T_cam_obj=random_poses(count, seed),
        covariances=random_covariances(count, seed) if draw(st.booleans()) else None,
    )


def same_poses(a, b) -> bool:
    return np.allclose(a.as_matrix(), b.as_matrix(), rtol=0, atol=1e-14)
