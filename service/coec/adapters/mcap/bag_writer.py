"""All frames of a recording as one ROS 2 bag (MCAP, profile `ros2`): for other tools, and to read back as a source."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from mcap.writer import CompressionType, Writer

from coec import __version__
from coec.adapters.ros import messages
from coec.adapters.ros.topics import Frame, FrameTopics, PairTopics, TopicMessage
from coec.calibration.types import Matrix4, Rig


def _nothing(_: Frame) -> list[tuple[str, str, bytes]]:
    return []


def write_bag(
    path: Path,
    rig: Rig,
    T_camera_lidar: Matrix4,
    frames: Iterable[Frame],
    heard: Callable[[Frame], None],
    beside: Callable[[Frame], Iterable[tuple[str, str, bytes]]] = _nothing,
) -> None:
    """Writes the frames below `/<pair>/` with the camera info of each image and one `/tf_static`.

    Args:
        T_camera_lidar: (4, 4), what `/tf_static` says.
        frames: in the order in which they are written; depth maps are left out.
        heard: told of each frame.
        beside: further messages (topic, type, CDR) at the stamp of a frame.

    Raises:
        OSError: the file cannot be written.
    """
    told = FrameTopics(rig, T_camera_lidar, PairTopics.default(rig.pair))

    def messages_of() -> Iterator[TopicMessage]:
        for frame in frames:
            yield from told.of(frame)
            for topic, type_name, data in beside(frame):
                yield TopicMessage(frame.stamp_ns, topic, type_name, data)
            heard(frame)

    write_messages(path, messages_of())


def write_messages(path: Path, items: Iterable[TopicMessage]) -> None:
    """Writes messages in their order.

    Raises:
        OSError: the file cannot be written.
    """
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start(profile="ros2", library=f"coec/{__version__}")
        topics = _Topics(writer)
        for message in items:
            topics.write(message.topic, message.type_name, message.stamp_ns, message.data)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves the result open


class _Topics:
    """Registers a channel and its schema at the first message."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence = 0

    def write(self, topic: str, type_name: str, stamp_ns: int, data: bytes) -> None:
        """Adds a message."""
        if topic not in self._channels:
            if type_name not in self._schemas:
                definition = messages.definition(type_name).encode()
                self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", definition)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[type_name])
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns, self._sequence)
        self._sequence += 1
