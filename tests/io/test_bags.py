"""Bags written by rosbags' own writers are read by header stamps; our MCAP is read back by rosbags and by rerun."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import CameraPoses, ImuSamples, Landmark, LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.bag_messages import list_topics, typestore_with_vision
from poet_loc.io.convert_rosbag import ConvertRosbagOptions, convert_rosbag
from poet_loc.io.log_folder import Log, write_log
from poet_loc.io.mcap_log import write_mcap

rosbags = pytest.importorskip("rosbags", reason="the extra bags is not installed")

START = 1_700_000_000_123_456_789
RECEIVED_LATER = 7_000_000  # ns
rng = np.random.default_rng(0)
IMU = ImuSamples(START + np.arange(40) * 5_000_001, rng.normal(size=(40, 3)), rng.normal(size=(40, 3)))
STAMPS = START + np.arange(6) * 33_333_333
POSES = make_pose(Rotation.random(6, rng=rng), rng.normal(size=(6, 3)))
SQUARE = rng.normal(size=(6, 6, 6))
COVARIANCES = SQUARE @ np.swapaxes(SQUARE, 1, 2) + 0.1 * np.eye(6)  # ROS': position, rotation about fixed axes


class Messages:
    """Messages of one type store; ROS 1 headers count, ROS 2 headers do not."""

    def __init__(self, store: str) -> None:
        self.store, self.types, self.ros1 = typestore_with_vision(store), None, store.startswith("ros1")
        self.types = self.store.types

    def header(self, stamp: int, frame: str):
        time = self.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        return self.types["std_msgs/msg/Header"](*([0] if self.ros1 else []), time, frame)

    def xyz(self, kind: str, values):
        return self.types[f"geometry_msgs/msg/{kind}"](*map(float, values))

    def pose(self, row: int):
        orientation = self.types["geometry_msgs/msg/Quaternion"](*map(float, POSES.rotation[row].as_quat()))
        return self.types["geometry_msgs/msg/Pose"](self.xyz("Point", POSES.translation[row]), orientation)

    def with_covariance(self, row: int):
        return self.types["geometry_msgs/msg/PoseWithCovariance"](self.pose(row), COVARIANCES[row].ravel())

    def imu(self, row: int):
        none, unit = np.zeros(9), self.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        rates, force = self.xyz("Vector3", IMU.angular_velocity[row]), self.xyz("Vector3", IMU.specific_force[row])
        header = self.header(int(IMU.stamps_ns[row]), "imu")
        return self.types["sensor_msgs/msg/Imu"](header, unit, none, rates, none, force, none)

    def camera_pose(self, row: int):
        kind = self.types["geometry_msgs/msg/PoseWithCovarianceStamped"]
        return kind(self.header(int(STAMPS[row]), "map"), self.with_covariance(row))

    def odometry(self, row: int):
        none = self.types["geometry_msgs/msg/TwistWithCovariance"](
            self.types["geometry_msgs/msg/Twist"](self.xyz("Vector3", [0] * 3), self.xyz("Vector3", [0] * 3)),
            np.zeros(36),
        )
        kind = self.types["nav_msgs/msg/Odometry"]
        return kind(self.header(int(STAMPS[row]), "odom"), "cam", self.with_covariance(row), none)

    def tf(self, row: int, name: str):
        kind = self.types["geometry_msgs/msg/TransformStamped"]
        body = self.types["geometry_msgs/msg/Transform"](
            self.xyz("Vector3", POSES.translation[row]), self.pose(row).orientation
        )
        header = self.header(int(STAMPS[row]), "world")
        other = kind(
            header,
            "elsewhere",
            self.types["geometry_msgs/msg/Transform"](self.xyz("Vector3", [9, 9, 9]), self.pose(0).orientation),
        )
        return self.types[name]([other, kind(header, "cam", body)])

    def detections(self, row: int):
        header = self.header(int(STAMPS[row]), "cam")
        box = self.types["vision_msgs/msg/BoundingBox3D"](self.pose(row), self.xyz("Vector3", [1, 1, 1]))
        found = []
        for name, score in (("mug", 0.4), ("box", 0.9)):
            kind = self.types["vision_msgs/msg/ObjectHypothesisWithPose"]
            if "vision_msgs/msg/ObjectHypothesis" in self.types and "hypothesis" in kind.__annotations__:
                hypothesis = self.types["vision_msgs/msg/ObjectHypothesis"](name, score)
                found.append(kind(hypothesis, self.with_covariance(row)))
            else:
                found.append(kind(name, score, self.with_covariance(row)))
        extra = []
        if "source_cloud" in self.types["vision_msgs/msg/Detection3D"].__annotations__:
            cloud = self.types["sensor_msgs/msg/PointCloud2"](
                header, 0, 0, [], False, 0, 0, np.zeros(0, np.uint8), False
            )
            extra = [cloud, False]
        detection = self.types["vision_msgs/msg/Detection3D"](header, found, box, *extra, "7")
        return self.types["vision_msgs/msg/Detection3DArray"](header, [detection])

    def image(self, row: int):
        kind = self.types["sensor_msgs/msg/CompressedImage"]
        return kind(self.header(int(STAMPS[row]), "cam"), "png", np.zeros(10, np.uint8))


def streams(messages: Messages, tf_name: str):
    yield "/imu", "sensor_msgs/msg/Imu", IMU.stamps_ns, messages.imu
    yield "/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", STAMPS, messages.camera_pose
    yield "/odom", "nav_msgs/msg/Odometry", STAMPS, messages.odometry
    yield "/tf", tf_name, STAMPS, lambda row: messages.tf(row, tf_name)
    yield "/image", "sensor_msgs/msg/CompressedImage", STAMPS, messages.image
    yield "/objects", "vision_msgs/msg/Detection3DArray", STAMPS, messages.detections


def write_bag(path: Path, kind: str, store: str) -> Path:
    """Write with rosbags' writers; receipt is later than the header says, and shuffled."""
    messages = Messages(store)
    if kind == "ros1":
        from rosbags.rosbag1 import Writer

        path, opened = path.with_suffix(".bag"), lambda: Writer(path)
        serialize = messages.store.serialize_ros1
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        opened = lambda: Writer(path, version=9, storage_plugin=plugin)  # noqa: E731
        serialize = messages.store.serialize_cdr
    with opened() as writer:
        tf_name = "tf2_msgs/msg/TFMessage"
        for topic, message_type, stamps, make in streams(messages, tf_name):
            connection = writer.add_connection(topic, message_type, typestore=messages.store)
            for row in range(len(stamps)):
                data = serialize(make(row), message_type)
                writer.write(connection, int(stamps[row]) + RECEIVED_LATER, data)
    return path


@pytest.fixture
def like(tmp_path) -> Path:
    folder = tmp_path / "like"
    folder.mkdir()
    place = make_pose(Rotation.identity(), np.zeros(3))
    write_log(
        folder, Log(folder, landmark_map=LandmarkMap((Landmark(3, place, name="box"), Landmark(4, place, name="mug"))))
    )
    return folder


@pytest.mark.parametrize(
    ("kind", "store"),
    [("ros1", "ros1_noetic"), ("db3", "ros2_humble"), ("db3", "ros2_foxy"), ("mcap", "ros2_jazzy")],
)
def test_a_bag_becomes_a_log_by_header_stamps(kind, store, tmp_path, like) -> None:
    bag = write_bag(tmp_path / "bag", kind, store)
    calls: list[tuple[int, int]] = []
    options = ConvertRosbagOptions(
        truth_cam="/tf:world:cam", odometry="/odom", like=like, typestore=store if kind == "db3" else None
    )
    made = convert_rosbag(bag, tmp_path / "log", options, lambda done, total: calls.append((done, total)))
    log = made.log
    np.testing.assert_array_equal(log.imu.stamps_ns, IMU.stamps_ns)
    np.testing.assert_array_equal(log.imu.angular_velocity, IMU.angular_velocity)
    np.testing.assert_array_equal(log.imu.specific_force, IMU.specific_force)
    for trajectory in (log.T_world_cam, log.T_odom_cam):
        np.testing.assert_array_equal(trajectory.stamps_ns, STAMPS)
        np.testing.assert_allclose(trajectory.T_world_body.as_matrix(), POSES.as_matrix(), atol=1e-12)
    detections = log.object_poses[""]
    assert detections.object_ids.tolist() == [3] * 6  # the hypothesis with the higher score, by its name
    np.testing.assert_allclose(detections.T_cam_obj.as_matrix(), POSES.as_matrix(), atol=1e-12)
    order = [3, 4, 5, 0, 1, 2]
    np.testing.assert_allclose(detections.covariances, COVARIANCES[:, order][:, :, order])
    np.testing.assert_array_equal(log.frames.stamps_ns, STAMPS)
    assert calls[-1][0] == calls[-1][1] == 40 + 5 * 6
    assert made.unused == ()


def test_the_covariance_of_a_camera_pose_is_in_body_axes(tmp_path) -> None:
    """ROS' rotation error is about fixed axes, R = Exp(e) R_true; ours R = R_true Exp(e'): e' = R^T e."""
    bag = write_bag(tmp_path / "bag", "mcap", "ros2_humble")
    options = ConvertRosbagOptions(detections="none")
    poses: CameraPoses = convert_rosbag(bag, tmp_path / "log", options).log.camera_poses
    for row in range(6):
        e_fixed = 1e-6 * rng.normal(size=3)
        R = POSES.rotation[row]
        e_body = (R.inv() * Rotation.from_rotvec(e_fixed) * R).as_rotvec()
        turned = np.linalg.solve(poses.covariances[row, :3, :3], e_body) @ e_body
        assert turned == pytest.approx(np.linalg.solve(COVARIANCES[row, 3:, 3:], e_fixed) @ e_fixed, rel=1e-6)
    np.testing.assert_allclose(poses.covariances[:, 3:, 3:], COVARIANCES[:, :3, :3])


def test_objects_that_the_map_does_not_have_are_left_out_and_counted(tmp_path, like) -> None:
    log = whole_log()
    write_mcap(tmp_path / "out.mcap", log)
    place = make_pose(Rotation.identity(), np.zeros(3))
    maps = {"one": (Landmark(4, place),), "none": (Landmark(8, place),)}
    for name, landmarks in maps.items():
        (tmp_path / name).mkdir()
        write_log(tmp_path / name, Log(tmp_path / name, landmark_map=LandmarkMap(landmarks)))
    options = ConvertRosbagOptions(truth_cam="/truth/T_world_cam", like=tmp_path / "one")
    with pytest.warns(UserWarning, match=r"left out 3 detections of objects that the map does not have: 3 \(3\)"):
        back = convert_rosbag(tmp_path / "out.mcap", tmp_path / "log", options).log
    (detections,) = back.object_poses.values()
    assert detections.object_ids.tolist() == [4, 4, 4]
    np.testing.assert_array_equal(detections.stamps_ns, log.object_poses["net"].stamps_ns[1::2])
    with pytest.raises(InputError, match="object 3 is not in the map"):
        convert_rosbag(tmp_path / "out.mcap", tmp_path / "other", replace(options, like=tmp_path / "none"))


def test_what_is_wrong_with_topics_is_one_line(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", "db3", "ros2_humble")
    assert [topic.name for topic in list_topics(bag)][:2] == ["/image", "/imu"]
    for options, words in (
        (ConvertRosbagOptions(imu="/nothing"), "has no topic /nothing"),
        (ConvertRosbagOptions(imu="/odom"), "topic /odom is nav_msgs/Odometry"),
        (ConvertRosbagOptions(truth_cam="/tf"), "holds many frames"),
        (ConvertRosbagOptions(), "has no object id"),
        (ConvertRosbagOptions(images="none", extract_images=True), "--extract-images changes nothing: no topic"),
        (ConvertRosbagOptions(detections="none", classes=tmp_path / "c.json"), "--classes changes nothing: no topic"),
        (ConvertRosbagOptions(typestore="ros3"), "unknown type store"),
    ):
        with pytest.raises(InputError, match=words):
            convert_rosbag(bag, tmp_path / "log", options)
    (tmp_path / "no.bag").write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be opened"):
        list_topics(tmp_path / "no.bag")
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize(
    ("topic", "words"), [("/imu", "headers of /imu have no stamps"), ("/objects", "quaternions of /objects are zero")]
)
def test_messages_that_a_driver_left_unfilled_are_told(topic, words, tmp_path, like, monkeypatch) -> None:
    if topic == "/imu":
        header = Messages.header
        monkeypatch.setattr(
            Messages, "header", lambda self, stamp, frame: header(self, stamp * (frame != "imu"), frame)
        )
    else:
        zero = lambda self, row: self.types["geometry_msgs/msg/Pose"](  # noqa: E731
            self.xyz("Point", POSES.translation[row]), self.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 0.0)
        )
        monkeypatch.setattr(Messages, "pose", zero)
    bag = write_bag(tmp_path / "bag", "db3", "ros2_humble")
    with pytest.raises(InputError, match=words):
        convert_rosbag(bag, tmp_path / "log", ConvertRosbagOptions(like=like, camera_poses="none"))
    assert not (tmp_path / "log").exists()


def test_a_recording_that_was_cut_off_names_its_cure(tmp_path) -> None:
    folder = write_bag(tmp_path / "bag", "mcap", "ros2_humble")
    file = next(folder.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-200])
    with pytest.raises(InputError, match="mcap recover"):
        list_topics(file)


def whole_log() -> Log:
    ids = np.array([3, 4, 3, 4, 3, 4])
    stamps = np.repeat(STAMPS[:3], 2)
    detections = ObjectPoses(
        stamps, np.repeat(np.arange(3), 2), ids, np.zeros(6, np.int64), np.full(6, 0.5), POSES, COVARIANCES
    )
    truth = Trajectory(STAMPS, POSES)
    return Log(Path("log"), object_poses={"net": detections}, imu=IMU, T_world_cam=truth)


def test_our_mcap_goes_round(tmp_path) -> None:
    log = whole_log()
    further = {"/trajectories/fused": Trajectory(STAMPS, POSES)}
    written = write_mcap(tmp_path / "out.mcap", log, further)
    assert written["/imu"] == 40
    options = ConvertRosbagOptions(truth_cam="/truth/T_world_cam", truth_imu="/trajectories/fused")
    back = convert_rosbag(tmp_path / "out.mcap", tmp_path / "log", options).log
    np.testing.assert_array_equal(back.imu.stamps_ns, log.imu.stamps_ns)
    np.testing.assert_array_equal(back.imu.specific_force, log.imu.specific_force)
    np.testing.assert_array_equal(back.T_world_cam.stamps_ns, STAMPS)
    np.testing.assert_allclose(back.T_world_imu.T_world_body.as_matrix(), POSES.as_matrix(), atol=1e-12)
    (detections,) = back.object_poses.values()
    assert detections.object_ids.tolist() == log.object_poses["net"].object_ids.tolist()
    np.testing.assert_allclose(detections.covariances, COVARIANCES)
    with pytest.raises(InputError, match="already"):
        write_mcap(tmp_path / "out.mcap", log)
    write_mcap(tmp_path / "out.mcap", replace(log, imu=None), overwrite=True)


def test_rerun_opens_our_mcap(tmp_path) -> None:
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    assert rerun is not None  # it comes with rerun-sdk
    write_mcap(tmp_path / "out.mcap", whole_log())
    for arguments in (["check", "out.mcap"], ["convert", "out.mcap", "-o", "out.rrd"]):
        done = subprocess.run([rerun, "mcap", *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
    verified = subprocess.run(
        [rerun, "rrd", "stats", "out.rrd"], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert verified.returncode == 0, verified.stderr


def test_raw_and_compressed_images_are_written(tmp_path) -> None:
    import cv2
    from rosbags.rosbag2 import Writer

    messages, pixels = Messages("ros2_humble"), rng.integers(0, 255, (4, 5, 3), dtype=np.uint8)
    padded = np.concatenate([pixels.reshape(4, 15), np.zeros((4, 2), np.uint8)], axis=1)
    encoded = cv2.imencode(".png", pixels[:, :, ::-1])[1].ravel()
    header = messages.header(START, "cam")
    for name, message in (
        ("sensor_msgs/msg/Image", messages.types["sensor_msgs/msg/Image"](header, 4, 5, "rgb8", 0, 17, padded.ravel())),
        ("sensor_msgs/msg/CompressedImage", messages.types["sensor_msgs/msg/CompressedImage"](header, "png", encoded)),
    ):
        bag = tmp_path / name.split("/")[-1]
        with Writer(bag, version=9) as writer:
            connection = writer.add_connection("/image", name, typestore=messages.store)
            writer.write(connection, START, messages.store.serialize_cdr(message, name))
        log = convert_rosbag(bag, tmp_path / f"{bag.name}_log", ConvertRosbagOptions(extract_images=True)).log
        written = cv2.imread(str(tmp_path / f"{bag.name}_log" / log.frames.images[0]))
        np.testing.assert_array_equal(written[:, :, ::-1], pixels)
