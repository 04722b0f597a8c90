"""Snippets on disk: what a pair's sensors sent around an event, a ROS 2 bag of one file as `bag_writer` writes it.

It has no `rig.json`, by which windows are known: it is read as a bag, its rig from camera info and `/tf_static`. What
happened is in the metadata `coec_snippet`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from coec.adapters.files import durable
from coec.adapters.mcap.files import Channel, McapDamaged, Message, Metadata, Schema, read_records
from coec.adapters.mcap.ros_channels import RosChannel, check_stamp
from coec.adapters.mcap.whole_file import FinishedFile, WholeFile, failing_as_recording_error
from coec.adapters.mcap.windows.names import LZ4, PACKING, PART_SUFFIX, REWRITE_SUFFIX, beside
from coec.adapters.ros.topics import Frame, FrameTopics, PairTopics
from coec.calibration.types import Matrix4, Rig
from coec.errors import WindowError

METADATA = "coec_snippet"

SYNC_BYTES = 4 * 2**20
"""Put on the disk at once: what a killed recorder loses at most, beside the message under way."""


class SnippetFile:
    """Records one snippet, frame by frame. After a `RecordingError` the file is gone and the writer of no more use.

    Attributes:
        frames: how many it holds.
    """

    def __init__(
        self, path: Path, rig: Rig, T_camera_lidar: Matrix4, metadata: Mapping[str, str], *, packed: bool
    ) -> None:
        """Opens `<path>.part`.

        Args:
            path: the name after `finish`.
            rig: of the pair.
            T_camera_lidar: (4, 4), what `/tf_static` says.
            metadata: what happened.
            packed: compress what shrinks by it.

        Raises:
            RecordingError: the file cannot be written.
        """
        self.frames = 0
        self._topics = FrameTopics(rig, T_camera_lidar, PairTopics.default(rig.pair))
        self._file = WholeFile(beside(path, PART_SUFFIX), path, packed=packed)
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
    """Makes a snippet of what a killed recorder left behind, and removes the `.part` file; None when no message of it
    is whole (or when it was finished after all). `progress` is called after every message.

    Raises:
        RecordingError: it could not be written; the `.part` file is still there.
    """
    final = part_path.with_name(part_path.name.removesuffix(PART_SUFFIX))
    with failing_as_recording_error(final):
        finished = None
        with suppress(WindowError):  # damaged before the first message
            packed = metadata_of(part_path).get(PACKING) == LZ4
            finished = None if final.exists() else _salvaged(part_path, final, progress, packed=packed)
        durable.remove(part_path)
    return finished


def _salvaged(part_path: Path, final: Path, progress: Callable[[], None], *, packed: bool) -> FinishedFile | None:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages = 0
    file = WholeFile(beside(final, REWRITE_SUFFIX), final, packed=packed)
    try:
        # The error that ends the file also ends the loop; whatever came before it was sound.
        with suppress(McapDamaged), part_path.open("rb") as stream:
            for record in read_records(stream):
                match record:
                    case Schema():
                        schemas[record.schema_id] = record
                    case Channel():
                        channels[record.channel_id] = record
                    case Metadata():
                        file.metadata(record.name, record.values)
                    case Message():
                        if record.channel_id not in channels:
                            raise McapDamaged("a message belongs to no channel")
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


def _copy(message: Message, file: WholeFile, schemas: Mapping[int, Schema], channel: Channel) -> None:
    schema = schemas.get(channel.schema_id)
    stamp_ns, number = message.log_time_ns, message.sequence
    file.message(channel.topic, channel.message_encoding, schema, channel.metadata, stamp_ns, number, message.data)


def metadata_of(path: Path) -> dict[str, str]:
    """What a snippet says of itself; empty where it says nothing.

    Raises:
        WindowError: damaged at its beginning.
        OSError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            for record in read_records(stream):
                match record:
                    case Metadata() if record.name == METADATA:
                        return record.values
                    case Message():
                        break
    except McapDamaged as error:
        raise WindowError(error.of(path)) from error
    return {}
