from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from io_strategies import SEEDS, random_poses, same_poses
from scipy.spatial.transform import RigidTransform

from poet_loc.core.records import Calibration, Camera, ImuNoise
from poet_loc.io.calibration_yaml import read_calibration, write_calibration

CAMERA = """cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.0652]
  - [-1.0, 0.0, 0.0, -0.0207]
  - [0.0, 0.0, 1.0, -0.008]
  - [0, 0, 0, 1]
  cam_overlaps: []
  camera_model: pinhole
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  distortion_model: radtan
  distortion_coeffs: [-0.28, 0.07, 1e-4, 2e-05]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -0.0125
"""
IMU = """imu0:
  accelerometer_noise_density: 0.002
  accelerometer_random_walk: 3e-3
  gyroscope_noise_density: 0.00016968
  gyroscope_random_walk: 1.9393e-05
  model: calibrated
  rostopic: /imu0
  update_rate: 200
"""
GOLDEN = CAMERA + IMU
OPENCV = """%YAML:1.0
---
cam0:
   T_imu_cam: !!opencv-matrix
      rows: 4
      cols: 4
      dt: d
      data: [ 0., -1., 0., 0.1,
              1., 0., 0., 0.2,
              0., 0., 1., 0.3,
              0., 0., 0., 1. ]
   intrinsics: [600, 601, 320, 240]
   distortion_model: "none"
imu0:
   accelerometer_noise_density: 2.0000e-3
   accelerometer_random_walk: 3.0e-3
   gyroscope_noise_density: 1.6968e-04
   gyroscope_random_walk: 1.9393e-05
   update_rate: 200.0
"""
NOISE = ImuNoise(0.00016968, 0.002, 1.9393e-05, 3e-3, 200)


def within_reach(pose: RigidTransform) -> RigidTransform:
    """A lever arm of ten metres would be taken for millimetres."""
    return RigidTransform.from_components(pose.translation / 3.0, pose.rotation)


def check_camera(calibration: Calibration) -> None:
    # imu x points along minus camera y, and so on: columns are the imu's axes in the camera
    np.testing.assert_allclose(calibration.T_cam_imu.apply([1, 0, 0]), [0.0652, -1.0207, -0.008])
    assert calibration.timeshift_cam_imu_s == -0.0125
    assert calibration.camera == Camera(
        (458.654, 457.296, 367.215, 248.375), "radtan", (-0.28, 0.07, 1e-4, 2e-5), (752, 480)
    )


def test_golden_file(write):
    calibration = read_calibration(write(GOLDEN))
    check_camera(calibration)
    assert calibration.imu == NOISE


def test_camera_chain_alone(write):
    calibration = read_calibration(write(CAMERA + CAMERA.replace("cam0", "cam1").replace("0.0652", "0.1652")))
    check_camera(calibration)
    assert calibration.imu is None


def test_another_camera_of_the_chain(write):
    path = write(CAMERA + CAMERA.replace("cam0", "cam1").replace("0.0652", "0.1652"))
    assert read_calibration(path, camera="cam1").T_cam_imu.translation[0] == 0.1652


@pytest.mark.parametrize("text", [IMU, IMU.replace("imu0:\n", "").replace("\n  ", "\n").strip()])
def test_imu_alone(write, text):
    calibration = read_calibration(write(text))
    assert calibration == Calibration(imu=NOISE)


def test_no_distortion_may_be_written_as_zeros(write):
    none = GOLDEN.replace("radtan", "none").replace("[-0.28, 0.07, 1e-4, 2e-05]", "[0.0, 0, 0, 0]")
    assert read_calibration(write(none)).camera.distortion_coeffs == ()


def test_opencv_yaml_with_the_other_direction(write):
    calibration = read_calibration(write(OPENCV))
    np.testing.assert_allclose(calibration.T_cam_imu.inv().translation, [0.1, 0.2, 0.3], atol=1e-15)
    np.testing.assert_allclose(calibration.T_cam_imu.inv().apply([1, 0, 0]), [0.1, 1.2, 0.3], atol=1e-15)
    assert calibration.camera == Camera((600, 601, 320, 240))
    assert calibration.imu == NOISE


def test_rounded_rotation_is_made_orthonormal(write):
    rounded = read_calibration(write(CAMERA.replace("[0.0, 1.0, 0.0,", "[0.003, 0.9999, 0.001,")))
    matrix = rounded.T_cam_imu.as_matrix()[:3, :3]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)


POSITIVE = st.floats(1e-9, 1e3)


@given(
    seed=SEEDS,
    parts=st.sets(st.sampled_from(["extrinsics", "camera", "imu"]), min_size=1),
    noise=st.tuples(POSITIVE, POSITIVE, POSITIVE, POSITIVE, POSITIVE),
    timeshift=st.floats(-1, 1),
    resolution=st.none() | st.tuples(st.integers(1, 9999), st.integers(1, 9999)),
    model=st.sampled_from([("none", 0), ("radtan", 4), ("radtan", 5), ("equidistant", 4), ("fov", 1)]),
)
@settings(max_examples=60, deadline=None)
def test_round_trip(tmp_path_factory, seed, parts, noise, timeshift, resolution, model):
    path = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    values = np.random.default_rng(seed).uniform(1, 1000, 9).tolist()
    calibration = Calibration(
        T_cam_imu=within_reach(random_poses(1, seed)[0]) if "extrinsics" in parts else None,
        timeshift_cam_imu_s=timeshift,
        camera=Camera(tuple(values[:4]), model[0], tuple(values[4 : 4 + model[1]]), resolution)
        if "camera" in parts
        else None,
        imu=ImuNoise(*noise) if "imu" in parts else None,
    )
    write_calibration(path, calibration)
    again = read_calibration(path)
    assert (again.timeshift_cam_imu_s, again.camera, again.imu) == (timeshift, calibration.camera, calibration.imu)
    assert (again.T_cam_imu is None) == (calibration.T_cam_imu is None)
    if calibration.T_cam_imu is not None:
        assert same_poses(again.T_cam_imu, calibration.T_cam_imu)


BAD = {
    "empty": ("", None, "empty"),
    "no yaml": (CAMERA.replace("[752, 480]", "[752, 480"), 13, "is no YAML"),
    "a python object": ("cam0: !!python/object/apply:os.getcwd []\n", 1, "is no YAML"),
    "no mapping": ("- 1\n- 2\n", None, "no mapping"),
    "neither": ("lidar0: {}\n", None, "neither cam0 nor imu0"),
    "camera no mapping": ("cam0: 3\n", 1, "keys and values"),
    "no rotation": (GOLDEN.replace("[-1.0, 0.0,", "[-1.0, 0.5,"), 2, "T_cam_imu holds no rotation"),
    "mirrored": (GOLDEN.replace("[-1.0, 0.0,", "[1.0, 0.0,"), 2, "T_cam_imu holds no rotation"),
    "last row": (GOLDEN.replace("[0, 0, 0, 1]", "[0, 0, 0, 2]"), 2, "0 0 0 1"),
    "3x4": (GOLDEN.replace("  - [0, 0, 0, 1]\n", ""), 2, "T_cam_imu has the shape (3, 4)"),
    "nan": (GOLDEN.replace("0.0652", ".nan"), 2, "T_cam_imu is NaN"),
    "millimetres": (GOLDEN.replace("0.0652", "65.2"), 2, "millimetres"),
    "both directions": (GOLDEN.replace("  cam_overlaps: []", "  T_imu_cam: []"), 7, "stands beside"),
    "misspelt timeshift": (GOLDEN.replace("timeshift_cam_imu", "timeshift_cam_imu0"), 14, "timeshift_cam_imu is meant"),
    "misspelt noise": (GOLDEN.replace("gyroscope_random_walk", "gyroscope_randomwalk"), None, "is meant"),
    "missing noise": (GOLDEN.replace("  update_rate: 200\n", ""), None, "update_rate is missing"),
    "zero density": (GOLDEN.replace("density: 0.002", "density: 0"), 16, "accelerometer_noise_density is 0"),
    "negative walk": (GOLDEN.replace("1.9393e-05", "-1.9393e-05"), 19, "cannot be negative"),
    "text for a number": (GOLDEN.replace("1.9393e-05", "small"), 19, "gyroscope_random_walk holds something"),
    "three intrinsics": (GOLDEN.replace("458.654, ", ""), 9, "intrinsics has the shape (3,)"),
    "no focal length": (GOLDEN.replace("458.654", "0"), 9, "positive focal lengths"),
    "camera model": (GOLDEN.replace("pinhole", "omni"), 8, "only pinhole"),
    "distortion model": (GOLDEN.replace("radtan", "fisheye"), 10, "distortion_model is 'fisheye'"),
    "distortion ragged": (GOLDEN.replace("-0.28,", "[-0.28, 1],"), 11, "distortion_coeffs has the shape (2,)"),
    "distortion a number": (GOLDEN.replace("[-0.28, 0.07, 1e-4, 2e-05]", "3"), 11, "distortion_coeffs is 3, no list"),
    "distortion count": (GOLDEN.replace("-0.28, ", ""), 11, "distortion_coeffs has 3 values"),
    "resolution": (GOLDEN.replace("[752, 480]", "[752.5, 480]"), 12, "resolution is [752.5, 480]"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(write, refusal, case):
    text, line, what = BAD[case]
    error = refusal(read_calibration, write(text))
    assert what in str(error)
    assert line is None or error.line == line


def test_shared_logs(shared_data):
    files = sorted(shared_data.glob("**/calibration.yaml"))
    assert len(files) == 13
    for file in files:
        calibration = read_calibration(file)
        assert calibration.T_cam_imu is not None
        assert calibration.camera.resolution in {(640, 480), (752, 480)}
        assert calibration.imu.update_rate == 200
