"""poet-loc convert FORMAT: each format is a module of convert_commands."""

COMMANDS = {
    "bop": "BOP scenes become one log each, with ground truth and the map derived from it",
    "poet": "PoET's results.json becomes the object poses of a log, with the stamps that it lacks",
    "annotation": "PoET's annotation.json becomes the object poses of a log",
    "super6d": "slam-super-6d's text files become the object poses of a log",
    "rosbag": "a ROS 1 bag, a ROS 2 bag or an MCAP file becomes a log; lists the topics without OUT",
    "euroc": "a EuRoC (ASL) folder becomes a log",
    "kalibr": "Kalibr's camchain and imu yaml become a log's calibration",
    "tum": "a camera trajectory becomes the camera poses of a log",
    "kitti": "KITTI poses become camera poses or ground truth of a log",
    "openvins": "a trajectory with OpenVINS' or RPG's covariance columns becomes part of a log",
    "to-mcap": "a log or trajectories become an MCAP file",
    "to-evo": "the errors of a trajectory become a result zip for evo_res",
    "to-kitti": "a trajectory becomes KITTI poses",
    "to-euroc": "a trajectory becomes a csv file as EuRoC's ground truth",
    "checkpoint": "an official PoET checkpoint becomes a safetensors file, safely",
    "classes": "class and symmetry files of YCB-V or LM-O",
}
