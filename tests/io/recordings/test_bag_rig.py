"""The rig of a bag whose messages do not agree by name: frames, transforms and camera infos of somebody else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import CameraFrame, LidarFrame, Recognition
from coec.errors import SourceError
from coec.geometry import cameras, se3
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import HasRecognitions, RecordingSource
from coec.io.ros.camera_info import MAX_CONTENTS
from support.recordings import (
    R_OPTICAL,
    TREE,
    Bag,
    camera_info_message,
    compressed_image_message,
    drive_messages,
    transform_message,
)

IMAGE, INFO, POINTS = "/front/image", "/front/camera_info", "/points"
ELSEWHERE = transform_message("realsense", "depth", np.eye(4))
ELSEWHERE.transform.rotation = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 0.0)


def opened(messages: list[tuple[str, Any]], folder: Path, query: str = "") -> RecordingSource:
    return open_source(f"{Bag(messages).write(folder / 'bag.mcap')}{query}")


def recognitions(recording: RecordingSource) -> dict[str, Recognition]:
    assert isinstance(recording, HasRecognitions)
    return {one.code: one for one in recording.recognitions}


def test_nothing_is_reported_of_a_bag_that_leaves_nothing_open(tmp_path: Path) -> None:
    assert recognitions(opened(drive_messages(), tmp_path)) == {}


def test_an_invalid_transform_of_somebody_else_is_left_out_and_named(tmp_path: Path) -> None:
    expected = opened(drive_messages(), tmp_path).rig.T_camera_lidar_nominal
    recording = opened(drive_messages(tree=[ELSEWHERE, *TREE]), tmp_path)
    assert np.array_equal(recording.rig.T_camera_lidar_nominal, expected)
    notice = recognitions(recording)["transforms_left_out"]
    assert notice.level == "warn"
    assert "'realsense' -> 'depth': not a rigid transform" in notice.text


def test_a_transform_that_comes_with_two_values_is_named(tmp_path: Path) -> None:
    nominal = ("/tf_static", ros.tf2_msgs__msg__TFMessage([transform_message("base", "lidar", np.eye(4))]))
    notice = recognitions(opened([nominal, *drive_messages()], tmp_path))["transform_changes"]
    assert "'base' -> 'lidar' comes with several values" in notice.text
    wheel = [transform_message("base", "wheel", T) for T in (np.eye(4), TREE_T)]
    assert recognitions(opened(drive_messages(tree=[*wheel, *TREE]), tmp_path)) == {}


TREE_T = se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.5, 0.0]))


def moving(child: str) -> list[tuple[str, Any]]:
    poses = [se3.exp(np.array([0.0, 0.0, 0.1 * k, 0.1 * k, 0.0, 0.0])) for k in range(3)]
    return [("/tf", ros.tf2_msgs__msg__TFMessage([transform_message("odom", child, pose)])) for pose in poses]


def test_a_nominal_calibration_that_is_on_tf_only_is_read_where_it_never_changes(tmp_path: Path) -> None:
    expected = opened(drive_messages(), tmp_path).rig.T_camera_lidar_nominal
    published = [("/tf", ros.tf2_msgs__msg__TFMessage(TREE))] * 3
    recording = opened([*moving("base"), *published, *drive_messages(tree=[])], tmp_path)
    np.testing.assert_allclose(recording.rig.T_camera_lidar_nominal, expected, atol=1e-12)
    assert "never change" in recognitions(recording)["constant_transforms"].text
    turning = [("/tf", ros.tf2_msgs__msg__TFMessage([transform_message("base", "lidar", TREE_T), *TREE[1:]]))]
    with pytest.raises(SourceError, match="/tf_static does not connect 'optical' and 'lidar'"):
        opened([*turning, *published, *drive_messages(tree=[])], tmp_path)


def with_frames(topic: str, *names: str) -> list[tuple[str, Any]]:
    """The drive whose messages on a topic name these frames, in turn."""
    messages, count = [], 0
    for place, message in drive_messages():
        if place == topic:
            message.header.frame_id = names[count % len(names)]
            count += 1
        messages.append((place, message))
    return messages


def test_a_namespace_before_the_name_of_a_frame_is_recognised(tmp_path: Path) -> None:
    expected = opened(drive_messages(), tmp_path).rig.T_camera_lidar_nominal
    recording = opened(with_frames(IMAGE, "/robot/optical"), tmp_path)
    assert np.array_equal(recording.rig.T_camera_lidar_nominal, expected)
    assert "'robot/optical' of the messages is taken for 'optical'" in recognitions(recording)["frame_namespace"].text


def test_a_frame_that_no_transform_knows_can_be_named(tmp_path: Path) -> None:
    expected = opened(drive_messages(), tmp_path).rig.T_camera_lidar_nominal
    messages = [(topic, message if topic != INFO else lens(50.0, "0")) for topic, message in with_frames(IMAGE, "0")]
    with pytest.raises(SourceError, match=r"does not connect '0' and 'lidar'.*\?camera_frame=.*there: 'base', 'lidar'"):
        opened(messages, tmp_path)
    assert np.array_equal(opened(messages, tmp_path, "?camera_frame=optical").rig.T_camera_lidar_nominal, expected)
    recording = opened(with_frames(IMAGE, "0"), tmp_path)
    assert np.array_equal(recording.rig.T_camera_lidar_nominal, expected)
    assert "the transforms do not lead there" in recognitions(recording)["camera_frame"].text
    messages = with_frames(POINTS, "7")
    recording = opened(messages, tmp_path, "?lidar_frame=lidar")
    assert np.array_equal(recording.rig.T_camera_lidar_nominal, expected)
    assert next(m.frame_id for m in recording.messages() if isinstance(m, LidarFrame)) == "lidar"


@pytest.mark.parametrize(
    ("topic", "key", "names"),
    [(IMAGE, "camera_frame", ("optical", "left")), (POINTS, "lidar_frame", ("lidar", "rear"))],
)
def test_two_sensors_on_one_topic_are_refused_until_one_is_selected(
    tmp_path: Path, topic: str, key: str, names: tuple[str, str]
) -> None:
    messages = with_frames(topic, *names)
    with pytest.raises(SourceError, match=rf"name 2 frames: .*Two sensors publish on it: choose one with \?{key}=NAME"):
        opened(messages, tmp_path)
    recording = opened(messages, tmp_path, f"?{key}={names[0]}")
    kind = CameraFrame if topic == IMAGE else LidarFrame
    assert {m.frame_id for m in recording.messages() if isinstance(m, kind)} == {names[0]}
    whole = opened(drive_messages(), tmp_path)
    stamps = "camera_stamps_ns" if topic == IMAGE else "sweep_stamps_ns"
    assert len(getattr(recording, stamps)) == len(getattr(whole, stamps)) // 2


def test_the_frame_of_the_camera_info_is_taken_where_the_images_name_the_body(tmp_path: Path) -> None:
    T_base_camera = se3.transform_from(np.eye(3), np.array([1.5, 0.2, 1.4]))
    tree = [
        *TREE[:1],
        transform_message("base", "body", T_base_camera),
        transform_message("body", "optical", se3.transform_from(R_OPTICAL.T, np.zeros(3))),
    ]

    def image(stamp_ns: int) -> Any:
        return compressed_image_message(stamp_ns, "body")

    messages = drive_messages(tree=tree, image=image)
    # Ahead of the vehicle, so that the optical frame sees the points, and the body frame, whose z points up, does not.
    ahead = np.frombuffer(np.tile(np.array([[20.0, 0.0, 0.0]], "<f4"), (4, 1)).tobytes(), np.uint8)
    for topic, message in messages:
        if topic == POINTS:
            message.data = ahead
    recording = opened(messages, tmp_path)
    notice = recognitions(recording)["camera_frame"]
    assert notice.level == "warn"
    assert "The camera's frame is 'optical'" in notice.text
    z_of_axis = recording.rig.T_camera_lidar_nominal[2, 0]
    assert z_of_axis > 0.9
    overridden = opened(messages, tmp_path, "?camera_frame=body")
    assert recognitions(overridden) == {}
    assert overridden.rig.T_camera_lidar_nominal[2, 0] < 0.1


def infos(*of: Any) -> list[tuple[str, Any]]:
    return [(INFO, message) for message in of]


def lens(focal_px: float, frame_id: str = "optical", **changes: Any) -> Any:
    message = camera_info_message("plumb_bob", [0.0] * 5, frame_id=frame_id)
    message.k = np.array([focal_px, 0.0, 31.5, 0.0, focal_px, 23.5, 0.0, 0.0, 1.0])
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def without_info() -> list[tuple[str, Any]]:
    return [message for message in drive_messages() if message[0] != INFO]


def test_empty_camera_infos_are_left_out_and_counted(tmp_path: Path) -> None:
    recording = opened([*infos(lens(0.0), lens(0.0), lens(50.0)), *without_info()], tmp_path)
    assert recording.rig.camera.fx == 50.0
    assert "2 of 3 CameraInfo are empty" in recognitions(recording)["camera_info_empty"].text
    with pytest.raises(SourceError, match="uncalibrated: K is zero"):
        opened([*infos(lens(0.0)), *without_info()], tmp_path)


def test_a_camera_info_that_changes_is_refused_unless_by_less_than_a_pixel(tmp_path: Path) -> None:
    breathing = opened([*infos(lens(50.0), lens(50.0), lens(50.5)), *without_info()], tmp_path)
    assert breathing.rig.camera.fx == 50.0
    assert "changes by up to 0.50 px" in recognitions(breathing)["camera_info_changes"].text
    with pytest.raises(SourceError, match=r"changes on the way, between fx 50\.0, .* and fx 60\.0, .* of 'optical'"):
        opened([*infos(lens(50.0), lens(50.0), lens(60.0)), *without_info()], tmp_path)
    with pytest.raises(SourceError, match="changes on the way"):
        opened([*infos(lens(50.0), lens(50.0, d=np.array([0.1] * 5))), *without_info()], tmp_path)


def test_of_two_cameras_infos_on_a_topic_that_of_the_images_is_taken(tmp_path: Path) -> None:
    recording = opened([*infos(lens(90.0, "left"), lens(90.0, "left"), lens(50.0)), *without_info()], tmp_path)
    assert recording.rig.camera.fx == 50.0


def test_a_camera_info_of_another_camera_is_named(tmp_path: Path) -> None:
    def codes_of(frame: str, tree: list[Any], query: str = "") -> set[str]:
        infos_of_frame = [*infos(lens(50.0, frame)), *without_info()]
        messages = [(topic, one) for topic, one in infos_of_frame if topic != "/tf_static"]
        transforms = ("/tf_static", ros.tf2_msgs__msg__TFMessage(tree))
        return set(recognitions(opened([transforms, *messages], tmp_path, query)))

    body = transform_message("optical", "body", se3.exp(np.array([1.2, 0.0, 0.0, 0.0, 0.05, 0.0])))
    rear = transform_message("base", "rear", se3.exp(np.array([0.0, 0.0, 3.0, -1.0, 0.0, 1.0])))
    assert codes_of("optical", TREE) == set()
    assert codes_of("body", [*TREE, body]) == set()
    assert codes_of("robot/optical", TREE) == set()
    assert codes_of("rear", [*TREE, rear]) == {"camera_info_frame"}
    assert codes_of("rear", TREE) == {"camera_info_frame"}
    assert codes_of("rear", TREE, f"?intrinsics={INFO}") == set()


def test_camera_infos_without_end_are_few_in_memory(tmp_path: Path) -> None:
    many = infos(*(lens(50.0 + 1e-6 * number) for number in range(2 * MAX_CONTENTS)))
    recording = opened([*many, *without_info()], tmp_path)
    assert recording.rig.camera.fx == pytest.approx(50.0, abs=1e-3)


def test_a_binned_lens_is_reported(tmp_path: Path) -> None:
    binned = lens(100.0, width=128, height=96, binning_x=2, binning_y=2)
    recording = opened([*infos(binned), *without_info()], tmp_path)
    assert cameras.intrinsics_of(recording.rig.camera)["fx"] == 50.0
    assert "binned 2 x 2" in recognitions(recording)["camera_info_adapted"].text
