"""ROS bags become logs: IMU, detections, camera poses, trajectories and the stamps of images, by header stamps."""

from __future__ import annotations

import warnings
from array import array
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from poet_loc.core.geometry import pose_from_quaternion
from poet_loc.core.input_error import InputError
from poet_loc.core.records import CameraPoses, ImuSamples, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.bag_images import write_image
from poet_loc.io.bag_messages import BagTopic, header_stamp_ns, open_bag, topics_of
from poet_loc.io.frames_csv import Frames
from poet_loc.io.input_text import read_json
from poet_loc.io.log_folder import Log, check_log, read_log_files, write_log
from poet_loc.io.object_poses_csv import count_instances
from poet_loc.io.pose_columns import not_positive_definite
from poet_loc.io.whole_folder import whole_folder

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Told how many messages of how many were read."""

_POSES = (
    *("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped", "geometry_msgs/TransformStamped"),
    *("nav_msgs/Odometry", "tf2_msgs/TFMessage", "tf/tfMessage"),
)
ROLES: Mapping[str, tuple[str, ...]] = {
    "imu": ("sensor_msgs/Imu",),
    "detections": ("vision_msgs/Detection3DArray",),
    "camera_poses": _POSES,
    "truth_cam": _POSES,
    "truth_imu": _POSES,
    "odometry": _POSES,
    "images": ("sensor_msgs/CompressedImage", "sensor_msgs/Image"),
}
"""What a topic can become, and of which types it then is."""
_GUESSED = {
    "imu": ROLES["imu"],
    "detections": ROLES["detections"],
    "camera_poses": ("geometry_msgs/PoseWithCovarianceStamped",),
    "images": ROLES["images"],
}
_ROS_ORDER = np.array([3, 4, 5, 0, 1, 2])  # ROS: position, rotation; ours: rotation, position
_EVERY = 2000


@dataclass(frozen=True)
class ConvertRosbagOptions:
    """Which topics become which file of the log. Without a name a topic is guessed where one alone has the type;
    "none" leaves it out. Of a tf topic name the frames too: /tf:PARENT:CHILD."""

    imu: str | None = None
    """sensor_msgs/Imu: imu.csv."""
    detections: str | None = None
    """vision_msgs/Detection3DArray: object_poses.csv."""
    camera_poses: str | None = None
    """Poses of the camera in the map's world: camera_poses.csv. Only PoseWithCovarianceStamped is guessed."""
    truth_cam: str | None = None
    """Ground truth of the camera: T_world_cam.tum. Never guessed."""
    truth_imu: str | None = None
    """Ground truth of the IMU: T_world_imu.tum. Never guessed."""
    odometry: str | None = None
    """Odometry of the camera: T_odom_cam.tum. Never guessed."""
    images: str | None = None
    """CompressedImage or Image: their stamps become frames.csv."""
    extract_images: bool = False
    """Write the images too, to images/ of the log: compressed ones as they are, raw ones as PNG."""
    classes: Path | None = None
    """{"1": "box", ..}: the object id of each class name; without it names are looked up in the map of --like."""
    typestore: str | None = None
    """What wrote the bag, where it does not carry its message types: ros2_humble, ros1_noetic, .."""
    like: Path | None = None
    """Folder whose landmarks, calibration and further files the new log takes over."""
    overwrite: bool = False
    """Replace an output folder that holds something."""


@dataclass(frozen=True)
class RosbagConversion:
    """What a bag became."""

    log: Log
    chosen: Mapping[str, str]
    """Role -> topic."""
    unused: tuple[BagTopic, ...]
    dropped: Mapping[str, int]
    """Topic -> messages that repeat a stamp or have no rotation."""


@dataclass
class _Columns:
    """Numbers of one topic as they come in: eight bytes each."""

    stamps: array = field(default_factory=lambda: array("q"))
    numbers: array = field(default_factory=lambda: array("d"))
    names: list[str] = field(default_factory=list)


def convert_rosbag(
    bag: str | Path, out: str | Path, options: ConvertRosbagOptions | None = None, progress: Progress | None = None
) -> RosbagConversion:
    """Write a log folder from a ROS 1 bag, a ROS 2 bag or an MCAP file; one message is in memory at a time.

    Raises InputError for a topic that is missing, of the wrong type or ambiguous, and for what readers of logs refuse.
    """
    options = options or ConvertRosbagOptions()
    like = Log(Path(out)) if options.like is None else read_log_files(options.like)
    inputs = [path for path in (bag, options.classes, options.like) if path is not None]
    with whole_folder(out, options.overwrite, inputs) as folder:
        with open_bag(bag, options.typestore) as reader:
            topics = topics_of(reader)
            chosen = choose_topics(topics, options, Path(bag))
            columns = _read(reader, chosen, folder if options.extract_images else None, progress)
        log, dropped = _log_of(columns, chosen, replace(like, path=Path(out)), options)
        check_log(log)
        write_log(folder, log)
    used = {topic.split(":")[0] for topic in chosen.values()}
    unused = tuple(topic for topic in topics if topic.name not in used)
    return RosbagConversion(log, chosen, unused, dropped)


def choose_topics(topics: list[BagTopic], options: ConvertRosbagOptions, bag: Path) -> dict[str, str]:
    """Return the topic of each role, named or guessed by type."""
    types = {topic.name: topic.message_type for topic in topics}
    chosen = {}
    for each in fields(options):
        if each.name not in ROLES:
            continue
        role, named = each.name, getattr(options, each.name)
        flag = f"--{role.replace('_', '-')}"
        if named is None:
            fitting = [
                topic.name for topic in topics if topic.message_type in _GUESSED.get(role, ()) and topic.messages
            ]
            if len(fitting) > 1:
                what = f"has several topics for {flag}: {', '.join(fitting)}"
                raise InputError(what, path=bag, fix=f"choose one, or {flag} none")
            if fitting:
                chosen[role] = fitting[0]
        elif named != "none":
            name = named.split(":")[0]
            if name not in types:
                raise InputError(f"has no topic {name}", path=bag, fix=f"one of {', '.join(types)}")
            if types[name] not in ROLES[role]:
                what = f"topic {name} is {types[name]}"
                raise InputError(what, path=bag, fix=f"{flag} takes {', '.join(ROLES[role])}")
            if types[name].startswith("tf") and named.count(":") != 2:
                raise InputError(f"topic {name} holds many frames", path=bag, fix=f"{flag} {name}:PARENT:CHILD")
            chosen[role] = named
    if not chosen:
        listed = ", ".join(f"{topic.name} ({topic.message_type})" for topic in topics) or "none"
        raise InputError(f"no topic was chosen or guessed among {listed}", path=bag, fix="name topics, see --help")
    _refuse_unread(options, chosen, bag)
    return chosen


def _refuse_unread(options: ConvertRosbagOptions, chosen: Mapping[str, str], bag: Path) -> None:
    """Raise InputError for an option about a topic that is not there."""
    asked = {"--extract-images": ("images", options.extract_images), "--classes": ("detections", options.classes)}
    for flag, (role, given) in asked.items():
        if given and role not in chosen:
            what = f"{flag} changes nothing: no topic was chosen or guessed for --{role}"
            raise InputError(what, path=bag, fix="name the topic, or leave it out")


def _read(
    reader: Any, chosen: Mapping[str, str], images_to: Path | None, progress: Progress | None
) -> dict[str, _Columns]:
    columns = {role: _Columns() for role in chosen}
    by_topic: dict[str, list[str]] = {}
    for role, topic in chosen.items():
        by_topic.setdefault(topic.split(":")[0], []).append(role)
    connections = [each for each in reader.connections if each.topic in by_topic]
    total = sum(each.msgcount for each in connections)
    for count, (connection, _, data) in enumerate(reader.messages(connections)):
        message = reader.deserialize(data, connection.msgtype)
        for role in by_topic[connection.topic]:
            _take(role, message, connection.msgtype.replace("/msg/", "/"), chosen[role], columns[role])
            if role == "images":
                number = len(columns[role].stamps) - 1
                name = f"{chosen[role]}#{number}" if images_to is None else write_image(images_to, number, message)
                columns[role].names.append(name)
        if progress is not None and count % _EVERY == 0:
            progress(count, total)
    if progress is not None:
        progress(total, total)
    return columns


def _take(role: str, message: Any, message_type: str, chosen: str, columns: _Columns) -> None:
    if message_type in ("tf2_msgs/TFMessage", "tf/tfMessage"):
        _, parent, child = chosen.split(":")
        for transform in message.transforms:
            if (transform.header.frame_id.strip("/"), transform.child_frame_id.strip("/")) == (
                parent.strip("/"),
                child.strip("/"),
            ):
                columns.stamps.append(header_stamp_ns(transform))
                columns.numbers.extend(_pose(transform.transform))
                columns.numbers.extend(_NO_COVARIANCE)
        return
    if role == "detections":
        _take_detections(message, columns)
        return
    columns.stamps.append(header_stamp_ns(message))
    if role == "imu":
        w, a = message.angular_velocity, message.linear_acceleration
        columns.numbers.extend((w.x, w.y, w.z, a.x, a.y, a.z))
    elif role != "images":
        pose, covariance = _pose_of(message)
        columns.numbers.extend(pose)
        columns.numbers.extend(covariance)


_NO_COVARIANCE = [0.0] * 36


def _take_detections(message: Any, columns: _Columns) -> None:
    """Take the best hypothesis of each detection; vision_msgs 3 and 4 nest it, older ones do not."""
    stamp = header_stamp_ns(message)
    for detection in message.detections:
        if not len(detection.results):
            continue
        best: Any = max(detection.results, key=lambda result: _hypothesis(result).score)
        hypothesis = _hypothesis(best)
        columns.stamps.append(stamp)
        columns.names.append(str(hypothesis.class_id if hasattr(hypothesis, "class_id") else hypothesis.id))
        columns.numbers.append(float(hypothesis.score))
        columns.numbers.extend(_pose(best.pose.pose))
        columns.numbers.extend(best.pose.covariance)


def _hypothesis(result: Any) -> Any:
    return result.hypothesis if hasattr(result, "hypothesis") else result


def _pose_of(message: Any) -> tuple[list[float], Any]:
    if hasattr(message, "transform"):
        return _pose(message.transform), _NO_COVARIANCE
    if hasattr(message.pose, "covariance"):
        return _pose(message.pose.pose), message.pose.covariance
    return _pose(message.pose), _NO_COVARIANCE


def _pose(pose: Any) -> list[float]:
    t = pose.position if hasattr(pose, "position") else pose.translation
    q = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    return [t.x, t.y, t.z, q.x, q.y, q.z, q.w]


def _log_of(
    columns: Mapping[str, _Columns], chosen: Mapping[str, str], log: Log, options: ConvertRosbagOptions
) -> tuple[Log, dict[str, int]]:
    dropped: dict[str, int] = {}
    names = {"truth_cam": "T_world_cam", "truth_imu": "T_world_imu", "odometry": "T_odom_cam"}
    for role, read in columns.items():
        stamps = np.array(read.stamps, np.int64)
        if not len(stamps):
            raise InputError(f"topic {chosen[role]} has no message that can be used", fix="look at its frames' names")
        numbers = np.array(read.numbers).reshape(len(stamps), -1)
        keep = _kept(role, stamps, numbers)
        if not stamps.any():
            raise InputError(f"the headers of {chosen[role]} have no stamps", fix="let the driver stamp its messages")
        if not len(keep):
            raise InputError(
                f"the quaternions of {chosen[role]} are zero", fix=f"choose another topic than {chosen[role]}"
            )
        if len(keep) < len(stamps):
            dropped[chosen[role]] = len(stamps) - len(keep)
        stamps, numbers = stamps[keep], numbers[keep]
        frames = np.unique(stamps, return_inverse=True)[1].astype(np.int64)
        if role == "imu":
            log = replace(log, imu=ImuSamples(stamps, numbers[:, :3], numbers[:, 3:]))
        elif role == "images":
            log = replace(log, frames=Frames(stamps, frames, tuple(read.names[row] for row in keep)))
        elif role == "detections":
            ids, mapped = _object_ids([read.names[row] for row in keep], log, options.classes)
            poses = ObjectPoses(
                stamps_ns=stamps,
                frames=frames,
                object_ids=ids,
                instances=count_instances(frames, ids),
                scores=numbers[:, 0],
                T_cam_obj=pose_from_quaternion(numbers[:, 1:4], numbers[:, 4:8]),
                covariances=_covariances(numbers[:, 8:44]),
            )[mapped]
            log = replace(log, object_poses={**log.object_poses, "": poses})
        else:
            T = pose_from_quaternion(numbers[:, :3], numbers[:, 3:7])
            if role == "camera_poses":
                covariances = _covariances(numbers[:, 7:43], T.rotation.as_matrix())
                log = replace(log, camera_poses=CameraPoses(stamps, frames, T, covariances))
            else:
                log = replace(log, **{names[role]: Trajectory(stamps, T)})  # type: ignore[arg-type]
    return log, dropped


def _kept(role: str, stamps: NDArray[np.int64], numbers: Array) -> NDArray[np.intp]:
    """Return the rows in order of time; without a rotation, or a second one at a stamp, a row is left out."""
    order = np.argsort(stamps, kind="stable")
    if role not in ("imu", "images"):
        first = 4 if role == "detections" else 3
        usable = np.linalg.norm(numbers[:, first : first + 4], axis=1) > 0.5
        order = order[usable[order]]
    if role == "detections":
        return order
    return order[np.concatenate([[True], np.diff(stamps[order]) > 0])] if len(order) else order


def _covariances(values: Array, rotations: Array | None = None) -> Array | None:
    """Return (N, 6, 6) of [e_r, e_t] from ROS' [position, rotation about fixed axes]; NaN where there is none.

    rotations: where our rotation error is in body axes, e_body = R^T e_fixed.
    """
    covariances = values.reshape(-1, 6, 6)[:, _ROS_ORDER][:, :, _ROS_ORDER]
    if rotations is not None:
        turn = np.tile(np.eye(6), (len(values), 1, 1))
        turn[:, :3, :3] = np.swapaxes(rotations, 1, 2)
        covariances = turn @ covariances @ np.swapaxes(turn, 1, 2)
    absent = not_positive_definite(covariances)
    if absent.all():
        return None
    covariances[absent] = np.nan
    return covariances


def _object_ids(names: list[str], log: Log, classes: Path | None) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the object id of each detection, and which of them the map has: detectors know more than a map.

    What it has not is left out with a warning that counts it; where nothing would be left, InputError is raised.
    """
    if classes is not None:
        content = read_json(classes)
        if not isinstance(content, Mapping) or not all(key.isdigit() for key in content):
            raise InputError("is no classes file", path=classes, fix='write {"1": "box", "5": "can", ..}')
        numbers = {str(name): int(key) for key, name in content.items()}
    elif all(name.lstrip("-").isdigit() for name in names):
        numbers = {name: int(name) for name in set(names)}
    else:
        numbers = {landmark.name: landmark.object_id for landmark in log.landmark_map or () if landmark.name}
    counts = Counter(names)
    if not counts.keys() & numbers.keys():
        what = f"class {min(counts)!r} has no object id ({', '.join(sorted(counts))})"
        raise InputError(what, fix="give --classes, or a map with these names through --like")
    ids = np.array([numbers.get(name, -1) for name in names], np.int64)
    known = numbers.values() if log.landmark_map is None else log.landmark_map.object_ids
    mapped = np.isin(ids, list(known))
    if not mapped.any():
        return ids, ids >= 0  # of another map altogether: whoever checks the log says so
    left_out = sorted({name for name, there in zip(names, mapped, strict=True) if not there})
    if left_out:
        told = ", ".join(f"{name} ({counts[name]})" for name in left_out)
        warnings.warn(
            f"left out {(~mapped).sum()} detections of objects that the map does not have: {told}", stacklevel=2
        )
    return ids, mapped
