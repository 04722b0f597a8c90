"""Writes all frames of a recording as one ROS 2 bag (MCAP, profile `ros2`), for other tools and as a source for
coec."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from coec.adapters.files import durable
from coec.adapters.mcap.chunk_writer import ChunkWriter
from coec.adapters.mcap.ros_channels import CDR, RosChannel
from coec.adapters.ros.topics import Frame, FrameTopics, PairTopics, TopicMessage
from coec.calibration.types import Matrix4, Rig


def _no_messages(_: Frame) -> list[tuple[str, str, bytes]]:
    return []


def write_bag(
    path: Path,
    rig: Rig,
    T_camera_lidar: Matrix4,
    frames: Iterable[Frame],
    on_frame: Callable[[Frame], None],
    extra_messages: Callable[[Frame], Iterable[tuple[str, str, bytes]]] = _no_messages,
) -> None:
    """Writes the frames on topics below `/<pair>/`, with the camera info of each image and one `/tf_static`.

    Args:
        T_camera_lidar: (4, 4), the transform in `/tf_static`.
        frames: in the order in which they are written; depth maps are left out.
        heard: called after each frame.
        beside: further messages (topic, type, CDR) to write at the stamp of a frame.

    Raises:
        OSError: the file cannot be written.
    """
    topics = FrameTopics(rig, T_camera_lidar, PairTopics.default(rig.pair))

    def messages_of() -> Iterator[TopicMessage]:
        for frame in frames:
            yield from topics.of(frame)
            for topic, type_name, data in extra_messages(frame):
                yield TopicMessage(frame.stamp_ns, topic, type_name, data)
            on_frame(frame)

    write_messages(path, messages_of())


def write_messages(path: Path, items: Iterable[TopicMessage]) -> None:
    """Writes messages in the given order.

    Raises:
        OSError: the file cannot be written.
    """
    with os.fdopen(durable.create(path, durable.BY_UMASK), "wb") as stream:
        writer = ChunkWriter(stream)
        channels: dict[str, int] = {}
        for sequence, message in enumerate(items):
            if message.topic not in channels:
                ros = RosChannel(message.topic, message.type_name)
                channels[message.topic] = writer.channel(ros.topic, CDR, ros.schema, ros.metadata)
            number = channels[message.topic]
            writer.message(number, message.stamp_ns, sequence, message.data, packed=False)
        writer.finish()
