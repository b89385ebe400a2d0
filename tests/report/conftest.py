"""One small run for the figures, the recording and the run folder: made by hand, so that every number is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Camera, CameraPoses, Landmark, LandmarkMap, ObjectPoses, Symmetry
from poet_loc.core.trajectory import Trajectory
from poet_loc.report.evaluate import Estimate, evaluate, references_for_both_bodies
from poet_loc.report.run_record import RunRecord

START_NS = 1_600_049_000_000_000_000
T_CAM_IMU = make_pose(Rotation.from_rotvec([1.2, -0.3, 0.2]), [0.05, -0.02, 0.03])


@dataclass(frozen=True)
class Gate:
    stamps_ns: NDArray
    object_ids: NDArray
    instances: NDArray
    nis_position: NDArray
    nis_rotation: NDArray
    position_accepted: NDArray
    rotation_accepted: NDArray


@dataclass(frozen=True)
class FusedByHand:
    name: str
    stamps_ns: NDArray
    T_world_imu: RigidTransform
    velocity: NDArray
    gyroscope_bias: NDArray
    accelerometer_bias: NDArray
    sigmas: NDArray
    pose_covariances: NDArray | None
    gate: Gate | None
    runtime_s: float | None
    calibrated: SimpleNamespace | None = None

    def later(self, by_ns: int) -> FusedByHand:
        return replace(self, stamps_ns=self.stamps_ns + by_ns)


def _motion(stamps_ns: NDArray) -> Trajectory:
    t = (stamps_ns - START_NS) * 1e-9
    rotation = Rotation.from_rotvec(np.stack([0.3 * np.sin(t), 0.2 * t, 0.1 * np.cos(2 * t)], axis=1))
    return Trajectory(stamps_ns, make_pose(rotation, np.stack([np.cos(t), np.sin(t), 0.1 * t], axis=1)))


def _stamps(rate: float, seconds: float) -> NDArray:
    return START_NS + np.round(np.arange(int(rate * seconds)) / rate * 1e9).astype(np.int64)


def _disturbed(T: RigidTransform, error: NDArray) -> RigidTransform:
    return make_pose(T.rotation * Rotation.from_rotvec(error[:, :3]), T.translation + error[:, 3:])


LANDMARKS = LandmarkMap(
    (
        Landmark(3, make_pose(Rotation.identity(), [0.0, 0.0, 0.1]), name="004_sugar_box"),
        Landmark(9, make_pose(Rotation.identity(), [0.3, 0.1, 0.0]), 1, symmetry=Symmetry((0, 0, 1), "continuous")),
    )
)


def _seen(truth: Trajectory) -> ObjectPoses:
    """Both landmarks, exactly, in every frame."""
    frames = len(truth)
    frame, ids, instances = np.repeat(np.arange(frames), 2), np.tile([3, 9], frames), np.tile([0, 1], frames)
    T_cam_obj = truth.T_world_body[frame].inv() * LANDMARKS.T_world_obj[np.tile([0, 1], frames)]
    return ObjectPoses(truth.stamps_ns[frame], frame, ids, instances, np.ones(2 * frames), T_cam_obj)


def _solved(truth: Trajectory, rng: np.random.Generator) -> CameraPoses:
    """Camera poses with true covariances, every seventh frame missing."""
    frames, sigma = len(truth), np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.03])
    covariances = np.broadcast_to(np.diag(sigma**2), (frames, 6, 6))
    T_world_cam = _disturbed(truth.T_world_body, rng.normal(size=(frames, 6)) * sigma)
    return CameraPoses(truth.stamps_ns, np.arange(frames), T_world_cam, covariances)[np.arange(frames) % 7 > 0]


def _fused(detections: ObjectPoses, rng: np.random.Generator) -> FusedByHand:
    stamps_ns = _stamps(200.0, 4.0)[100:]
    n, seen = len(stamps_ns), len(detections)
    sigmas = np.tile([0.01] * 3 + [0.005] * 3 + [0.02] * 3 + [1e-3] * 3 + [1e-2] * 3, (n, 1))
    T_world_imu = _motion(stamps_ns).to_body(T_CAM_IMU).T_world_body
    return FusedByHand(
        name="fuse/eskf/objects",
        stamps_ns=stamps_ns,
        T_world_imu=_disturbed(T_world_imu, rng.normal(size=(n, 6)) * sigmas[:, :6]),
        velocity=rng.normal(size=(n, 3)),
        gyroscope_bias=rng.normal(0.0, 0.01, (n, 3)),
        accelerometer_bias=rng.normal(0.0, 0.1, (n, 3)),
        sigmas=sigmas,
        pose_covariances=np.broadcast_to(np.diag(sigmas[0, :6] ** 2), (n, 6, 6)),
        gate=Gate(
            detections.stamps_ns,
            detections.object_ids,
            detections.instances,
            rng.chisquare(3, seen),
            rng.chisquare(3, seen),
            rng.random(seen) < 0.9,
            rng.random(seen) < 0.8,
        ),
        runtime_s=0.25,
    )


@pytest.fixture(scope="session")
def run_record() -> RunRecord:
    rng = np.random.default_rng(7)
    truth = _motion(_stamps(30.0, 4.0))
    detections = _seen(truth)
    best = CameraPoses(truth.stamps_ns, np.arange(len(truth)), truth.T_world_body)
    robust, fused = _solved(truth, rng), _fused(detections, rng)
    estimates = (
        Estimate.of_camera_poses("localize/best", best, 0.1, oracle=True),
        Estimate.of_camera_poses("localize/robust", robust, 0.2),
        Estimate.of_fused(fused),
    )
    references = references_for_both_bodies({"cam": truth}, T_CAM_IMU)
    return RunRecord(
        estimates=estimates,
        references=references,
        evaluation=evaluate(estimates, references, (int(truth.stamps_ns[0]), int(truth.stamps_ns[-1]))),
        fused=(fused,),
        landmark_map=LANDMARKS,
        detections=detections,
        voted={"localize/robust": rng.random(len(detections)) < 0.9},
        camera=Camera((1066.8, 1067.5, 312.99, 241.31), resolution=(640, 480)),
        T_cam_imu=T_CAM_IMU,
    )
