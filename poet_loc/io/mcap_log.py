"""Logs and runs as MCAP, which Foxglove, rerun and ROS 2 open: trajectories, tf, detections, IMU.

Needs the extra `bags` (rosbags). Messages carry the stamp both in the header and as the time of receipt.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poet_loc.core.input_error import InputError
from poet_loc.core.records import ImuSamples, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.bag_messages import typestore_with_vision
from poet_loc.io.log_folder import Log

_STORE = "ros2_humble"
_ROS_ORDER = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True)
class _Topic:
    name: str
    message_type: str
    stamps_ns: list[int]
    message: Callable[[int], Any]


def write_mcap(
    path: str | Path, log: Log, further: dict[str, Trajectory] | None = None, overwrite: bool = False
) -> dict[str, int]:
    """Write what a log holds, and further trajectories by topic name, to an .mcap file; return messages by topic.

    Raises InputError for a target that is there already.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise InputError("is no name of an MCAP file", path=path, fix="let it end in .mcap")
    if path.exists() and not overwrite:
        raise InputError("is there already", path=path, fix="choose another name or pass --overwrite")
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError:
        raise InputError("writing MCAP needs rosbags", fix="pip install rosbags") from None
    store = typestore_with_vision(_STORE)
    topics = list(_topics(store, log, further or {}))
    if not topics:
        raise InputError("there is nothing to write", path=log.path, fix="give a log or a trajectory")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            _write(writer, store, topics)
        shutil.move(next(bag.glob("*.mcap")), path)
    return {topic.name: len(topic.stamps_ns) for topic in topics}


def _write(writer: Any, store: Any, topics: list[_Topic]) -> None:
    connections = [writer.add_connection(topic.name, topic.message_type, typestore=store) for topic in topics]
    stamps = np.concatenate([topic.stamps_ns for topic in topics]).astype(np.int64)
    which = np.repeat(np.arange(len(topics)), [len(topic.stamps_ns) for topic in topics])
    row = np.concatenate([np.arange(len(topic.stamps_ns)) for topic in topics])
    for index in np.argsort(stamps, kind="stable").tolist():
        topic = topics[which[index]]
        data = store.serialize_cdr(topic.message(int(row[index])), topic.message_type)
        writer.write(connections[which[index]], int(stamps[index]), data)


def _topics(store: Any, log: Log, further: dict[str, Trajectory]) -> Iterator[_Topic]:
    trajectories = {"/truth/T_world_cam": log.T_world_cam, "/truth/T_world_imu": log.T_world_imu}
    trajectories |= {"/odometry/T_odom_cam": log.T_odom_cam, **further}
    if log.camera_poses is not None:
        poses = log.camera_poses
        trajectories["/camera_poses"] = Trajectory(poses.stamps_ns, poses.T_world_cam)
    for name, trajectory in trajectories.items():
        if trajectory is not None and len(trajectory):
            parent = "odom" if name.startswith("/odometry") else "world"
            child = name.strip("/").replace("/", "_")
            yield from _of_trajectory(store.types, name, trajectory, parent, child)
    for name, detections in log.object_poses.items():
        if len(detections):
            yield _of_detections(store.types, f"/object_poses/{name}".rstrip("/"), detections)
    if log.imu is not None:
        yield _of_imu(store.types, log.imu)


def _header(types: Any, stamp_ns: int, frame: str) -> Any:
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, rest), frame)


def _point(types: Any, kind: str, t: Any) -> Any:
    return types[f"geometry_msgs/msg/{kind}"](*map(float, t))


def _quaternion(types: Any, q_xyzw: Any) -> Any:
    return types["geometry_msgs/msg/Quaternion"](*map(float, q_xyzw))


def _of_trajectory(types: Any, name: str, trajectory: Trajectory, parent: str, child: str) -> Iterator[_Topic]:
    stamps = trajectory.stamps_ns.tolist()
    positions = np.asarray(trajectory.T_world_body.translation)
    quaternions = trajectory.T_world_body.rotation.as_quat(canonical=True)

    def pose(row: int) -> Any:
        body = types["geometry_msgs/msg/Pose"](
            _point(types, "Point", positions[row]), _quaternion(types, quaternions[row])
        )
        return types["geometry_msgs/msg/PoseStamped"](_header(types, stamps[row], parent), body)

    def transform(row: int) -> Any:
        body = types["geometry_msgs/msg/Transform"](
            _point(types, "Vector3", positions[row]), _quaternion(types, quaternions[row])
        )
        stamped = types["geometry_msgs/msg/TransformStamped"](_header(types, stamps[row], parent), child, body)
        return types["tf2_msgs/msg/TFMessage"]([stamped])

    yield _Topic(name, "geometry_msgs/msg/PoseStamped", stamps, pose)
    yield _Topic(f"/tf{name}", "tf2_msgs/msg/TFMessage", stamps, transform)


def _of_detections(types: Any, name: str, poses: ObjectPoses) -> _Topic:
    stamps, first = np.unique(poses.stamps_ns, return_index=True)
    ends = [*first[1:].tolist(), len(poses)]
    positions = np.asarray(poses.T_cam_obj.translation)
    quaternions = poses.T_cam_obj.rotation.as_quat(canonical=True)
    covariances = np.zeros((len(poses), 36))
    if poses.covariances is not None:
        turned = np.nan_to_num(poses.covariances)[:, _ROS_ORDER][:, :, _ROS_ORDER]
        covariances = np.ascontiguousarray(turned.reshape(-1, 36))

    def detection(row: int, header: Any) -> Any:
        pose = types["geometry_msgs/msg/Pose"](
            _point(types, "Point", positions[row]), _quaternion(types, quaternions[row])
        )
        hypothesis = types["vision_msgs/msg/ObjectHypothesis"](str(poses.object_ids[row]), float(poses.scores[row]))
        result = types["vision_msgs/msg/ObjectHypothesisWithPose"](
            hypothesis, types["geometry_msgs/msg/PoseWithCovariance"](pose, covariances[row])
        )
        box = types["vision_msgs/msg/BoundingBox3D"](pose, _point(types, "Vector3", (0.0, 0.0, 0.0)))
        return types["vision_msgs/msg/Detection3D"](header, [result], box, str(poses.instances[row]))

    def message(index: int) -> Any:
        header = _header(types, int(stamps[index]), "cam")
        rows = range(int(first[index]), ends[index])
        return types["vision_msgs/msg/Detection3DArray"](header, [detection(row, header) for row in rows])

    return _Topic(name, "vision_msgs/msg/Detection3DArray", stamps.tolist(), message)


def _of_imu(types: Any, imu: ImuSamples) -> _Topic:
    stamps, unknown = imu.stamps_ns.tolist(), np.zeros(9)
    no_orientation = np.array([-1.0, *[0.0] * 8])  # what sensor_msgs/Imu says for: there is none

    def message(row: int) -> Any:
        return types["sensor_msgs/msg/Imu"](
            _header(types, stamps[row], "imu"),
            _quaternion(types, (0.0, 0.0, 0.0, 1.0)),
            no_orientation,
            _point(types, "Vector3", imu.angular_velocity[row]),
            unknown,
            _point(types, "Vector3", imu.specific_force[row]),
            unknown,
        )

    return _Topic("/imu", "sensor_msgs/msg/Imu", stamps, message)
