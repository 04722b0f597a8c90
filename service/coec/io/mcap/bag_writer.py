"""One-file ROS 2 bags (MCAP, profile `ros2`): all frames of a recording, for other tools and as a source for coec; and
snippets, the frames of a pair's sensors around an event.

A snippet has no `rig.json`, which marks windows, so that it is read as a bag, with its rig from camera info and
`/tf_static`. The metadata `coec_snippet` say what happened.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from coec.calibration.types import Matrix4, Rig
from coec.errors import WindowError
from coec.io import storage
from coec.io.mcap.reader import Channel, McapDamagedError, McapMessage, Metadata, Schema, read_records
from coec.io.mcap.window_reader import LZ4, PACKING, PART_SUFFIX, REWRITE_SUFFIX, with_suffix
from coec.io.mcap.writer import (
    CDR,
    ChunkWriter,
    FinishedFile,
    RosChannel,
    WholeFile,
    check_stamp,
    failing_as_recording_error,
)
from coec.io.ros.topics import Frame, FrameTopics, PairTopics, TopicMessage

METADATA = "coec_snippet"

SYNC_BYTES = 4 * 2**20
"""Bytes after which the file is synced. A killed recorder loses at most this much, and the message being written."""


class SnippetFile:
    """Records one snippet, frame by frame. After a `RecordingError` the file is gone and the writer unusable.

    Attributes:
        frames: number of frames in the file.
    """

    def __init__(
        self, path: Path, rig: Rig, T_camera_lidar: Matrix4, metadata: Mapping[str, str], *, packed: bool
    ) -> None:
        """Opens `<path>.part`.

        Args:
            path: the name after `finish`.
            rig: of the pair.
            T_camera_lidar: (4, 4), the transform in `/tf_static`.
            metadata: what happened.
            packed: compress messages that shrink.

        Raises:
            RecordingError: the file cannot be written.
        """
        self.frames = 0
        self._topics = FrameTopics(rig, T_camera_lidar, PairTopics.default(rig.pair))
        self._file = WholeFile(with_suffix(path, PART_SUFFIX), path, packed=packed)
        self._file.metadata(METADATA, {**metadata, PACKING: LZ4 if packed else ""})
        self._file.sync()
        self._unsynced = 0

    def add(self, frame: Frame) -> None:
        """Appends a frame.

        Raises:
            RecordingError: it could not be written.
        """
        check_stamp(frame.stamp_ns)
        for message in self._topics.of(frame):
            channel = RosChannel(message.topic, message.type_name)
            self._file.ros(channel, message.stamp_ns, self.frames, message.data)
            self._unsynced += len(message.data)
        self.frames += 1
        if self._unsynced > SYNC_BYTES:
            self._file.sync()
            self._unsynced = 0

    def finish(self) -> FinishedFile:
        """Writes the index, syncs, and gives the file its final name.

        Raises:
            RecordingError: it could not be written.
        """
        return self._file.finish()

    def abandon(self) -> None:
        """Removes the `.part` file."""
        self._file.abandon()


def salvage_snippet(part_path: Path, progress: Callable[[], None]) -> FinishedFile | None:
    """Makes a snippet of the `.part` file that a killed recorder left behind, and removes that file. None if no message
    in it is whole, or if the snippet was finished after all. `progress` is called after every message.

    Raises:
        RecordingError: it could not be written; the `.part` file is still there.
    """
    final = part_path.with_name(part_path.name.removesuffix(PART_SUFFIX))
    with failing_as_recording_error(final):
        finished = None
        with suppress(WindowError):  # damaged before the first message
            packed = metadata_of(part_path).get(PACKING) == LZ4
            finished = None if final.exists() else _salvaged(part_path, final, progress, packed=packed)
        storage.remove(part_path)
    return finished


def _salvaged(part_path: Path, final: Path, progress: Callable[[], None], *, packed: bool) -> FinishedFile | None:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages = 0
    file = WholeFile(with_suffix(final, REWRITE_SUFFIX), final, packed=packed)
    try:
        # The error at the damaged end of the file ends the loop; everything before it is sound.
        with suppress(McapDamagedError), part_path.open("rb") as stream:
            for record in read_records(stream):
                match record:
                    case Schema():
                        schemas[record.schema_id] = record
                    case Channel():
                        channels[record.channel_id] = record
                    case Metadata():
                        file.metadata(record.name, record.values)
                    case McapMessage():
                        if record.channel_id not in channels:
                            raise McapDamagedError("a message belongs to no channel")
                        _copy(record, file, schemas, channels[record.channel_id])
                        messages += 1
                        progress()
    except BaseException:
        file.abandon()
        raise
    if messages == 0:
        file.abandon()
        return None
    return file.finish()


def _copy(message: McapMessage, file: WholeFile, schemas: Mapping[int, Schema], channel: Channel) -> None:
    schema = schemas.get(channel.schema_id)
    stamp_ns, number = message.log_time_ns, message.sequence
    file.message(channel.topic, channel.message_encoding, schema, channel.metadata, stamp_ns, number, message.data)


def metadata_of(path: Path) -> dict[str, str]:
    """The metadata `coec_snippet` of a snippet; empty if it has none.

    Raises:
        WindowError: the file is damaged at its beginning.
        OSError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            for record in read_records(stream):
                match record:
                    case Metadata() if record.name == METADATA:
                        return record.values
                    case McapMessage():
                        break
    except McapDamagedError as error:
        raise WindowError(error.of(path)) from error
    return {}


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
    with os.fdopen(storage.create(path, storage.BY_UMASK), "wb") as stream:
        writer = ChunkWriter(stream)
        channels: dict[str, int] = {}
        for sequence, message in enumerate(items):
            if message.topic not in channels:
                ros = RosChannel(message.topic, message.type_name)
                channels[message.topic] = writer.channel(ros.topic, CDR, ros.schema, ros.metadata)
            number = channels[message.topic]
            writer.message(number, message.stamp_ns, sequence, message.data, packed=False)
        writer.finish()
