"""What `coec doctor` says of a vehicle's topics."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from coec.cli.doctor.streams import NAMED, StreamSamples, stream_findings, topic_findings
from coec.config import IDENTITY, Config
from coec.io.ros.wire_format import Publisher
from coec.io.zenoh.ros_node import RosTopicList
from coec.service.ingest.decoder import StreamCounts

IMAGE, POINTS = "sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2"
LEFT, RIGHT = b"l" * 16, b"r" * 16
THERE = RosTopicList(
    (
        Publisher("/front/image", IMAGE, "/left", LEFT),
        Publisher("/front/image", IMAGE, "/right", RIGHT),
        Publisher("/top/points", POINTS, None, None),
        Publisher("/chatter", "std_msgs/msg/String", "/talker", None),
    )
)


def configured(middleware: str = "rmw_zenoh", **ros: Any) -> Config:
    intrinsics = {"model": "pinhole", "width": 8, "height": 6, "fx": 4, "fy": 4, "cx": 4, "cy": 3}
    camera = {"topic": "/front/image", "frame_id": "camera", "intrinsics": intrinsics}
    lidar = {"topic": "/rear/points", "frame_id": "lidar"}
    pair = {"name": "front", "camera": camera, "lidar": lidar, "T_camera_lidar": IDENTITY}
    return Config.model_validate({"middleware": middleware, "ros": ros, "pairs": [pair]})


def test_topics_that_may_be_streams_are_named_with_types_and_nodes() -> None:
    (result,) = topic_findings(THERE, THERE, configured(domain=7))
    assert (result.level, result.where) == ("ok", "domain 7")
    assert result.text == (
        "/front/image (sensor_msgs/msg/Image, by /left, /right); /top/points (sensor_msgs/msg/PointCloud2); "
        "1 of other types"
    )


def test_a_vehicle_with_very_many_names_some() -> None:
    many = RosTopicList(tuple(Publisher(f"/image{number:03}", IMAGE, "/node", None) for number in range(NAMED + 5)))
    (result,) = topic_findings(many, many, configured())
    assert result.text.count("/image") == NAMED
    assert "; 5 more such; 0 of other types" in result.text


def test_topics_that_only_a_client_of_the_router_sees_are_named() -> None:
    here = RosTopicList(tuple(one for one in THERE.publishers if one.topic != "/top/points"))
    _, result = topic_findings(here, THERE, configured())
    assert result.level == "fail"
    assert "the service does not see /top/points: " in result.text


@pytest.mark.parametrize(("middleware", "where"), [("rmw_zenoh", "domain 0"), ("ros2dds", "bridge")])
def test_nobody_there_is_reported_with_what_may_be_wrong(middleware: str, where: str) -> None:
    (result,) = topic_findings(RosTopicList(), RosTopicList(), configured(middleware))
    assert (result.level, result.where) == ("warn", where)
    assert result.advice is not None
    assert "@ros2_lv/**" in result.advice


def test_tokens_that_were_not_read_are_reported() -> None:
    there = RosTopicList(THERE.publishers, Counter(too_many=7, malformed=2))
    *_, result = topic_findings(there, there, configured())
    assert (result.level, "2 malformed, 7 too_many" in result.text) == ("warn", True)


def test_a_silent_stream_is_reported_with_who_is_there_and_two_senders_by_name() -> None:
    config = configured()
    (pair,) = config.pairs
    camera = StreamSamples("/front/image", counts=StreamCounts(9, 9, (LEFT, RIGHT), stamped_by_sender=True))
    received = {"camera": camera, "lidar": StreamSamples("/rear/points")}
    result = list(stream_findings(pair, received, config, 1.0, THERE))
    (silent,) = [one for one in result if one.where == "/rear/points"]
    assert (silent.level, "no publisher of /rear/points; there are: /top/points" in silent.text) == ("fail", True)
    (unheard,) = [one for one in result if one.where == "/front/image"]
    assert "no publisher" not in unheard.text
    senders, clock = [one.text for one in result if one.check == "senders"]
    assert senders.startswith("2 publishers send on /front/image at the same time: /left, /right.")
    assert "the clock of the sender stamps them" in clock
