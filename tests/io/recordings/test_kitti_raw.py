"""KITTI raw: the official layout, the flat one, and the real recording."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.errors import SourceError
from coec.geometry import cameras
from coec.io.recordings.layouts import open_source

DATE, DRIVE = "2011_09_26", "2011_09_26_drive_0005_sync"

CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 50 0 31.5 0 0 51 23.5 0 0 0 1 0
P_rect_02: 50 0 31.5 3.0 0 51 23.5 0.2 0 0 1 0.004
"""
VELO_TO_CAM = """calib_time: 15-Mar-2012 11:37:16
R: 0 -1 0 0 0 -1 1 0 0
T: 0.01 -0.07 -0.27
"""
IMU_TO_VELO = "R: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.8\n"


def oxts(**named: float) -> str:
    """A line of 30 numbers (dataformat.txt): vf vl vu at 8, 9, 10, wf wl wu at 20, 21, 22, counted from 0."""
    values = [99.0] * 30
    places = {"vf": 8, "vl": 9, "vu": 10, "wf": 20, "wl": 21, "wu": 22}
    for name, value in named.items():
        values[places[name]] = value
    return " ".join(map(str, values))


def a_drive(drive: Path, calibration: Path) -> Path:
    calibration.mkdir(parents=True, exist_ok=True)
    (calibration / "calib_cam_to_cam.txt").write_text(CAM_TO_CAM)
    (calibration / "calib_velo_to_cam.txt").write_text(VELO_TO_CAM)
    (drive / "image_02" / "data").mkdir(parents=True)
    (drive / "velodyne_points" / "data").mkdir(parents=True)
    for index in (0, 1, 3):
        cv2.imwrite(str(drive / "image_02" / "data" / f"{index:010d}.png"), np.zeros((48, 64, 3), np.uint8))
    for index in (0, 1, 2, 3):
        path = drive / "velodyne_points" / "data" / f"{index:010d}.bin"
        path.write_bytes(struct.pack("<4f", index, 0, 0, 0.5))
    return drive


@pytest.fixture
def official(tmp_path: Path) -> Path:
    drive = a_drive(tmp_path / "kitti" / DATE / DRIVE, tmp_path / "kitti" / DATE)
    (drive.parent / "calib_imu_to_velo.txt").write_text(IMU_TO_VELO)
    for sensor, offset in (("image_02", 0.0), ("velodyne_points", 0.002), ("oxts", 0.004)):
        (drive / sensor).mkdir(exist_ok=True)
        (drive / sensor / "timestamps.txt").write_text(
            "".join(f"2011-09-26 13:02:{25 + offset + 0.1 * i:012.9f}\n" for i in range(4))
        )
    (drive / "oxts" / "data").mkdir()
    for index in range(4):
        line = oxts(vf=10.0 + index, vl=0.1, vu=-0.2, wf=0.01, wl=0.02, wu=0.3)
        (drive / "oxts" / "data" / f"{index:010d}.txt").write_text(line + "\n")
    return tmp_path / "kitti"


def test_the_official_layout(official: Path) -> None:
    for spec in (
        f"kitti-raw:{official}",
        f"kitti-raw:{official}?drive={DRIVE}",
        f"kitti-raw:{official / DATE / DRIVE}",
    ):
        recording = open_source(spec)
        second = 1317042145 * 10**9  # 2011-09-26 13:02:25 UTC
        stamps = tuple(second + k * 100_000_000 for k in (0, 1, 3))
        assert recording.camera_stamps_ns == stamps
        messages = list(recording.messages())
        assert tuple(m.stamp_ns for m in messages if isinstance(m, LidarFrame)) == stamps
        assert [m.xyz_m[0, 0] for m in messages if isinstance(m, LidarFrame)] == [0, 1, 3]
        motions = [m for m in messages if isinstance(m, EgoMotion)]
        assert [m.linear_mps for m in motions] == [(10.0 + k, 0.1, -0.2) for k in range(4)]
        assert motions[1].angular_radps == (0.01, 0.02, 0.3)
        assert motions[1].stamp_ns == second + 104_000_000
        assert recording.rig.T_lidar_ego[:3, 3].tolist() == [-0.81, 0.32, -0.8]
        assert recording.name == f"kitti-raw/{DRIVE}/image_02"


def test_calibration_is_that_of_the_development_kit(official: Path) -> None:
    rig = open_source(f"kitti-raw:{official}").rig
    assert rig.camera == cameras.build("pinhole", width=64, height=48, fx=50, fy=51, cx=31.5, cy=23.5)
    point = np.array([10.0, 2.0, -1.0, 1.0])
    p_cam0 = np.array([-2.0 + 0.01, 1.0 - 0.07, 10.0 - 0.27, 1.0])
    P = np.array([[50, 0, 31.5, 3.0], [0, 51, 23.5, 0.2], [0, 0, 1, 0.004]])
    u, v, w = P @ p_cam0
    x, y, z = (rig.T_camera_lidar_nominal @ point)[:3]
    np.testing.assert_allclose([50 * x / z + 31.5, 51 * y / z + 23.5, z], [u / w, v / w, w], atol=1e-9)


def test_the_flat_layout_without_stamps_ego_motion_or_imu(tmp_path: Path) -> None:
    drive = a_drive(tmp_path / "flat", tmp_path / "flat")
    recording = open_source(f"kitti-raw:{drive}")
    assert recording.camera_stamps_ns == (0, 100_000_000, 300_000_000)
    assert recording.rig.sweep is not None
    assert (recording.rig.sweep.period_s, recording.rig.sweep.sign) == (0.1, -1)
    assert np.array_equal(recording.rig.T_lidar_ego, np.eye(4))
    assert not [m for m in recording.messages() if isinstance(m, EgoMotion)]


def test_what_is_missing_or_malformed_is_named(official: Path) -> None:
    spec = f"kitti-raw:{official}"
    with pytest.raises(SourceError, match="there is no folder"):
        open_source("kitti-raw:/no/such/folder")
    with pytest.raises(SourceError, match="has no drive"):
        open_source(f"kitti-raw:{official / DATE / DRIVE / 'oxts'}")
    with pytest.raises(SourceError, match="no drive x"):
        open_source(f"{spec}?drive=x")
    with pytest.raises(SourceError, match=r"there is no folder .*image_03"):
        open_source(f"{spec}?camera=image_03")
    line = official / DATE / DRIVE / "oxts" / "data" / "0000000002.txt"
    line.write_text("1 2 3")
    with pytest.raises(SourceError, match=r"0000000002\.txt: expected 30"):
        open_source(spec)
    line.write_text(oxts(vf=float("nan")))
    with pytest.raises(SourceError, match="finite"):
        open_source(spec)
    (official / DATE / "calib_cam_to_cam.txt").write_text("P_rect_02: 1\n")
    with pytest.raises(SourceError, match="P_rect_02 must hold 12"):
        open_source(spec)


def test_the_sample_drive(sample_data: Path) -> None:
    recording = open_source(f"kitti-raw:{sample_data / 'kitti_raw_2011_09_26'}?camera=image_02")
    assert recording.camera_stamps_ns == tuple(k * 100_000_000 for k in range(40, 50))
    assert (recording.rig.camera.width, recording.rig.camera.height) == (1242, 375)
    messages = list(recording.messages([9]))
    assert [type(m) for m in messages] == [LidarFrame, CameraFrame]
    assert recording.rig.T_camera_lidar_nominal[:3, 3] == pytest.approx([0.057, -0.075, -0.269], abs=1e-3)
