"""The recording of a pair in a ROS 2 bag, and recorded windows."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame
from coec.config import CalibrationConfig, PairingConfig, SearchConfig
from coec.errors import SourceError, UsageError
from coec.geometry import cameras, se3
from coec.io.mcap.windows import WindowWriter, read_window
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import damaged_of
from support.recordings import (
    HEIGHT,
    T_BASE_LIDAR,
    T_BASE_MOUNT,
    T_MOUNT_OPTICAL,
    TREE,
    WIDTH,
    Bag,
    camera_info_message,
    cloud_message,
    compressed_image_message,
    drive_messages,
    odometry_message,
    raw_image_message,
    timed_cloud_message,
    transform_message,
)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_bag_is_read_by_sensor_time_with_its_rig_from_the_bag(tmp_path: Path, compression: CompressionType) -> None:
    path = Bag(drive_messages(), compression).write(tmp_path / "drive one.mcap")
    recording = open_source(str(path))
    assert recording.rig.pair == "drive_one"
    assert recording.rig.camera == cameras.build("pinhole", width=WIDTH, height=HEIGHT, fx=50, fy=51, cx=31.5, cy=23.5)
    assert (recording.rig.camera_frame, recording.rig.lidar_frame) == ("optical", "lidar")
    T_camera_lidar = se3.inverse(T_BASE_MOUNT @ T_MOUNT_OPTICAL) @ T_BASE_LIDAR
    np.testing.assert_allclose(recording.rig.T_camera_lidar_nominal, T_camera_lidar, atol=1e-12)
    np.testing.assert_allclose(recording.rig.T_lidar_ego, se3.inverse(T_BASE_LIDAR), atol=1e-12)
    assert recording.rig.sweep is None
    assert recording.configuration is None
    messages = list(recording.messages())
    assert [m.stamp_ns for m in messages] == sorted(m.stamp_ns for m in messages)
    assert recording.camera_stamps_ns == tuple(m.stamp_ns for m in messages if isinstance(m, CameraFrame))
    assert [m.xyz_m[0, 0] for m in messages if isinstance(m, LidarFrame)] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [m.linear_mps for m in messages if isinstance(m, EgoMotion)] == [(k, 0.0, 0.0) for k in range(20)]
    assert {m.frame_id for m in messages if isinstance(m, EgoMotion)} == {"base"}


def test_a_cloud_in_the_vehicles_frame_is_taken_back_to_the_lidars(tmp_path: Path) -> None:
    drive = drive_messages(tree=[transform_message("lidar", "roof", T_BASE_LIDAR), *TREE])
    recording = open_source(f"{Bag(drive).write(tmp_path / 'b.mcap')}?lidar_frame=roof")
    assert recording.rig.lidar_frame == "roof"
    T_camera_roof = se3.inverse(T_BASE_MOUNT @ T_MOUNT_OPTICAL) @ T_BASE_LIDAR @ T_BASE_LIDAR
    np.testing.assert_allclose(recording.rig.T_camera_lidar_nominal, T_camera_roof, atol=1e-12)
    sweep = next(m for m in recording.messages() if isinstance(m, LidarFrame))
    measured_m = se3.inverse(T_BASE_LIDAR) @ [1.0, 1.0, 1.0, 1.0]
    np.testing.assert_allclose(sweep.xyz_m[0], measured_m[:3], atol=1e-6)
    with pytest.raises(SourceError, match="/tf_static does not connect 'lidar' and 'cellar'"):
        open_source(f"{tmp_path / 'b.mcap'}?lidar_frame=cellar")


def numbered_cloud(stamp_ns: int) -> Any:
    """Three points of LiDAR 0 at 1 m, one of LiDAR 1 at 4 m."""
    message = cloud_message(stamp_ns)
    points = np.zeros(4, [("xyz", "<f4", 3), ("lidar_id", "u1")])
    points["xyz"], points["lidar_id"] = np.array([[1], [1], [1], [4]]), [0, 0, 0, 1]
    number = ros.sensor_msgs__msg__PointField("lidar_id", 12, 2, 1)
    data = np.frombuffer(points.tobytes(), np.uint8)
    return replace(message, fields=[*message.fields, number], point_step=13, row_step=52, data=data)


def test_one_lidar_of_a_cloud_of_several_is_selected(tmp_path: Path) -> None:
    drive = [
        (topic, numbered_cloud(5 + number) if topic == "/points" else message)
        for number, (topic, message) in enumerate(drive_messages())
    ]
    path = Bag(drive).write(tmp_path / "b.mcap")
    with pytest.raises(SourceError, match=r"concatenated: its lidar_id has 0, 1; choose one"):
        open_source(str(path))
    sweeps = [m for m in open_source(f"{path}?lidar_source=1").messages() if isinstance(m, LidarFrame)]
    assert {tuple(sweep.xyz_m[:, 0]) for sweep in sweeps} == {(4.0,)}
    with pytest.raises(UsageError, match="lidar_source=top"):
        open_source(f"{path}?lidar_source=top")


def test_a_bag_without_chunks(tmp_path: Path) -> None:
    path = Bag(drive_messages(), chunking=False).write(tmp_path / "bag.mcap")
    assert len(list(open_source(str(path)).messages())) == 4 + 8 + 20


def test_selected_frames_form_the_pairs_that_they_form_in_the_whole(tmp_path: Path) -> None:
    recording = open_source(str(Bag(drive_messages()).write(tmp_path / "bag.mcap")))

    def pairs(cameras: list[int] | None) -> list[tuple[int, int, EgoMotion | None]]:
        pairer = Pairer(PairingConfig(), expects_motion=True)
        made = [pair for message in recording.messages(cameras) for pair in pairer.push(message)]
        return [(p.camera.stamp_ns, p.lidar.stamp_ns, p.motion) for p in (*made, *pairer.flush())]

    whole = pairs(None)
    assert len(whole) == 4
    assert pairs([1, 3]) == [whole[1], whole[3]]
    selected = list(recording.messages([2]))
    assert sum(isinstance(m, LidarFrame) for m in selected) == 1


def test_clouds_without_a_stamp_are_read_by_the_times_of_their_points(tmp_path: Path) -> None:
    drive = drive_messages()
    for _, message in drive[2:]:
        message.header.stamp.sec += 1_700_000_000
    stamped = open_source(str(Bag(drive).write(tmp_path / "stamped.mcap")))

    def unstamped(message: Any) -> Any:
        begin_s = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        return timed_cloud_message(0, "timestamp", [begin_s, begin_s + 0.05])

    messages = [(topic, unstamped(message) if topic == "/points" else message) for topic, message in drive]
    recording = open_source(str(Bag(messages).write(tmp_path / "bag.mcap")))
    read, expected = list(recording.messages()), list(stamped.messages())
    assert [type(message) for message in read] == [type(message) for message in expected]
    late_ns = [one.stamp_ns - other.stamp_ns for one, other in zip(read, expected, strict=True)]
    assert np.abs(late_ns).max() < 1000  # neighbouring doubles are 0.2 us apart


def test_clouds_without_a_point_are_left_out_and_counted(tmp_path: Path) -> None:
    drive = drive_messages()
    places = [place for place, (topic, _) in enumerate(drive) if topic == "/points"]
    for place in places[:2]:
        empty = ros.sensor_msgs__msg__PointCloud2(
            drive[place][1].header, 1, 0, [], False, 16, 0, np.zeros(0, np.uint8), True
        )
        drive[place] = ("/points", empty)
    recording: Any = open_source(str(Bag(drive).write(tmp_path / "b.mcap")))
    assert len(recording.sweep_stamps_ns) == len(places) - 2
    (note,) = (one for one in recording.recognitions if one.code == "clouds_empty")
    assert note.text == "2 of the clouds on /points have no point, and are left out."
    alone = [(topic, empty if topic == "/points" else message) for topic, message in drive]
    with pytest.raises(SourceError, match="/points has clouds without a point"):
        open_source(str(Bag(alone).write(tmp_path / "empty.mcap")))


@pytest.mark.parametrize("cameras", [1, 2, 3])
def test_several_cameras_on_one_topic_are_recognised_by_their_images(tmp_path: Path, cameras: int) -> None:
    rng = np.random.default_rng(cameras)
    scenes = [cv2.resize(rng.integers(0, 255, (6, 16), np.uint8), (8 * WIDTH, HEIGHT)) for _ in range(cameras)]
    topic = next(topic for topic, one in drive_messages() if one.__msgtype__.endswith("CompressedImage"))
    drive: list[tuple[str, Any]] = [one for one in drive_messages() if one[0] != topic]
    for k in range(12):
        image = scenes[k % cameras][:, 2 * k : 2 * k + WIDTH]
        message = compressed_image_message(10**9 + k * 100_000_000)
        message.data = np.frombuffer(cv2.imencode(".png", image)[1].tobytes(), np.uint8)
        drive.append((topic, message))
    recording: Any = open_source(str(Bag(drive).write(tmp_path / "b.mcap")))
    texts = [one.text for one in recording.recognitions if one.code == "several_cameras"]
    assert [f"probably {cameras} cameras publish" in text for text in texts] == [True] * (cameras > 1)


def test_several_topics_of_a_type_have_to_be_selected_from(tmp_path: Path) -> None:
    path = Bag(
        [*drive_messages(), ("/rear/image", compressed_image_message(5)), ("/imu/odom", odometry_message(5, 1.0))]
    ).write(tmp_path / "b.mcap")
    with pytest.raises(
        SourceError, match=r"several topics for camera, choose one with \?camera=.*/front/image \(.*/rear"
    ):
        open_source(str(path))
    recording = open_source(f"{path}?camera=/rear/image&odometry=/imu/odom")
    assert recording.camera_stamps_ns == (5,)
    with pytest.raises(SourceError, match="no topic /left for camera"):
        open_source(f"{path}?camera=/left")
    with pytest.raises(UsageError, match="unknown query key topic"):
        open_source(f"{path}?topic=/left")


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        (
            camera_info_message("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.5]),
            ("radtan", {"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.5}),
        ),
        (
            camera_info_message("plumb_bob", [0.1, 0.2, 0.3, 0.4]),
            ("radtan", {"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.0}),
        ),
        (
            camera_info_message("rational_polynomial", [0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0]),
            ("radtan", {"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": 0.5}),
        ),
        (
            camera_info_message("equidistant", [0.1, 0.2, 0.3, 0.4]),
            ("kannala_brandt", {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}),
        ),
        (
            camera_info_message("fisheye", [0.1, 0.2, 0.3, 0.4]),
            ("kannala_brandt", {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}),
        ),
        (camera_info_message("double_sphere", [-0.2, 0.6]), ("double_sphere", {"xi": -0.2, "alpha": 0.6})),
        (camera_info_message("", []), ("pinhole", {})),
    ],
)
def test_camera_info_becomes_a_camera(tmp_path: Path, info: Any, expected: tuple[str, dict[str, float]]) -> None:
    path = Bag(drive_messages(info=info)).write(tmp_path / "bag.mcap")
    model, distortion = expected
    camera = cameras.build(model, width=WIDTH, height=HEIGHT, fx=50, fy=51, cx=31.5, cy=23.5, **distortion)
    assert open_source(str(path)).rig.camera == camera


@pytest.mark.parametrize(
    ("info", "complaint"),
    [
        (camera_info_message("rational_polynomial", [0.1] * 14), "a tilted sensor"),
        (camera_info_message("oblique", [0.1] * 4), "distortion model of this name is not known"),
        (camera_info_message("equidistant", [0.1] * 3), "parameters k1 k2 k3 k4; here are 3"),
        (camera_info_message("plumb_bob", [], width=63), "images are 64 x 48 px, the intrinsics are for 63 x 48"),
        (camera_info_message("plumb_bob", [float("nan")] * 5), "not finite"),
    ],
)
def test_camera_info_that_cannot_be_used(tmp_path: Path, info: Any, complaint: str) -> None:
    path = Bag(drive_messages(info=info)).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match=complaint):
        open_source(str(path))


INTRINSICS = """
camera: {model: pinhole, width: 64, height: 48, fx: 40, fy: 40, cx: 32, cy: 24}
T_camera_lidar: [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]
mask: mask.png
"""


def test_a_file_gives_what_the_bag_lacks(tmp_path: Path) -> None:
    messages = [(topic, message) for topic, message in drive_messages(tree=[]) if topic != "/front/camera_info"]
    path = Bag(messages).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match=r"0 camera infos fit.*there: none"):
        open_source(str(path))
    (tmp_path / "rig.yaml").write_text(INTRINSICS)
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    rig = open_source(f"{path}?intrinsics={tmp_path / 'rig.yaml'}").rig
    assert rig.camera.fx == 40
    assert rig.T_camera_lidar_nominal[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert rig.mask is not None
    assert not rig.mask.any()
    assert np.array_equal(rig.T_lidar_ego, np.eye(4))
    (tmp_path / "rig.yaml").write_text("camera: {model: pinhole}")
    with pytest.raises(SourceError, match=r"camera\.fx"):
        open_source(f"{path}?intrinsics={tmp_path / 'rig.yaml'}")
    with pytest.raises(SourceError, match="cannot read"):
        open_source(f"{path}?intrinsics=/absent.yaml")


def test_frames_that_no_transform_connects(tmp_path: Path) -> None:
    path = Bag(drive_messages(tree=TREE[:1])).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match="/tf_static does not connect 'optical' and 'lidar'"):
        open_source(str(path))
    broken = transform_message("base", "lidar", T_BASE_LIDAR)
    broken.transform.rotation = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 0.0)
    path = Bag(drive_messages(tree=[broken])).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match="left out: 'base' -> 'lidar': not a rigid transform"):
        open_source(str(path))


@pytest.mark.parametrize("x_m", [np.nan, np.inf, -1e308])
def test_a_transform_to_nowhere_is_refused(tmp_path: Path, x_m: float) -> None:
    broken = transform_message("base", "lidar", T_BASE_LIDAR)
    broken.transform.translation = ros.geometry_msgs__msg__Vector3(x_m, 0.0, 0.0)
    path = Bag(drive_messages(tree=[broken, *TREE[1:]])).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match="left out: 'base' -> 'lidar': not a rigid transform"):
        open_source(str(path))


def test_the_camera_info_of_the_cameras_frame_is_taken(tmp_path: Path) -> None:
    other = ("/rear/camera_info", camera_info_message("equidistant", [0.1] * 4, frame_id="rear"))
    path = Bag([other, *drive_messages()]).write(tmp_path / "bag.mcap")
    assert cameras.name_of(open_source(str(path)).rig.camera) == "pinhole"
    named = open_source(f"{path}?intrinsics=/rear/camera_info")
    assert cameras.name_of(named.rig.camera) == "kannala_brandt"


def test_raw_images(tmp_path: Path) -> None:
    recording = open_source(str(Bag(drive_messages(image=raw_image_message)).write(tmp_path / "bag.mcap")))
    image = next(m for m in recording.messages([0]) if isinstance(m, CameraFrame))
    assert (image.image.width, image.image.height, len(image.image.data)) == (WIDTH, HEIGHT, WIDTH * HEIGHT)


def test_bags_that_lack_a_stream_or_are_damaged(tmp_path: Path) -> None:
    path = Bag([m for m in drive_messages() if m[0] != "/points"]).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match="no message of type sensor_msgs/msg/PointCloud2"):
        open_source(str(path))
    whole = Bag(drive_messages()).write(path).read_bytes()
    rng = np.random.default_rng(0)
    for size in rng.integers(0, len(whole), 20).tolist():
        path.write_bytes(whole[:size])
        with pytest.raises(SourceError, match=r"bag.mcap is damaged: byte \d+: .*`mcap recover` saves what is whole$"):
            open_source(str(path))
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 1
    path.write_bytes(flipped)
    recording = open_source(str(path))
    assert re.search(r"1 damaged \(1 record_unreadable\).*CRC of a chunk does not agree", damaged_of(recording).text)
    assert 0 < len(list(recording.messages())) < len(drive_messages())


def test_a_message_that_is_not_what_its_channel_says(tmp_path: Path) -> None:
    image = compressed_image_message(10**9)
    image.data = image.data[:-30]
    path = Bag([*drive_messages(), ("/cut/image", image)]).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match=r"CompressedImage of 1000000000 ns: .*cut off"):
        open_source(f"{path}?camera=/cut/image")


# --- recorded windows -----------------------------------------------------------------------------------------


def test_a_recorded_window_is_a_recording_of_its_pairs(tmp_path: Path) -> None:
    bag = open_source(str(Bag(drive_messages()).write(tmp_path / "bag.mcap")))
    pairer = Pairer(PairingConfig(), expects_motion=True)
    pairs = [pair for message in bag.messages() for pair in pairer.push(message)] + pairer.flush()
    configuration = CalibrationConfig(search=SearchConfig(dof=6))
    start = se3.perturb(bag.rig.T_camera_lidar_nominal, np.full(6, 0.01))
    path = tmp_path / "front-1.mcap"
    writer = WindowWriter(path, bag.rig, start, "front-1", configuration, {})
    for pair in pairs:
        writer.add(pair)
    writer.finish()

    recording = open_source(str(path))

    assert recording.name == "front-1"
    assert recording.configuration == configuration
    assert np.array_equal(recording.T_camera_lidar_start, start)
    assert recording.camera_stamps_ns == bag.camera_stamps_ns
    again = Pairer(PairingConfig(), expects_motion=True)
    replayed = [pair for message in recording.messages() for pair in again.push(message)] + again.flush()
    window, _ = read_window(path)
    assert [stamps(p) for p in replayed] == [stamps(p) for p in window.pairs] == [stamps(p) for p in pairs]


def stamps(pair: FramePair) -> tuple[int, int, EgoMotion | None]:
    return pair.camera.stamp_ns, pair.lidar.stamp_ns, pair.motion


@pytest.mark.parametrize("topic", ["/front/image", "/points"])
def test_messages_without_stamps_are_refused_with_the_way_out(tmp_path: Path, topic: str) -> None:
    drive = drive_messages()
    for name, message in drive:
        if name == topic:
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    bag = Bag(drive).write(tmp_path / "b.mcap")
    with pytest.raises(
        SourceError, match=f"messages on {topic} have the stamp 0 ns .* let the driver fill header.stamp"
    ):
        open_source(str(bag))


def test_a_camera_info_in_a_file_gives_the_intrinsics(tmp_path: Path) -> None:
    info = {
        "image_width": WIDTH, "image_height": HEIGHT, "distortion_model": "plumb_bob",
        "camera_matrix": {"data": [50.0, 0.0, 31.5, 0.0, 51.0, 23.5, 0.0, 0.0, 1.0]},
        "distortion_coefficients": {"data": [0.0] * 5},
    }  # fmt: skip
    (tmp_path / "camera_info.yaml").write_text(json.dumps(info))  # which is YAML, too
    bag = Bag(drive_messages()).write(tmp_path / "b.mcap")
    camera = open_source(f"{bag}?intrinsics={tmp_path / 'camera_info.yaml'}").rig.camera
    assert (cameras.name_of(camera), cameras.intrinsics_of(camera)["fy"]) == ("pinhole", 51.0)
