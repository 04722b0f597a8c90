"""What `coec doctor` says of a vehicle's topics."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.types import EgoMotion, Frame
from coec.cli.doctor.streams import NAMED, StreamSamples, stream_findings, topic_findings
from coec.config import IDENTITY, Config, PairConfig
from coec.geometry.sweep_kernels import deskew
from coec.io.ros.wire_format import Publisher
from coec.io.zenoh.ros_node import RosTopicList
from coec.service.ingest.decoder import StreamCounts
from support.scenes import turning_sweep

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


def test_what_was_recognised_of_messages_is_reported() -> None:
    config = configured()
    lidar = StreamSamples("/rear/points", counts=StreamCounts(9, 9, notes=("each cloud covers a part of the turn",)))
    streams = {"camera": StreamSamples("/front/image"), "lidar": lidar}
    (result,) = [one for one in stream_findings(config.pairs[0], streams, config, 1.0, THERE) if one.level == "warn"]
    assert (result.check, result.where) == ("recognised", "/rear/points")
    assert result.text == "lidar: each cloud covers a part of the turn"


@pytest.mark.parametrize("compensated", [True, False])
def test_sweeps_that_the_driver_compensates_are_reported(compensated: bool) -> None:
    config = configured()
    pair = PairConfig.model_validate(config.pairs[0].model_dump() | {"ego": {"topic": "/odom"}})
    motion = EgoMotion(0, "base", (8.0, 0.0, 0.0), (0.0, 0.0, 0.1))
    sweeps: list[Frame] = []
    for number in range(6):
        sweep = turning_sweep(number)
        share = np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0]) / (2 * np.pi) + 0.5
        times_s = share.astype(np.float64) * 0.1
        xyz_m = deskew(sweep.xyz_m, times_s, *sensor_twist(motion, np.eye(4))) if compensated else sweep.xyz_m
        sweeps.append(replace(sweep, stamp_ns=number * 10**8, xyz_m=xyz_m, time_offset_s=times_s.astype(np.float32)))
    motions: list[Frame] = [replace(motion, stamp_ns=number * 10**8) for number in range(6)]
    streams = {
        "camera": StreamSamples("/front/image"),
        "lidar": StreamSamples("/rear/points", first=sweeps),
        "ego": StreamSamples("/odom", first=motions),
    }
    result = [one for one in stream_findings(pair, streams, config, 1.0, THERE) if one.check == "compensation"]
    assert [one.level for one in result] == (["warn"] if compensated else [])
    assert not result or "calibration.motion_compensation: false" in str(result[0].advice)
