"""MCAP files that appear completely written or not at all, and one-file ROS 2 bags (profile `ros2`): all frames of a
recording, for other tools and as a source for coec; and snippets, the frames of a pair's sensors around an event.
Each chunk is compressed only if it shrinks: clouds do, encoded images do not. ROS 2 topics become channels with
their type definitions and quality of service.

The writer of the `mcap` package compresses either all chunks of a file or none, and copies each message three times. So
messages and chunks are written here; the other records are those of the package (MCAP specification, "Records").

A snippet has no `rig.json`, which marks windows, so that it is read as a bag, with its rig from camera info and
`/tf_static`. The metadata `coec_snippet` say what happened.
"""

import hashlib
import io
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from coec import __version__
from coec.calibration.types import Frame, Matrix4, Rig
from coec.errors import RecordingError, WindowError
from coec.io import storage
from coec.io.mcap.reader import (
    MAGIC,
    Channel,
    McapDamagedError,
    McapMessage,
    Metadata,
    Schema,
    read_metadata,
    read_records,
)
from coec.io.ros import messages
from coec.io.ros.topics import FrameTopics, PairTopics, TopicMessage, qos_of

PROFILE = "ros2"

LIBRARY = f"coec/{__version__}"

PART_SUFFIX = ".part"
"""Suffix of a file that is being recorded. A file with it that is found at start can be salvaged."""

REWRITE_SUFFIX = ".tmp"
"""Suffix of a finished file that is being rewritten. A file with it that is found at start is useless, because the
original is still there."""

PACKING, LZ4 = "packing", "lz4"
"""Entry of the metadata: compression of the chunks that shrink; empty: none. Rewriting a file keeps it."""

CHUNK_BYTES = 64 * 1024
"""A chunk is closed at the latest by the first message past this size, so that little is held in memory."""

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_TEXT = struct.Struct("<I")
_LONG = struct.Struct("<Q")
_FOOTER = struct.Struct("<BQQQ")
_FOOTER_BYTES = 20


@dataclass(slots=True)
class _Chunk:
    """The chunk that is being filled: its records in order, and the offsets of its messages."""

    packed: bool
    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    first_ns: int = 0
    last_ns: int = 0
    indexes: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(self, *parts: bytes) -> None:
        self.parts += parts
        self.size += sum(map(len, parts))

    def add_message(self, channel_id: int, stamp_ns: int, sequence: int, data: bytes) -> None:
        self.first_ns = min(self.first_ns, stamp_ns) if self.indexes else stamp_ns
        self.last_ns = max(self.last_ns, stamp_ns)
        self.indexes.setdefault(channel_id, []).append((stamp_ns, self.size))
        head = _RECORD.pack(Opcode.MESSAGE, _MESSAGE.size + len(data))
        self.add(head, _MESSAGE.pack(channel_id, sequence, stamp_ns, stamp_ns), data)


class ChunkWriter:
    """Writes one file, front to back, into a stream at its beginning. The file does not hold the time of writing."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._at = 0
        self._crc = 0
        self._chunk: _Chunk | None = None
        self._schemas: dict[tuple[str, str, bytes], records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}
        self._unsaid: list[records.McapRecord] = []
        self._chunks: list[records.ChunkIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._first_ns, self._last_ns = 0, 0
        self._write(MAGIC)
        self._write(_bytes_of([records.Header(PROFILE, LIBRARY)]))

    def channel(self, topic: str, encoding: str, schema: Schema | None, metadata: Mapping[str, str]) -> int:
        """Adds a channel and returns its number. Without a `schema` its messages describe themselves."""
        key = None if schema is None else (schema.name, schema.encoding, schema.data)
        if key is not None and key not in self._schemas:
            name, schema_encoding, data = key
            number = len(self._schemas) + 1
            self._schemas[key] = records.Schema(id=number, name=name, encoding=schema_encoding, data=data)
            self._unsaid.append(self._schemas[key])
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=encoding,
            metadata=dict(metadata),
            schema_id=0 if key is None else self._schemas[key].id,
        )
        self._channels[channel.id] = channel
        self._unsaid.append(channel)
        return channel.id

    def message(self, channel_id: int, stamp_ns: int, sequence: int, data: bytes, *, packed: bool) -> None:
        """Adds a message; if `packed`, to a chunk that is compressed (lz4)."""
        if self._chunk is not None and self._chunk.packed is not packed:
            self.close_chunk()
        if self._chunk is None:
            self._chunk = _Chunk(packed)
        if self._unsaid:
            self._chunk.add(_bytes_of(self._unsaid))
            self._unsaid = []
        self._chunk.add_message(channel_id, stamp_ns, sequence, data)
        self._first_ns = min(self._first_ns, stamp_ns) if self._counts else stamp_ns
        self._last_ns = max(self._last_ns, stamp_ns)
        self._counts[channel_id] = self._counts.get(channel_id, 0) + 1
        if self._chunk.size > CHUNK_BYTES:
            self.close_chunk()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Adds an attachment with time 0, as it belongs to no instant."""
        self.close_chunk()
        at = self._at
        attachment = records.Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        self._write(_bytes_of([attachment]))
        index = records.AttachmentIndex(
            offset=at,
            length=self._at - at,
            log_time=0,
            create_time=0,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._attachments.append(index)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds a metadata record."""
        self.close_chunk()
        at = self._at
        self._write(_bytes_of([records.Metadata(name=name, metadata=dict(values))]))
        self._metadata.append(records.MetadataIndex(offset=at, length=self._at - at, name=name))

    def close_chunk(self) -> None:
        """Writes the open chunk, so that everything added so far can be read whatever happens later."""
        chunk, self._chunk = self._chunk, None
        if chunk is None:
            return
        data = b"".join(chunk.parts)
        packed = lz4.frame.compress(data) if chunk.packed else data
        compression = "lz4" if len(packed) < len(data) else ""
        stored = packed if compression else data
        name = compression.encode()
        head = (
            _CHUNK.pack(chunk.first_ns, chunk.last_ns, len(data), zlib.crc32(data))
            + _TEXT.pack(len(name))
            + name
            + _LONG.pack(len(stored))
        )
        at = self._at
        self._write(_RECORD.pack(Opcode.CHUNK, len(head) + len(stored)) + head)
        self._write(stored)
        length = self._at - at
        index_at, offsets = self._at, {}
        for channel_id, places in chunk.indexes.items():
            offsets[channel_id] = self._at
            self._write(_bytes_of([records.MessageIndex(channel_id=channel_id, records=places)]))
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=length,
                chunk_start_offset=at,
                compression=compression,
                compressed_size=len(stored),
                message_end_time=chunk.last_ns,
                message_index_length=self._at - index_at,
                message_index_offsets=offsets,
                message_start_time=chunk.first_ns,
                uncompressed_size=len(data),
            )
        )

    def finish(self) -> None:
        """Writes the index and the end of the file."""
        self.close_chunk()
        self._write(_bytes_of([records.DataEnd(self._crc)]))
        at, summary, offsets = self._at, b"", list[records.McapRecord]()
        for opcode, group in self._summary():
            data = _bytes_of(group)
            place = at + len(summary)
            offsets.append(records.SummaryOffset(group_opcode=opcode, group_start=place, group_length=len(data)))
            summary += data
        offsets_at = at + len(summary)
        summary += _bytes_of(offsets)
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, _FOOTER_BYTES, at, offsets_at), zlib.crc32(summary))
        footer = records.Footer(summary_start=at, summary_offset_start=offsets_at, summary_crc=crc)
        self._write(summary + _bytes_of([footer]) + MAGIC)

    def _summary(self) -> list[tuple[Opcode, Sequence[records.McapRecord]]]:
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self._last_ns,
            message_start_time=self._first_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Sequence[records.McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        return [group for group in groups if group[1]]

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._at += len(data)
        self._stream.write(data)


def _bytes_of(group: Sequence[records.McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in group:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]  # mcap does not annotate the result
    return data


CDR = "cdr"

QOS = "offered_qos_profiles"
"""Key in the metadata of a channel, required by the profile `ros2`. Without it `ros2 bag play` does not offer
`/tf_static` to late subscribers."""

MAX_STAMP_NS = 2**31 * 1_000_000_000
"""End of ROS 2 time, which has signed 32-bit seconds."""

SHRINK = frozenset({messages.POINT_CLOUD, messages.IMAGE})
"""Types whose messages lz4 makes smaller: clouds by a tenth, raw images by more. Encoded images do not shrink."""

_FOREVER = "{sec: 9223372036, nsec: 854775807}"
"""What rosbag2 writes if there is no deadline."""


def check_stamp(stamp_ns: int) -> None:
    """Checks that a ROS message can carry a stamp.

    Raises:
        RecordingError: it cannot.
    """
    if not 0 <= stamp_ns < MAX_STAMP_NS:
        raise RecordingError(f"stamp {stamp_ns} ns does not fit the 32-bit seconds of ROS 2")


@dataclass(frozen=True, slots=True)
class RosChannel:
    """A topic and the type of its messages."""

    topic: str
    type_name: str

    @property
    def schema(self) -> Schema:
        """The definition of the type, for readers that do not know it."""
        return _schema(self.type_name)

    @property
    def metadata(self) -> Mapping[str, str]:
        """The quality of service with which the topic is to be played."""
        return {QOS: _qos_text(self.topic)}


@lru_cache(maxsize=64)
def _qos_text(topic: str) -> str:
    """The quality of service in numbers, as rosbag2 writes it up to version 8 of its metadata. Readers assume that
    version unless a `metadata.yaml` gives another (`rmw_qos_*_policy_t` of rmw/types.h; rosbag2_storage/qos.cpp)."""
    qos = qos_of(topic)
    return "\n".join(
        (
            "- history: 1",  # keep last
            f"  depth: {qos.depth}",
            f"  reliability: {1 if qos.reliable else 2}",
            f"  durability: {1 if qos.transient_local else 2}",
            f"  deadline: {_FOREVER}",
            f"  lifespan: {_FOREVER}",
            "  liveliness: 1",  # automatic
            f"  liveliness_lease_duration: {_FOREVER}",
            "  avoid_ros_namespace_conventions: false",
        )
    )


@lru_cache(maxsize=16)
def _schema(type_name: str) -> Schema:
    return Schema(0, type_name, "ros2msg", messages.definition(type_name).encode())


@dataclass(frozen=True, slots=True)
class FinishedFile:
    """A finished file. `sha256` is hexadecimal, over the whole file; `bytes` and `modified_ns` (the file system's time
    of the last write) distinguish this version of the file from a later one."""

    path: Path
    bytes: int
    modified_ns: int
    sha256: str


class _HashingFile(io.BufferedWriter):
    """Hashes all bytes written. It must only be appended to."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(storage.create(path), "wb"))
        self.sha256 = hashlib.sha256()

    def write(self, data: Any, /) -> int:
        """Hash and write."""
        self.sha256.update(data)
        return super().write(data)


class WholeFile:
    """An MCAP file that gets its final name only once it is complete and on the disk."""

    def __init__(self, temporary: Path, final: Path, *, packed: bool) -> None:
        """Opens `temporary`, which becomes `final`. If `packed`, messages that shrink are compressed.

        Raises:
            RecordingError: the file cannot be written. All methods raise it; then the temporary file is gone.
        """
        self._temporary, self._final = temporary, final
        self._packed = packed
        self._channels: dict[str, int] = {}
        with failing_as_recording_error(final):
            self._file = _HashingFile(temporary)
        with self._guarded():
            storage.sync_folder(temporary.parent)
            self._mcap = ChunkWriter(self._file)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Adds an attachment with time 0, as it belongs to no instant."""
        with self._guarded():
            self._mcap.attach(name, media_type, data)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds a metadata record."""
        with self._guarded():
            self._mcap.metadata(name, values)

    def ros(self, channel: RosChannel, stamp_ns: int, sequence: int, data: bytes) -> None:
        """Adds a ROS message."""
        self.message(channel.topic, CDR, channel.schema, channel.metadata, stamp_ns, sequence, data)

    def message(
        self,
        topic: str,
        encoding: str,
        schema: Schema | None,
        metadata: Mapping[str, str],
        stamp_ns: int,
        sequence: int,
        data: bytes,
    ) -> None:
        """Adds a message of any kind. The first message on a topic determines the topic's channel."""
        packed = self._packed and schema is not None and schema.name in SHRINK
        with self._guarded():
            if topic not in self._channels:
                self._channels[topic] = self._mcap.channel(topic, encoding, schema, metadata)
            self._mcap.message(self._channels[topic], stamp_ns, sequence, data, packed=packed)

    def copy(self, message: McapMessage, schemas: Mapping[int, Schema], channel: Channel) -> None:
        """Adds a message of another file, whose channel and schemas are given."""
        schema = schemas.get(channel.schema_id)
        stamp_ns, number = message.log_time_ns, message.sequence
        self.message(channel.topic, channel.message_encoding, schema, channel.metadata, stamp_ns, number, message.data)

    def sync(self) -> None:
        """Puts what was added on the disk. Called often, so that the end of a window need not wait for all of it."""
        with self._guarded():
            self._mcap.close_chunk()
            self._file.flush()
            os.fdatasync(self._file.fileno())

    def finish(self) -> FinishedFile:
        """Writes the index, and makes file and name durable."""
        with self._guarded():
            self._mcap.finish()
            self._file.flush()
            status = os.fstat(self._file.fileno())
            storage.publish(self._file, self._temporary, self._final)
        return FinishedFile(self._final, status.st_size, status.st_mtime_ns, self._file.sha256.hexdigest())

    def abandon(self) -> None:
        """Removes the temporary file."""
        with suppress(OSError):  # closing flushes, which fails again on a full disk
            self._file.close()
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        with failing_as_recording_error(self._final):
            try:
                yield
            except BaseException:
                self.abandon()
                raise


@contextmanager
def failing_as_recording_error(path: Path) -> Iterator[None]:
    """Turns an OSError about a file into a `RecordingError` with a clear message."""
    try:
        yield
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror}; free space or choose another directory"
        ) from error


# --- snippets ---------------------------------------------------------------------------------------------------------


def with_suffix(path: Path, suffix: str) -> Path:
    """The path with a suffix added to the file name."""
    return path.with_name(path.name + suffix)


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
                        file.copy(record, schemas, channels[record.channel_id])
                        messages += 1
                        progress()
    except BaseException:
        file.abandon()
        raise
    if messages == 0:
        file.abandon()
        return None
    return file.finish()


def metadata_of(path: Path) -> dict[str, str]:
    """The metadata `coec_snippet` of a snippet; empty if it has none.

    Raises:
        WindowError: the file is damaged at its beginning.
        OSError: it cannot be read.
    """
    try:
        return read_metadata(path, METADATA)
    except McapDamagedError as error:
        raise WindowError(error.of(path)) from error


# --- bags -------------------------------------------------------------------------------------------------------------


def write_bag(
    path: Path,
    rig: Rig,
    T_camera_lidar: Matrix4,
    frames: Iterable[Frame],
    on_frame: Callable[[Frame], None],
    extra_messages: Callable[[Frame], Iterable[tuple[str, str, bytes]]] = lambda _: (),
) -> None:
    """Writes the frames on topics below `/<pair>/`, with the camera info of each image and one `/tf_static`.

    Args:
        T_camera_lidar: (4, 4), the transform in `/tf_static`.
        frames: in the order in which they are written; depth maps are left out.
        on_frame: called after each frame.
        extra_messages: further messages (topic, type, CDR) to write at the stamp of a frame.

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
