"""Where streams come from: keys, topics of ROS 2, and the short forms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from coec.config import IDENTITY, Config, load_config
from coec.errors import ConfigError
from coec.reports.commented_yaml import commented_yaml

INTRINSICS = "intrinsics: {model: pinhole, width: 8, height: 6, fx: 4, fy: 4, cx: 4, cy: 3}"
ROS_VEHICLE = f"""
middleware: rmw_zenoh
pairs:
  - name: front
    camera: {{topic: /front/image_raw/compressed, {INTRINSICS}}}
    points: /top/points
    ego: /odometry
    T_camera_lidar: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


def read(folder: Path, text: str) -> Config:
    path = folder / "coec.yaml"
    path.write_text(text)
    return load_config(path)


def test_topics_by_their_short_forms(tmp_path: Path) -> None:
    config = read(tmp_path, ROS_VEHICLE)
    (pair,) = config.every_pair
    assert {name: stream.topic for name, stream in pair.streams.items()} == {
        "camera": "/front/image_raw/compressed",
        "lidar": "/top/points",
        "ego": "/odometry",
    }
    assert {stream.encoding for stream in pair.streams.values()} == {"cdr"}
    assert {stream.key for stream in pair.streams.values()} == {None}


def test_the_effective_configuration_shows_the_long_form(tmp_path: Path) -> None:
    config = read(tmp_path, ROS_VEHICLE)
    text = commented_yaml(config)
    assert "lidar:\n" in text
    assert "topic: /top/points" in text
    assert "    points:" not in text
    assert read(tmp_path, text) == config


@pytest.mark.parametrize(
    ("topic", "type_name"),
    [
        ("/front/image_raw", "sensor_msgs/msg/Image"),
        ("/front/image_raw/compressed", "sensor_msgs/msg/CompressedImage"),
        ("/front/compressed_not", "sensor_msgs/msg/Image"),
    ],
)
def test_the_name_of_a_topic_reports_the_type_of_images(tmp_path: Path, topic: str, type_name: str) -> None:
    (pair,) = read(tmp_path, ROS_VEHICLE.replace("/front/image_raw/compressed", topic)).every_pair
    assert pair.camera.assumed_type == type_name
    assert set(pair.camera.types) == {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"}


def test_a_type_that_is_set_is_the_only_one_on_a_topic(tmp_path: Path) -> None:
    selected = ROS_VEHICLE.replace("compressed,", "compressed, type: sensor_msgs/msg/Image,")
    (pair,) = read(tmp_path, selected).every_pair
    assert pair.camera.assumed_type == "sensor_msgs/msg/Image"
    assert pair.camera.types == ("sensor_msgs/msg/Image",)


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("middleware: rmw_zenoh", "middleware: native", r"/top/points.*set it, or give the Zenoh `key`"),
        ("topic: /front", "key: front, topic: /front", "one of them"),
        ("topic: /front/image_raw/compressed, ", "", "one of them"),
        ("topic: /front", "topic: front", "topic"),
        ("/top/points", "/top//points", "topic"),
        ("/top/points", "/top/1points", "topic"),
        ("/top/points", "/top/*", "topic"),
        ("/top/points", "/" + "a" * 300, "topic"),
        ("points: /top/points", "points: {topic: /top/points}", "short for"),
        ("points: /top/points", "points: /top/points\n    lidar: {key: a}", "give one of the two"),
        ("topic: /front", "encoding: msgpack, topic: /front", "leave `encoding` out"),
    ],
)
def test_what_cannot_be_a_stream_is_refused_with_what_to_do(
    tmp_path: Path, before: str, after: str, complaint: str
) -> None:
    assert before in ROS_VEHICLE
    with pytest.raises(ConfigError, match=complaint):
        read(tmp_path, ROS_VEHICLE.replace(before, after))


def test_keys_go_next_to_topics(tmp_path: Path) -> None:
    config = read(tmp_path, ROS_VEHICLE.replace("ego: /odometry", "ego: {key: odometry}"))
    assert config.every_pair[0].streams["ego"].place == "odometry"
    assert config.every_pair[0].streams["ego"].encoding == "msgpack"


def test_a_pair_without_ego_motion_has_two_streams(tmp_path: Path) -> None:
    (pair,) = read(tmp_path, ROS_VEHICLE.replace("    ego: /odometry\n", "")).every_pair
    assert list(pair.streams) == ["camera", "lidar"]


EIGHT_LINES = """vehicle: shuttle-7
zenoh: {connect: [tcp/127.0.0.1:7447]}
middleware: rmw_zenoh
pairs:
  - name: front
    camera: /sensing/camera/front/image_raw/compressed
    points: /sensing/lidar/top/points
"""


def test_eight_lines_are_a_configuration_and_its_effective_form_is_the_same(tmp_path: Path) -> None:
    config = read(tmp_path, EIGHT_LINES)
    assert (config.pairs, [pair.name for pair in config.awaited]) == ((), ["front"])
    assert read(tmp_path, commented_yaml(config)) == config


WHOLE = {
    "name": "front",
    "camera": {
        "topic": "/c",
        "frame_id": "camera",
        "intrinsics": {"model": "pinhole", "width": 8, "height": 6, "fx": 4.0, "fy": 4.0, "cx": 4.0, "cy": 3.0},
    },
    "lidar": {"topic": "/l", "frame_id": "lidar"},
    "ego": {"topic": "/o", "T_lidar_ego": IDENTITY},
    "T_camera_lidar": IDENTITY,
}


@pytest.mark.parametrize(
    "left_out",
    ["T_camera_lidar", "camera.frame_id", "camera.intrinsics", "lidar.frame_id", "ego.T_lidar_ego"],
)
def test_a_pair_is_pending_where_something_is_left_out(left_out: str) -> None:
    whole = Config.model_validate({"middleware": "ros2dds", "pairs": [WHOLE]})
    assert (len(whole.pairs), len(whole.awaited)) == (1, 0)
    place, _, name = left_out.rpartition(".")
    lacking: dict[str, Any] = json.loads(json.dumps(WHOLE))
    del (lacking[place] if place else lacking)[name]
    config = Config.model_validate({"middleware": "ros2dds", "pairs": [{**WHOLE, "name": "rear"}, lacking]})
    assert ([pair.name for pair in config.pairs], [pair.name for pair in config.awaited]) == (["rear"], ["front"])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (EIGHT_LINES.replace("middleware: rmw_zenoh\n", ""), "intrinsics"),
        (EIGHT_LINES.replace("front/image_raw", "front//image"), "topic"),
        (EIGHT_LINES + "    speed: 3\n", "speed"),
        (EIGHT_LINES + EIGHT_LINES[EIGHT_LINES.index("  - name") :], "pair names must be unique"),
        (EIGHT_LINES[: EIGHT_LINES.index("pairs")] + "pairs: []\n", "give 1 to 32"),
    ],
)
def test_an_pending_pair_is_checked_as_any_other(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        read(tmp_path, text)
