"""KITTI-360: the layout in a generated folder with known geometry, and the real recording."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, SweepTiming
from coec.config import LimitsConfig
from coec.errors import SourceError
from coec.geometry import cameras, se3
from coec.geometry.cameras import in_image
from coec.geometry.projection import project
from coec.io.images import decode_bgr, decode_depth
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import damaged_of

DRIVE = "2013_05_28_drive_0000_sync"
LIMITS = LimitsConfig()
Matrix = NDArray[np.float64]


def numbers(matrix: Matrix) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(matrix).reshape(-1))


def a_rotation(seed: int, angle: float = 0.05) -> Matrix:
    return se3.rotation_exp(np.random.default_rng(seed).normal(size=3) * angle)


class Truth:
    """Sensor poses of the generated vehicle."""

    T_pose_cam0 = se3.transform_from(
        np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]) @ a_rotation(1), np.array([1.5, 0, -0.6])
    )
    T_pose_cam1 = se3.transform_from(
        np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]) @ a_rotation(2), np.array([1.5, 0.6, -0.6])
    )
    T_pose_cam2 = se3.transform_from(
        np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ a_rotation(3), np.array([0.7, -0.1, -1])
    )
    T_pose_velo = se3.transform_from(np.diag([1.0, -1.0, -1.0]) @ a_rotation(4), np.array([0.8, 0.3, -0.9]))
    R_rect = (a_rotation(5), a_rotation(6))
    twist_pose = np.array([0.02, -0.01, 0.3, 9.0, 0.2, -0.1])
    """ω, v of the pose frame in itself, constant."""


def a_root(root: Path) -> Path:
    """Frames 3, 4, 7 have image and scan (frame 5 has no image, frame 6 no scan); poses exist for 2, 4, 6, 8 only."""
    calibration = root / "calibration"
    calibration.mkdir(parents=True)
    poses = (Truth.T_pose_cam0, Truth.T_pose_cam1, Truth.T_pose_cam2, Truth.T_pose_cam2)
    (calibration / "calib_cam_to_pose.txt").write_text(
        "".join(f"image_0{i}: {numbers(T[:3])} \n" for i, T in enumerate(poses))
    )
    T_velo_cam0 = se3.inverse(Truth.T_pose_velo) @ Truth.T_pose_cam0
    (calibration / "calib_cam_to_velo.txt").write_text(numbers(T_velo_cam0[:3]) + "\n")
    (calibration / "perspective.txt").write_text(
        "calib_time: 17-Feb-2016 14:23:48\n"
        + "".join(
            f"R_rect_0{i}: {numbers(Truth.R_rect[i])}\nP_rect_0{i}: 50 0 31.5 {-30.0 * i} 0 51 23.5 0 0 0 1 0\n"
            for i in range(2)
        )
    )
    (calibration / "image_02.yaml").write_text(
        "%YAML:1.0\nmodel_type: MEI\nimage_width: 64\nimage_height: 48\nmirror_parameters:\n   xi: 2.2e+00\n"
        "distortion_parameters:\n   k1: 1.0e-02\n   k2: 1.5\n   p1: 4.0e-04\n   p2: 5.0e-04\n"
        "projection_parameters:\n   gamma1: 1.3e+02\n   gamma2: 1.31e+02\n   u0: 31.0\n   v0: 23.0\n"
    )
    drive = root / "data_2d_raw" / DRIVE
    for camera, folder in (("image_00", "data_rect"), ("image_01", "data_rect"), ("image_02", "data_rgb")):
        (drive / camera / folder).mkdir(parents=True)
        for index in (3, 4, 6, 7):
            cv2.imwrite(str(drive / camera / folder / f"{index:010d}.png"), np.full((48, 64, 3), index, np.uint8))
    scans = root / "data_3d_raw" / DRIVE / "velodyne_points"
    (scans / "data").mkdir(parents=True)
    for index in (3, 4, 5, 7):
        (scans / "data" / f"{index:010d}.bin").write_bytes(struct.pack("<4f", index, 0, 0, 0.5))
    (drive / "image_00" / "timestamps.txt").write_text(
        "".join(f"2013-05-28 08:46:{2 + i * 0.1:012.9f}\n" for i in range(10))
    )
    (scans / "timestamps.txt").write_text("".join(f"2013-05-28 08:46:{2.0006 + i * 0.1:012.9f}\n" for i in range(10)))
    (root / "stereo_disparity_00").mkdir()
    cv2.imwrite(str(root / "stereo_disparity_00" / "0000000004.png"), np.full((48, 64), 4000, np.uint16))
    start = se3.exp(np.array([0.1, 0.2, 0.3, 800, 3700, 115]))
    drive_poses = root / "data_poses" / DRIVE
    drive_poses.mkdir(parents=True)
    (drive_poses / "poses.txt").write_text(
        "".join(f"{i} {numbers((start @ se3.exp(Truth.twist_pose * 0.1 * i))[:3])}\n" for i in (2, 4, 6, 8))
    )
    return root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return a_root(tmp_path / "kitti360")


@pytest.mark.parametrize(
    ("camera", "T_pose_camera", "rectification"),
    [
        ("image_00", Truth.T_pose_cam0, Truth.R_rect[0]),
        ("image_01", Truth.T_pose_cam1, Truth.R_rect[1]),
        ("image_02", Truth.T_pose_cam2, np.eye(3)),
    ],
)
def test_extrinsics_are_those_of_the_rectified_camera(
    root: Path, camera: str, T_pose_camera: Matrix, rectification: Matrix
) -> None:
    recording = open_source(f"kitti360:{root}?camera={camera}")
    point_velo = np.array([12.0, -3.0, 0.5, 1.0])
    expected = rectification @ (np.linalg.inv(T_pose_camera) @ Truth.T_pose_velo @ point_velo)[:3]
    got = (recording.rig.T_camera_lidar_nominal @ point_velo)[:3]
    np.testing.assert_allclose(got, expected, atol=1e-9)
    assert se3.is_rigid(recording.rig.T_camera_lidar_nominal, 1e-12)
    assert np.array_equal(recording.T_camera_lidar_start, recording.rig.T_camera_lidar_nominal)
    assert (recording.rig.camera_frame, recording.rig.lidar_frame) == (camera, "velodyne")


def test_intrinsics(root: Path) -> None:
    rectified = open_source(f"kitti360:{root}").rig.camera
    assert rectified == cameras.build("pinhole", width=64, height=48, fx=50, fy=51, cx=31.5, cy=23.5)
    fisheye = open_source(f"kitti360:{root}?camera=image_02").rig.camera
    assert fisheye == cameras.build(
        "mei", width=64, height=48, fx=130, fy=131, cx=31, cy=23, xi=2.2, k1=0.01, k2=1.5, p1=4e-4, p2=5e-4
    )


def test_frames_are_those_with_image_and_scan_and_carry_the_stamp_of_the_camera(root: Path) -> None:
    recording = open_source(f"kitti360:{root}")
    second = 1369730762 * 10**9  # 2013-05-28 08:46:02 UTC
    stamps = tuple(second + k * 100_000_000 for k in (3, 4, 7))
    assert recording.camera_stamps_ns == stamps
    messages = list(recording.messages())
    scans = [m for m in messages if isinstance(m, LidarFrame)]
    images = [m for m in messages if isinstance(m, CameraFrame)]
    assert tuple(m.stamp_ns for m in scans) == stamps
    assert [m.xyz_m[0, 0] for m in scans] == [3, 4, 7]
    assert [decode_bgr(m.image, LIMITS)[0, 0, 0] for m in images] == [3, 4, 7]
    assert recording.rig.sweep == SweepTiming(pytest.approx(0.1), -1, 0.0)  # type: ignore[arg-type]
    assert recording.configuration is None


def test_depth_maps_where_there_are(root: Path) -> None:
    images = [m for m in open_source(f"kitti360:{root}").messages() if isinstance(m, CameraFrame)]
    assert [m.depth is not None for m in images] == [False, True, False]
    assert images[1].depth is not None
    assert decode_depth(images[1].depth, LIMITS)[0, 0] == 4000
    other = [m for m in open_source(f"kitti360:{root}?camera=image_01").messages() if isinstance(m, CameraFrame)]
    assert all(m.depth is None for m in other)
    with pytest.raises(SourceError, match="there is no folder"):
        open_source(f"kitti360:{root}?depth=absent")


def test_ego_motion_is_the_twist_of_the_lidar_in_its_own_frame(root: Path) -> None:
    """By finite differences of the LiDAR's pose in the world, which the source does not compute."""
    recording = open_source(f"kitti360:{root}")
    motions = [m for m in recording.messages() if isinstance(m, EgoMotion)]
    assert [m.stamp_ns for m in motions] == list(recording.camera_stamps_ns)

    def T_world_velo(t: float) -> Matrix:
        T: Matrix = se3.exp(Truth.twist_pose * t) @ Truth.T_pose_velo
        return T

    h = 1e-5
    step = np.linalg.inv(T_world_velo(0.4)) @ (T_world_velo(0.4 + h) - T_world_velo(0.4 - h)) / (2 * h)
    angular, linear = np.array([step[2, 1], step[0, 2], step[1, 0]]), step[:3, 3]
    for motion in motions:  # frame 4 has a pose, frames 3 and 7 lie between two
        assert motion.linear_mps == pytest.approx(linear.tolist(), abs=1e-6)
        np.testing.assert_allclose(motion.angular_radps, angular, atol=1e-6)
        assert motion.frame_id == "velodyne"
    assert np.array_equal(recording.rig.T_lidar_ego, np.eye(4))


def test_no_ego_motion_across_an_outage_but_across_a_halt(root: Path) -> None:
    poses = root / "data_poses" / DRIVE / "poses.txt"
    stamps = root / "data_2d_raw" / DRIVE / "image_00" / "timestamps.txt"
    stamps.write_text("".join(f"2013-05-28 08:46:{2 + i:012.9f}\n" for i in range(10)))  # one second per frame now
    recording = open_source(f"kitti360:{root}")
    assert not [m for m in recording.messages() if isinstance(m, EgoMotion)]
    still = numbers(np.eye(4)[:3])
    poses.write_text(f"2 {still}\n8 {still}\n")
    motions = [m for m in open_source(f"kitti360:{root}").messages() if isinstance(m, EgoMotion)]
    assert [m.speed_mps for m in motions] == [0.0, 0.0, 0.0]
    poses.unlink()
    assert not [m for m in open_source(f"kitti360:{root}").messages() if isinstance(m, EgoMotion)]


def test_what_is_missing_or_malformed_is_named(root: Path) -> None:
    spec = f"kitti360:{root}"
    with pytest.raises(SourceError, match="no folder data_2d_raw"):
        open_source(f"kitti360:{root / 'calibration'}")
    with pytest.raises(SourceError, match="no drive 0001; there: 2013"):
        open_source(f"{spec}?drive=0001")
    with pytest.raises(SourceError, match="no camera image_07"):
        open_source(f"{spec}?camera=image_07")
    (root / "data_2d_raw" / "another").mkdir()
    with pytest.raises(SourceError, match=r"2 drives, choose one with \?drive="):
        open_source(spec)
    (root / "data_2d_raw" / "another").rmdir()

    for path, text, complaint in [
        ("calibration/calib_cam_to_velo.txt", "1 2 3", "expected 12 numbers, found 3"),
        ("calibration/calib_cam_to_velo.txt", "1 2 x", "expected 12 numbers"),
        ("calibration/perspective.txt", "R_rect_00: 1 2 3", "R_rect_00 must hold 9"),
        ("calibration/perspective.txt", "", "no entry R_rect_00"),
        ("calibration/calib_cam_to_pose.txt", "image_00: " + "nan " * 12, "image_00 must hold 12 finite"),
        (f"data_poses/{DRIVE}/poses.txt", "2 1 2 3", "poses.txt, line 1: expected"),
        (f"data_poses/{DRIVE}/poses.txt", "x", "poses.txt, line 1"),
        (f"data_poses/{DRIVE}/poses.txt", f"11 {'0 ' * 12}", "line 1: frame 11"),
        (f"data_2d_raw/{DRIVE}/image_00/timestamps.txt", "2013-05-28 08:46:02.9\nnoon\n", "line 2: not a time"),
        (f"data_2d_raw/{DRIVE}/image_00/timestamps.txt", "2013-05-28 08:46:02.9\n", "ends before frame 3"),
        (f"data_2d_raw/{DRIVE}/image_00/timestamps.txt", "2013-13-28 08:46:02.9\n", "line 1: not a time"),
    ]:
        original = (root / path).read_text()
        (root / path).write_text(text)
        with pytest.raises(SourceError, match=complaint):
            open_source(spec)
        (root / path).write_text(original)

    scan = root / "data_3d_raw" / DRIVE / "velodyne_points" / "data" / "0000000003.bin"
    scan.write_bytes(scan.read_bytes()[:-1])
    recording = open_source(spec)
    list(recording.messages())
    assert "1 damaged (1 cloud_unreadable)" in damaged_of(recording).text
    assert "0000000003.bin is truncated" in damaged_of(recording).text


# --- the real recording ---------------------------------------------------------------------------------------


def test_the_sample_drive(sample_data: Path) -> None:
    recording = open_source(f"kitti360:{sample_data / 'kitti360'}?camera=image_00")
    assert len(recording.camera_stamps_ns) == 10
    assert recording.rig.sweep is not None
    assert recording.rig.sweep.period_s == pytest.approx(0.1045, abs=2e-4)
    messages = list(recording.messages([0, 4]))
    images = [m for m in messages if isinstance(m, CameraFrame)]
    motions = [m for m in messages if isinstance(m, EgoMotion)]
    assert [(m.image.width, m.image.height) for m in images] == [(1408, 376)] * 2
    assert all(m.depth is not None for m in images)
    # The poses say that the vehicle reversed at frame 100 and drove at frame 644.
    velocities = [m.linear_mps for m in motions if m.linear_mps is not None]
    assert [round(x, 1) for x, _, _ in velocities] == [-0.2, 4.4]
    assert all(abs(y) < 0.5 for _, y, _ in velocities)


def test_disparity_of_the_sample_agrees_with_projected_ranges(sample_data: Path) -> None:
    """The projection is right when stereo, which never saw the LiDAR, has the disparity that the depth asks for, and
    equally so for both cameras, whose extrinsics share no line of the calibration files but one."""
    median_px = {}
    for camera in ("image_00", "image_01"):
        recording = open_source(f"kitti360:{sample_data / 'kitti360'}?camera={camera}&depth=stereo_disparity_00")
        messages = list(recording.messages([3]))
        image = next(m for m in messages if isinstance(m, CameraFrame))
        scan = next(m for m in messages if isinstance(m, LidarFrame))
        assert image.depth is not None
        disparity = decode_depth(image.depth, LIMITS) / 256
        T = recording.rig.T_camera_lidar_nominal
        p_camera = scan.xyz_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        uv, valid = project(recording.rig.camera, p_camera)
        valid &= in_image(recording.rig.camera, uv)
        u, v = np.rint(uv[valid]).astype(int).T
        # The maps are of image_00: seen from image_01 a point lies further left by its own disparity.
        expected_px = 552.554261 * 0.594181 / p_camera[valid, 2]
        if camera == "image_01":
            u = np.clip(np.rint(uv[valid, 0] + expected_px).astype(int), 0, 1407)
        median_px[camera] = np.nanmedian(np.abs(disparity[v, u] - expected_px))
    assert median_px["image_00"] < 1.2  # 0.5 px of it is a constant offset of the matcher
    assert abs(median_px["image_00"] - median_px["image_01"]) < 0.1


def test_the_fisheye_extrinsic_is_that_of_the_sample_manifest(sample_data: Path, tmp_path: Path) -> None:
    manifest = YAML(typ="safe").load((sample_data / "kitti360_fisheye" / "dataset.yaml").read_text())
    folders = {
        tmp_path / "calibration": sample_data / "kitti360" / "calibration",
        tmp_path / "data_3d_raw": sample_data / "kitti360" / "data_3d_raw",
    }
    for link, target in folders.items():
        link.symlink_to(target)
    images = tmp_path / "data_2d_raw" / DRIVE / "image_02" / "data_rgb"
    images.mkdir(parents=True)
    (images / "0000000100.png").symlink_to(sample_data / "kitti360_fisheye" / "image_02.png")
    rig = open_source(f"kitti360:{tmp_path}?camera=image_02").rig
    np.testing.assert_allclose(rig.T_camera_lidar_nominal, manifest["T_camera_lidar"], atol=2e-9)
    assert rig.camera == cameras.build(**manifest["camera"])
