"""EuRoC, Kalibr, KITTI, OpenVINS, slam-super-6d, PoET's annotations: golden files and round trips; the real evo."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poet_loc.cli.main import main
from poet_loc.core.geometry import make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.calibration_yaml import read_calibration
from poet_loc.io.convert_annotation import ConvertAnnotationOptions, convert_annotation
from poet_loc.io.convert_euroc import convert_euroc, read_euroc_trajectory, write_euroc_trajectory
from poet_loc.io.convert_kalibr import ConvertKalibrOptions, convert_kalibr
from poet_loc.io.convert_super6d import ConvertSuper6dOptions, convert_super6d
from poet_loc.io.convert_trajectory import ConvertTrajectoryOptions, convert_openvins
from poet_loc.io.evo_result import write_evo_result
from poet_loc.io.kitti import read_kitti, write_kitti
from poet_loc.io.tum import read_tum, write_tum

rng = np.random.default_rng(3)
STAMPS = 1_403_715_273_262_142_976 + np.arange(20) * 50_000_003
TRAJECTORY = Trajectory(STAMPS, make_pose(Rotation.random(20, rng=rng), rng.normal(size=(20, 3))))

SENSOR_IMU = """%YAML:1.0
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""
SENSOR_CAM = """sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, 0.1,
         1,  0, 0, 0.2,
         0,  0, 1, 0.3,
         0,  0, 0, 1]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


@pytest.fixture
def mav(tmp_path) -> Path:
    root = tmp_path / "V1" / "mav0"
    for name, text in (("imu0", SENSOR_IMU), ("cam0", SENSOR_CAM)):
        (root / name / "data").mkdir(parents=True)
        (root / name / "sensor.yaml").write_text(text)
    units = ["w_RS_S_x [rad s^-1]", "w_RS_S_y [rad s^-1]", "w_RS_S_z [rad s^-1]"]
    units += ["a_RS_S_x [m s^-2]", "a_RS_S_y [m s^-2]", "a_RS_S_z [m s^-2]"]
    rows = [f"{stamp},0.1,0.2,0.3,9.0,0.5,-1.0" for stamp in STAMPS]
    (root / "imu0" / "data.csv").write_text("\n".join(["#timestamp [ns]," + ",".join(units), *rows]) + "\n")
    images = [f"{stamp},{stamp}.png" for stamp in STAMPS]
    (root / "cam0" / "data.csv").write_text("\n".join(["#timestamp [ns],filename", *images]) + "\n")
    truth = root / "state_groundtruth_estimate0"
    truth.mkdir()
    names = ["p_RS_R_x [m]", "p_RS_R_y [m]", "p_RS_R_z [m]", "q_RS_w []", "q_RS_x []", "q_RS_y []", "q_RS_z []"]
    rows = [f"{stamp},1.0,2.0,3.0,0.8,0.6,0.0,0.0,5" for stamp in STAMPS]
    header = "#timestamp, " + ", ".join(names) + ", v_RS_R_x [m s^-1]"
    (truth / "data.csv").write_text("\n".join([header, *rows]) + "\n")
    return root.parent


def test_a_euroc_folder_becomes_a_log(mav, tmp_path) -> None:
    log = convert_euroc(mav, tmp_path / "log")
    np.testing.assert_array_equal(log.imu.stamps_ns, STAMPS)
    assert log.calibration.imu.gyroscope_noise_density == 1.6968e-4
    assert log.calibration.camera.resolution == (752, 480)
    assert log.calibration.camera.distortion_model == "radtan"
    # T_BS of the camera maps cam into body: Kalibr's T_cam_imu is its inverse
    np.testing.assert_allclose(log.calibration.T_cam_imu.apply([0.1, 0.2, 0.3]), np.zeros(3), atol=1e-12)
    q_xyzw = log.T_world_imu.T_world_body.rotation[0].as_quat(canonical=True)
    np.testing.assert_allclose(q_xyzw, [0.6, 0.0, 0.0, 0.8])  # the file has w first
    R_world_imu = Rotation.from_quat([0.6, 0.0, 0.0, 0.8])
    p_world_cam = R_world_imu.apply([0.1, 0.2, 0.3]) + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(log.T_world_cam.T_world_body.translation[0], p_world_cam)
    assert (tmp_path / "log" / log.frames.images[0]).parent.resolve() == (mav / "mav0" / "cam0" / "data").resolve()


def test_euroc_and_kitti_files_go_round(tmp_path) -> None:
    write_euroc_trajectory(tmp_path / "euroc.csv", TRAJECTORY)
    write_kitti(tmp_path / "kitti.txt", TRAJECTORY)
    for back in (
        read_euroc_trajectory(tmp_path / "euroc.csv"),
        read_kitti(tmp_path / "kitti.txt", tmp_path / "kitti_times.txt"),
    ):
        np.testing.assert_array_equal(back.stamps_ns, STAMPS)
        np.testing.assert_allclose(back.T_world_body.as_matrix(), TRAJECTORY.T_world_body.as_matrix(), atol=1e-12)


def test_evo_reads_what_we_write(tmp_path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    write_euroc_trajectory(tmp_path / "euroc.csv", TRAJECTORY)
    write_kitti(tmp_path / "kitti.txt", TRAJECTORY)
    euroc = file_interface.read_euroc_csv_trajectory(tmp_path / "euroc.csv")
    kitti = file_interface.read_kitti_poses_file(tmp_path / "kitti.txt")
    for theirs in (euroc, kitti):
        np.testing.assert_allclose(np.array(theirs.poses_se3), TRAJECTORY.T_world_body.as_matrix(), atol=1e-9)


def test_kitti_says_what_is_wrong(tmp_path) -> None:
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(InputError, match="2 stamps for 1 poses"):
        read_kitti(tmp_path / "poses.txt", tmp_path / "times.txt")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 2 0\n" * 2)
    with pytest.raises(InputError, match=r"poses\.txt:1: is no rotation"):
        read_kitti(tmp_path / "poses.txt", tmp_path / "times.txt")


def test_evo_res_merges_our_zip_with_evos_own(tmp_path) -> None:
    pytest.importorskip("evo")
    noisy = make_pose(
        TRAJECTORY.T_world_body.rotation, TRAJECTORY.T_world_body.translation + 0.1 * rng.normal(size=(20, 3))
    )
    write_tum(tmp_path / "ref.tum", TRAJECTORY)
    write_tum(tmp_path / "est.tum", Trajectory(STAMPS, noisy))
    bin_folder = Path(sys.executable).parent
    environment = os.environ | {"HOME": str(tmp_path), "MPLBACKEND": "Agg"}

    def evo(*arguments: str) -> str:
        command = [str(bin_folder / arguments[0]), *arguments[1:]]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr + done.stdout
        return done.stdout

    error = write_evo_result(tmp_path / "ours.zip", Trajectory(STAMPS, noisy), TRAJECTORY, "ours")
    assert (
        main(["convert", "to-evo", str(tmp_path / "est.tum"), str(tmp_path / "ref.tum"), str(tmp_path / "2.zip")]) == 0
    )
    evo("evo_ape", "tum", "ref.tum", "est.tum", "--save_results", "theirs.zip")
    evo("evo_res", "ours.zip", "theirs.zip", "--save_table", "table.csv")
    header, *rows = (tmp_path / "table.csv").read_text().splitlines()
    table = {row.split(",")[0]: dict(zip(header.split(",")[1:], row.split(",")[1:], strict=True)) for row in rows}
    assert set(table) == {"ours", "est.tum"} or len(table) == 2
    ours, theirs = table.values()
    for name, value in ours.items():
        assert float(value) == pytest.approx(float(theirs[name]), rel=1e-6)
    assert float(ours["rmse"]) == pytest.approx(np.sqrt(np.mean(error**2)))


KALIBR = """cam0:
  {name}:
  - [0.0, -1.0, 0.0, 0.01]
  - [1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]
  distortion_model: radtan
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -0.0123
"""
IMU_YAML = """rostopic: /imu0
update_rate: 200.0
accelerometer_noise_density: 0.01
accelerometer_random_walk: 0.0002
gyroscope_noise_density: 0.005
gyroscope_random_walk: 4.0e-06
"""


def test_kalibrs_files_become_a_calibration_in_either_direction(tmp_path, capsys) -> None:
    (tmp_path / "cam.yaml").write_text(KALIBR.format(name="T_cam_imu"))
    (tmp_path / "rev.yaml").write_text(KALIBR.format(name="T_imu_cam"))
    (tmp_path / "imu.yaml").write_text(IMU_YAML)
    arguments = [
        "convert",
        "kalibr",
        str(tmp_path / "cam.yaml"),
        str(tmp_path / "log"),
        "--imu",
        str(tmp_path / "imu.yaml"),
    ]
    assert main(arguments) == 0
    assert "T_imu_cam" in capsys.readouterr().out
    read = read_calibration(tmp_path / "log" / "calibration.yaml")
    np.testing.assert_allclose(read.T_cam_imu.translation, [0.01, 0.02, 0.03])
    assert read.timeshift_cam_imu_s == -0.0123
    assert read.imu.gyroscope_noise_density == 0.005
    assert main(arguments) == 1
    named = convert_kalibr(tmp_path / "rev.yaml", tmp_path / "a.yaml")
    told = convert_kalibr(tmp_path / "cam.yaml", tmp_path / "b.yaml", ConvertKalibrOptions(holds="T_imu_cam"))
    kept = convert_kalibr(tmp_path / "rev.yaml", tmp_path / "c.yaml", ConvertKalibrOptions(holds="T_cam_imu"))
    for inverted in (named, told):
        np.testing.assert_allclose(inverted.T_cam_imu.as_matrix(), read.T_cam_imu.inv().as_matrix(), atol=1e-12)
    np.testing.assert_allclose(kept.T_cam_imu.as_matrix(), read.T_cam_imu.as_matrix(), atol=1e-12)


def test_a_comment_or_another_camera_does_not_say_what_the_transform_is(tmp_path) -> None:
    chain = KALIBR.format(name="T_cam_imu")
    noted = chain.replace("  T_cam_imu:", "  # T_imu_cam, the driver's people say\n  T_cam_imu:")
    (tmp_path / "plain.yaml").write_text(chain)
    (tmp_path / "noted.yaml").write_text(noted + KALIBR.format(name="T_imu_cam").replace("cam0", "cam1"))
    holds = ConvertKalibrOptions(holds="T_imu_cam")
    plain = convert_kalibr(tmp_path / "plain.yaml", tmp_path / "a.yaml", holds)
    told = convert_kalibr(tmp_path / "noted.yaml", tmp_path / "b.yaml", holds)
    np.testing.assert_array_equal(told.T_cam_imu.as_matrix(), plain.T_cam_imu.as_matrix())


def test_an_imu_yaml_without_an_imu_is_refused(tmp_path) -> None:
    (tmp_path / "cam.yaml").write_text(KALIBR.format(name="T_cam_imu"))
    options = ConvertKalibrOptions(imu=tmp_path / "cam.yaml")
    with pytest.raises(InputError, match="no noise densities"):
        convert_kalibr(tmp_path / "cam.yaml", tmp_path / "log", options)


def test_openvins_covariances_are_read(tmp_path) -> None:
    row = "1403715273.262142976 1 2 3 0 0 0 1 .01 .001 .002 .02 .003 .03 .1 .01 .02 .2 .03 .3"
    (tmp_path / "ov.txt").write_text(f"# timestamp tx ..\n{row}\n{row.replace('273.2', '274.2')}\n")
    log = convert_openvins(tmp_path / "ov.txt", tmp_path / "log")
    assert log.camera_poses.stamps_ns[0] == 1_403_715_273_262_142_976
    expected = np.zeros((6, 6))
    expected[:3, :3] = [[0.01, 0.001, 0.002], [0.001, 0.02, 0.003], [0.002, 0.003, 0.03]]
    expected[3:, 3:] = [[0.1, 0.01, 0.02], [0.01, 0.2, 0.03], [0.02, 0.03, 0.3]]
    np.testing.assert_allclose(log.camera_poses.covariances[0], expected)
    truth = convert_openvins(tmp_path / "ov.txt", tmp_path / "truth", ConvertTrajectoryOptions(role="T_world_imu"))
    assert len(truth.T_world_imu) == 2


def test_a_zero_row_of_super6d_is_no_detection(tmp_path) -> None:
    (tmp_path / "a.txt").write_text("0.0 1 2 3 0 0 0 1\n0.033333333 0 0 0 0 0 0 0\n0.066666667 4 5 6 1 0 0 0\n")
    (tmp_path / "b.txt").write_text("0.033333333 100 200 300 0 0.6 0 0.8\n")
    options = ConvertSuper6dOptions(objects={"a.txt": 2, "b.txt": 9}, name="dope")
    log = convert_super6d(tmp_path, tmp_path / "log", options)
    poses = log.object_poses["dope"]
    assert poses.object_ids.tolist() == [2, 9, 2]
    assert poses.stamps_ns.tolist() == [0, 33_333_333, 66_666_667]
    np.testing.assert_array_equal(poses.T_cam_obj.translation[2], [4, 5, 6])
    (tmp_path / "a.txt").write_text("0.0 1 2 3 0 0 0 2\n")
    with pytest.raises(InputError, match=r"a.txt:1: the quaternion has a norm"):
        convert_super6d(tmp_path, tmp_path / "log", ConvertSuper6dOptions(objects={"a.txt": 2}, overwrite=True))


def test_poets_annotations_become_object_poses(tmp_path) -> None:
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    content = {
        "images": [{"id": 7, "file_name": "000048/rgb/000001.png"}, {"id": 9, "file_name": "000048/rgb/000002.png"}],
        "annotations": [
            {
                "id": 0,
                "image_id": 9,
                "category_id": 5,
                "relative_pose": {"position": [0, 0, 1], "rotation": turn.tolist()},
            },
            {
                "id": 1,
                "image_id": 7,
                "category_id": 5,
                "relative_pose": {"position": [0, 0, 2], "rotation": turn.ravel().tolist()},
            },
            {
                "id": 2,
                "image_id": 7,
                "category_id": 5,
                "relative_pose": {"position": [1, 0, 2], "rotation": turn.tolist()},
            },
        ],
    }
    (tmp_path / "a.json").write_text(json.dumps(content))
    log = convert_annotation(tmp_path / "a.json", tmp_path / "log")
    poses = log.object_poses["gt"]
    assert poses.stamps_ns.tolist() == [0, 0, 33_333_333]
    assert poses.instances.tolist() == [0, 1, 0]
    np.testing.assert_allclose(poses.T_cam_obj.rotation.as_matrix(), [turn] * 3)
    content["annotations"][0]["relative_pose"]["rotation"] = [1, 2, 3]
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="rotation is none"):
        convert_annotation(tmp_path / "a.json", tmp_path / "other")


@pytest.mark.parametrize("rotation", [["x", 0, 0, 0, 1, 0, 0, 0, 1], [[1, 0], [0, 1], 3]])
def test_an_annotation_that_holds_no_numbers_is_one_line(rotation, tmp_path) -> None:
    pose = {"position": [0, 0, 1], "rotation": rotation}
    content = {
        "images": [{"id": 0, "file_name": "a.png"}],
        "annotations": [{"image_id": 0, "category_id": 1, "relative_pose": pose}],
    }
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"a\.json"):
        convert_annotation(tmp_path / "a.json", tmp_path / "log")


@pytest.mark.parametrize("rate", [0.0, -30.0, float("nan")])
def test_a_frame_rate_that_is_none_is_refused(rate) -> None:
    with pytest.raises(InputError, match="frame-rate"):
        ConvertAnnotationOptions(frame_rate=rate)


@pytest.mark.parametrize(
    ("sensor", "right", "wrong"),
    [
        ("imu0", "rate_hz: 200", "rate_hz: fast"),
        ("imu0", "2.0000e-3", "much"),
        ("cam0", "458.654, ", ""),
        ("cam0", "0.07395907", "a"),
        ("cam0", "0.07395907, 0.00019359", "[1]"),
        ("cam0", "0, -1, 0, 0.1", "0, -1, 0, x"),
        ("cam0", "resolution: [752, 480]", "resolution: 752"),
    ],
)
def test_a_sensor_yaml_that_is_wrong_is_told_by_name(sensor, right, wrong, mav, tmp_path) -> None:
    file = mav / "mav0" / sensor / "sensor.yaml"
    assert right in file.read_text()
    file.write_text(file.read_text().replace(right, wrong))
    with pytest.raises(InputError) as told:
        convert_euroc(mav, tmp_path / "log")
    assert str(told.value).startswith(f"{file}: ")


def test_kittis_stamps_are_not_overwritten_either(tmp_path, capsys) -> None:
    write_tum(tmp_path / "a.tum", TRAJECTORY)
    (tmp_path / "out_times.txt").write_text("mine\n")
    assert main(["convert", "to-kitti", str(tmp_path / "a.tum"), str(tmp_path / "out.txt")]) == 1
    assert "out_times.txt: is there already" in capsys.readouterr().err
    assert (tmp_path / "out_times.txt").read_text() == "mine\n"


@pytest.mark.parametrize("command", ["to-kitti", "to-euroc"])
def test_the_commands_write_and_refuse_to_overwrite(command, tmp_path) -> None:
    write_tum(tmp_path / "a.tum", TRAJECTORY)
    arguments = ["convert", command, str(tmp_path / "a.tum"), str(tmp_path / "out.txt")]
    assert main(arguments) == 0
    assert main(arguments) == 1
    assert main([*arguments, "--overwrite"]) == 0


def test_the_bag_commands(tmp_path, capsys) -> None:
    pytest.importorskip("rosbags")
    write_tum(tmp_path / "T_world_cam.tum", TRAJECTORY)
    write_tum(tmp_path / "fused.tum", TRAJECTORY)
    bag = str(tmp_path / "out.mcap")
    assert main(["convert", "to-mcap", str(tmp_path), str(tmp_path / "fused.tum"), "--out", bag]) == 0
    capsys.readouterr()
    assert main(["convert", "rosbag", bag]) == 0
    assert "/trajectories/fused  geometry_msgs/PoseStamped  20" in capsys.readouterr().out
    assert main(["convert", "rosbag", bag, str(tmp_path / "log"), "--truth-cam", "/truth/T_world_cam"]) == 0
    back = read_tum(tmp_path / "log" / "T_world_cam.tum")
    np.testing.assert_array_equal(back.stamps_ns, STAMPS)
    np.testing.assert_allclose(back.T_world_body.as_matrix(), TRAJECTORY.T_world_body.as_matrix(), atol=1e-12)
    for command in ("euroc", "openvins", "kitti", "super6d", "annotation"):
        assert main(["convert", command, "--help"]) == 0
