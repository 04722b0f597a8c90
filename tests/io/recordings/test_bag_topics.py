"""The topics of a bag as they are played: the same messages whatever file they lie in."""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from coec.config import LimitsConfig
from coec.errors import SourceError, UsageError
from coec.io.mcap.writer import write_bag
from coec.io.recordings.bag import open_topics
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import parse_spec
from coec.io.ros.message_decoding import decode
from coec.io.ros.messages import COMPRESSED_IMAGE, ODOMETRY, POINT_CLOUD
from coec.io.ros.topics import TopicMessage
from support.recordings import STORE, Bag, cloud_message, compressed_image_message, converted, drive_messages

FRAMES = (COMPRESSED_IMAGE, POINT_CLOUD, ODOMETRY)


def all_of(path: Path) -> list[TopicMessage]:
    bag = open_topics(parse_spec(str(path)))
    return list(bag.messages(bag.infos))


def test_messages_come_in_the_order_in_which_they_were_recorded_as_they_are(tmp_path: Path) -> None:
    drive = drive_messages()
    reported = all_of(Bag(drive).write(tmp_path / "b.mcap"))
    assert [(m.topic, m.type_name, m.stamp_ns) for m in reported] == [
        (topic, message.__msgtype__, time) for time, (topic, message) in enumerate(drive)
    ]
    assert [m.data for m in reported] == [bytes(STORE.serialize_cdr(m, m.__msgtype__)) for _, m in drive]


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_the_same_drive_is_the_same_in_every_file(tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode) -> None:
    """Written by coec, carried over by rosbags: messages to the byte, and what is decoded of them on the bus is what a
    calibration of the file sees."""
    source = open_source(str(Bag(drive_messages()).write(tmp_path / "raw.mcap")))
    written = tmp_path / "drive.mcap"
    write_bag(written, source.rig, source.T_camera_lidar_start, source.messages(), lambda _: None)
    folder = converted(written, tmp_path / "drive", plugin, mode)
    assert all_of(folder) == all_of(written)
    on_air = [decode(m.type_name, m.data, LimitsConfig()) for m in all_of(folder) if m.type_name in FRAMES]
    for expected in (open_source(str(written)), open_source(str(folder)), source):
        assert [repr(frame) for frame in expected.messages()] == [repr(frame) for frame in on_air]


def test_a_topic_of_two_types_is_refused(tmp_path: Path) -> None:
    bag = Bag([("/a", compressed_image_message(1)), ("/a", cloud_message(2))]).write(tmp_path / "b.mcap")
    with pytest.raises(SourceError, match="/a has messages of several types"):
        open_topics(parse_spec(str(bag)))


@pytest.mark.parametrize(("source", "stated"), [("b.mcap?camera=/a", "takes none"), ("folder", "is no bag")])
def test_topics_are_those_of_a_bag_as_it_is(source: str, stated: str) -> None:
    with pytest.raises(UsageError, match=stated):
        open_topics(parse_spec(source))
