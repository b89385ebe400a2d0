"""A ROS 2 node around the online filter: IMU and detections in, odometry out.  Needs ROS 2; poet-loc itself does not.

    ros2 run ... or: python ros2_node.py --ros-args -p calibration:=calibration.yaml -p landmarks:=landmarks.json

Subscribes to `imu` (sensor_msgs/Imu) and `detections` (vision_msgs/Detection3DArray; the class id is the object id),
publishes `odometry` (nav_msgs/Odometry, world -> imu) at each IMU sample after the start.
"""

from __future__ import annotations

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from vision_msgs.msg import Detection3DArray

import poet_loc


def nanoseconds(stamp) -> int:
    """Return a header's stamp: that of the measurement, not of its arrival."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


class PoetLocNode(Node):
    """One estimator; callbacks of one single-threaded executor, since the estimator has no locks."""

    def __init__(self) -> None:
        super().__init__("poet_loc")
        calibration = self.declare_parameter("calibration", "calibration.yaml").value
        landmarks = self.declare_parameter("landmarks", "landmarks.json").value
        self.estimator = poet_loc.Estimator(
            poet_loc.read_calibration(calibration), poet_loc.read_landmarks(landmarks), poet_loc.FuseOptions()
        )
        self.publisher = self.create_publisher(Odometry, "odometry", 10)
        self.create_subscription(Imu, "imu", self.on_imu, qos_profile_sensor_data)
        self.create_subscription(Detection3DArray, "detections", self.on_detections, qos_profile_sensor_data)
        self.create_timer(1.0, self.tell_health)

    def on_imu(self, message: Imu) -> None:
        """Feed one sample and publish the state at it."""
        rate, force = message.angular_velocity, message.linear_acceleration
        self.estimator.feed_imu(
            nanoseconds(message.header.stamp), (rate.x, rate.y, rate.z), (force.x, force.y, force.z)
        )
        state = self.estimator.state()
        if state is not None:
            self.publisher.publish(self.odometry(state, message.header.stamp))

    def on_detections(self, message: Detection3DArray) -> None:
        """Feed the object poses of one frame; late frames are put in their place by the estimator."""
        named = [each.results for each in message.detections if each.results]
        if not named:
            return
        best = [max(results, key=lambda result: result.hypothesis.score) for results in named]
        poses = [result.pose.pose for result in best]
        self.estimator.feed_object_poses(
            nanoseconds(message.header.stamp),
            [int(result.hypothesis.class_id) for result in best],
            [(p.position.x, p.position.y, p.position.z) for p in poses],
            [(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses],
        )

    def odometry(self, state: poet_loc.OnlineState, stamp) -> Odometry:
        """Return the state as a message: ROS orders covariances [translation, rotation], twists in body axes."""
        message = Odometry()
        message.header.stamp, message.header.frame_id, message.child_frame_id = stamp, "world", "imu"
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        position.x, position.y, position.z = map(float, state.position)
        orientation.x, orientation.y, orientation.z, orientation.w = state.T_world_imu.rotation.as_quat().tolist()
        # the filter's rotation error is about imu axes, ROS' about the axes of the header's frame
        turn = np.eye(6)
        turn[3:, 3:] = state.R_world_imu
        order = [3, 4, 5, 0, 1, 2]
        message.pose.covariance = (turn @ state.covariance[np.ix_(order, order)] @ turn.T).ravel().tolist()
        velocity = state.R_world_imu.T @ state.velocity
        message.twist.twist.linear.x, message.twist.twist.linear.y, message.twist.twist.linear.z = map(float, velocity)
        return message

    def tell_health(self) -> None:
        """Say once a second what became of the input, where something is wrong with it."""
        health = self.estimator.health()
        if health.mode != "tracking" or health.too_late or health.not_in_map:
            self.get_logger().info(
                f"{health.mode}: {health.too_late} too late, {health.not_in_map} not in the map, "
                f"{health.restarts} restarts"
            )


def main() -> None:
    """Spin until Ctrl-C."""
    rclpy.init()
    node = PoetLocNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
