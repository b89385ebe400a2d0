"""The files of a log whose poses turn with the camera or with the IMU, and how their rotations may be meant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from scipy.spatial.transform import RigidTransform, Rotation

from poet_loc.check.streams import trajectories_of
from poet_loc.core.geometry import make_pose
from poet_loc.core.turn_rates import PoseStream, TurnRates, turn_rates
from poet_loc.io.log_folder import Log, object_poses_file

Reading = Literal["as is", "wxyz", "inverse"]
"""How the rotations of a file are meant: as the format says, with the scalar first, or the other way round."""
READINGS: tuple[Reading, ...] = ("as is", "wxyz", "inverse")


@dataclass(frozen=True)
class PoseSource:
    """A file of poses that turn with the camera or with the IMU."""

    file: str
    body: Literal["cam", "imu"]
    stream: PoseStream

    def turn_rates(self, reading: Reading = "as is") -> TurnRates:
        """Return its turn rates under a reading of its rotations."""
        return turn_rates(replace(self.stream, rotations=reread_rotation(self.stream.rotations, reading)))


def pose_sources(log: Log) -> Iterator[PoseSource]:
    """Yield every file of a log whose poses turn with the camera or with the IMU."""
    for name, poses in log.object_poses.items():
        yield PoseSource(object_poses_file(name), "cam", PoseStream.of_detections(poses))
    if log.camera_poses is not None:
        yield PoseSource("camera_poses.csv", "cam", PoseStream.of_camera_poses(log.camera_poses))
    for file, trajectory in trajectories_of(log).items():
        body: Literal["cam", "imu"] = "imu" if file == "T_world_imu.tum" else "cam"
        yield PoseSource(file, body, PoseStream.of_trajectory(trajectory))


def reread(T: RigidTransform, reading: Reading) -> RigidTransform:
    """Return poses as they are under another reading of the file."""
    if reading == "inverse":
        return T.inv()
    return make_pose(reread_rotation(T.rotation, reading), T.translation)


def reread_rotation(rotation: Rotation, reading: Reading) -> Rotation:
    """Return rotations as they are under another reading of the file."""
    if reading == "inverse":
        return rotation.inv()
    if reading == "wxyz":
        return Rotation.from_quat(rotation.as_quat()[..., [1, 2, 3, 0]])
    return rotation
