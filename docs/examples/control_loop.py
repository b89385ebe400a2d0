"""A control loop around the online filter, without ROS: feed what arrives, ask for the state when it is needed.

Here the sensors are replayed from a log folder; on a robot, `arrivals` is the driver's queue.

    python control_loop.py LOG
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

import poet_loc

CONTROL_PERIOD_NS = 20_000_000  # 50 Hz


def arrivals(log: poet_loc.Log) -> Iterator[tuple[int, str, int | slice]]:
    """Yield (stamp, sensor, rows) in the order of the stamps: one IMU sample or the poses of one frame."""
    imu_ns, poses_ns = log.imu.stamps_ns, log.detections()[1].stamps_ns
    frames_ns, first = np.unique(poses_ns, return_index=True)
    ends = np.append(first[1:], len(poses_ns))
    events = [(int(stamp), "imu", row) for row, stamp in enumerate(imu_ns)]
    events += [(int(t), "poses", slice(a, b)) for t, a, b in zip(frames_ns, first.tolist(), ends.tolist(), strict=True)]
    return iter(sorted(events, key=lambda event: event[0]))


def control(state: poet_loc.OnlineState) -> np.ndarray:
    """Return a velocity command, m/s in world axes: towards the place above the table's middle, slowly."""
    return np.clip(0.5 * (np.array([0.0, 0.0, 0.6]) - state.position), -0.2, 0.2)


def run(log: poet_loc.Log) -> tuple[list[poet_loc.OnlineState], list[np.ndarray]]:
    """Replay a log through the filter; return the states that the controller saw and its commands."""
    # compiles or loads the kernels: before the loop, not in it
    estimator = poet_loc.Estimator(log.calibration, log.landmark_map)
    poses, imu = log.detections()[1], log.imu
    positions, q_xyzw = poses.T_cam_obj.translation, poses.T_cam_obj.rotation.as_quat()
    states, commands, next_ns = [], [], int(imu.stamps_ns[0])
    for stamp_ns, sensor, rows in arrivals(log):
        if sensor == "imu":
            estimator.feed_imu(stamp_ns, imu.angular_velocity[rows], imu.specific_force[rows])
        else:
            estimator.feed_object_poses(stamp_ns, poses.object_ids[rows], positions[rows], q_xyzw[rows])
        if sensor == "imu" and stamp_ns >= next_ns:
            next_ns += CONTROL_PERIOD_NS
            state = estimator.state()  # None until enough votes have agreed: a robot stays where it is
            if state is not None:
                states.append(state)
                commands.append(control(state))
    print(f"{estimator.health().mode}, {len(states)} commands")
    return states, commands


if __name__ == "__main__":
    run(poet_loc.read_log(sys.argv[1]))
