"""ROS bags without ROS: opening them, their topics, and the message texts that no type store has.

Needs the extra `bags` (rosbags); it is imported inside the functions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from poet_loc.core.input_error import InputError

# vision_msgs 3 and 4 (ROS 2 Galactic and later); in three dimensions the two have the same fields
VISION_MSGS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
# before that (ROS 2 Foxy and older) a hypothesis was flat and a detection carried its cloud
OLD_VISION_MSGS = VISION_MSGS | {
    "vision_msgs/msg/ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
        "sensor_msgs/PointCloud2 source_cloud\nbool is_tracking\nstring tracking_id\n"
    ),
}
_TF = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}  # rosbags' ROS 1 store lacks it
_OLD_STORES = ("ros2_dashing", "ros2_eloquent", "ros2_foxy")


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag."""

    name: str
    message_type: str
    """Without the msg part that only ROS 2 has: sensor_msgs/Imu."""
    messages: int


def typestore_with_vision(name: str) -> Any:
    """Return one of rosbags' type stores, by its name (ros2_humble), with vision_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    names = [store.value for store in Stores if store.value != "empty"]
    if name not in names:
        raise InputError(f"unknown type store {name!r}", fix=f"one of {', '.join(names)}")
    store = get_typestore(Stores(name))
    texts = OLD_VISION_MSGS if name in _OLD_STORES else VISION_MSGS
    for kind, text in (texts | _TF).items():
        if kind not in store.fielddefs:
            store.register(get_types_from_msg(text, kind))
    return store


@contextmanager
def open_bag(path: str | Path, typestore: str | None = None) -> Iterator[Any]:
    """Yield rosbags' reader of a .bag, a .db3, an .mcap, a folder of a ROS 2 bag, or a folder of .bag files.

    typestore: what the messages are where the bag does not say. Raises InputError for what is no bag.
    """
    path = Path(path)
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
    except ImportError:
        raise InputError("reading bags needs rosbags", fix="pip install rosbags") from None
    store = None if typestore is None else typestore_with_vision(typestore)
    try:
        reader = AnyReader(_files(path), default_typestore=store)
        reader.open()
    except (AnyReaderError, FileNotFoundError, AssertionError) as error:
        fix = "give a .bag, .db3, .mcap or the folder of a ROS 2 bag"
        if "no type definitions" in str(error):
            fix = "name the ROS that wrote it: --typestore ros2_foxy, ros2_humble, .."
        elif "end magic" in str(error):
            fix = "a recording that was cut off is mended by: mcap recover FILE"
        raise InputError(f"cannot be opened: {error}", path=path, fix=fix) from error
    try:
        yield reader
    finally:
        reader.close()


def _files(path: Path) -> Sequence[Path]:
    if not path.exists():
        raise InputError("does not exist", path=path, fix="check the path")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        bags = sorted(path.glob("*.bag"))
        single = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
        if bags or len(single) == 1:
            return bags or single
        raise InputError("is no bag", path=path, fix="give a .bag, .db3, .mcap or the folder of a ROS 2 bag")
    return [path]


def topics_of(reader: Any) -> list[BagTopic]:
    """Return the topics of an open bag."""
    return [
        BagTopic(name, (info.msgtype or "several types").replace("/msg/", "/"), info.msgcount)
        for name, info in reader.topics.items()
    ]


def list_topics(path: str | Path, typestore: str | None = None) -> list[BagTopic]:
    """Return the topics of a bag."""
    with open_bag(path, typestore) as reader:
        return topics_of(reader)


def header_stamp_ns(message: Any) -> int:
    """Return the stamp of a message's header: when it was measured, not when it was received."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
