"""One interface to the messages of a bag, and its files: MCAP, SQLite, bags of ROS 1 (`.bag`, format 2.0:
wiki.ros.org/Bags/Format/2.0), whose records are read one after the other, so that a bag without index
(`.bag.active`) reads like another one; folders of rosbag2 with their `metadata.yaml`, packed as a whole, message by
message or not at all, and folders of files without it. Sizes are bounded before they are used; `rosbags` reads bags
that it trusts.

Files are not trusted: their schema is not, nothing in them may be longer than a message, and the tables must be real
tables.

Files that are packed as a whole (`compression_mode: FILE`) are unpacked into the system's temporary folder, and removed
when the recording is no longer used.
"""

import bisect
import bz2
import re
import shutil
import sqlite3
import struct
import tempfile
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol
from urllib.parse import quote

import lz4.frame
import zstandard
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coec.config import describe, load_yaml
from coec.errors import ConfigError, DecodeError, SourceError
from coec.io.mcap import reader as mcap_reader
from coec.io.mcap.reader import MAX_CHUNK_BYTES, MAX_RATIO
from coec.io.mcap.windows import is_window
from coec.io.recordings.recording_source import BAG_SUFFIXES
from coec.io.ros import message_decoding, messages
from coec.io.ros.translations import TRANSLATIONS, translation_of


@dataclass(frozen=True, slots=True)
class BagMessage:
    """A message, and the place at which it can be read again.

    Attributes:
        type_name: ROS type, for example `sensor_msgs/msg/Image`.
        data: the message in CDR.
        logged_ns: when the recorder got the message, by its own clock.
        place: where the message lies; only the storage that gave it can use it.
        error: why the message is damaged, which then has no data. Without a topic, it is a record of the container.
    """

    topic: str
    type_name: str
    data: bytes
    logged_ns: int
    place: tuple[int, ...]
    error: SourceError | None = None

    @classmethod
    def damaged(cls, at: int, error: SourceError) -> "BagMessage":
        """A damaged record of the container, which begins at this byte."""
        return cls("", "", b"", 0, (at,), error)


BagReader = Callable[[tuple[int, ...]], bytes]
"""Reads the data of the message at a place again, while the files are open. Raises SourceError if the file is no longer
what it was."""


class BagStorage(Protocol):
    """The messages of a bag.

    Attributes:
        path: path of the bag, as a person gives it.
    """

    @property
    def path(self) -> Path:
        """See above."""

    def entries(self) -> Iterator[BagMessage]:
        """All CDR messages, in the order in which they lie in the bag; also those that are damaged.

        Raises:
            SourceError: a file is absent, cut off, or so damaged that what follows cannot be read; names it.
        """

    def open(self) -> AbstractContextManager[BagReader]:
        """A context manager that gives a reader; the files are closed at its end."""


_NO_CHUNK = -1


# --- MCAP -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class McapStorage:
    """The `BagStorage` of an MCAP file. A place is: file offset of the chunk (-1 outside chunks), offset in the chunk,
    length; and the number of the translation of a message that is not in CDR."""

    path: Path

    def entries(self) -> Iterator[BagMessage]:
        """See `BagStorage`."""
        schemas: dict[int, mcap_reader.Schema] = {}
        channels: dict[int, mcap_reader.Channel] = {}
        try:
            with self.path.open("rb") as stream:
                limit = MAX_CHUNK_BYTES + MAX_RATIO * self.path.stat().st_size
                for record in mcap_reader.read_records(stream, max_unpacked_bytes=limit, skip_damaged=True):
                    match record:
                        case mcap_reader.DamagedRecord():
                            yield BagMessage.damaged(record.at, SourceError(record.error.of(self.path)))
                        case mcap_reader.Schema():
                            schemas[record.schema_id] = record
                        case mcap_reader.Channel():
                            channels[record.channel_id] = record
                        case mcap_reader.McapMessage():
                            channel = channels.get(record.channel_id)
                            schema = None if channel is None else schemas.get(channel.schema_id)
                            if channel is not None and schema is not None:
                                yield from self._entry(channel, schema.name, record)
        except OSError as error:
            raise SourceError(f"cannot read {self.path}: {error.strerror}") from error
        except mcap_reader.McapDamagedError as error:
            raise SourceError(error.of(self.path)) from error

    def _entry(
        self, channel: mcap_reader.Channel, type_name: str, message: mcap_reader.McapMessage
    ) -> Iterator[BagMessage]:
        chunk_at = _NO_CHUNK if message.chunk_at is None else message.chunk_at
        data = message.data
        place: tuple[int, ...] = (chunk_at, message.at, len(data))
        if channel.message_encoding != "cdr":
            number = translation_of(channel.message_encoding, type_name)
            if number is None:
                # Named without its content, so that an error can say what to do.
                of_ros = type_name.replace("foxglove.", "foxglove_msgs/msg/")
                if of_ros in message_decoding.REFUSED:
                    yield BagMessage(channel.topic, of_ros, b"", message.log_time_ns, place)
                return
            where = f"{self.path}: a message on {channel.topic}"
            yield translated_message(number, data, where, channel.topic, message.log_time_ns, (*place, number))
            return
        yield BagMessage(channel.topic, type_name, data, message.log_time_ns, place)

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """See `BagStorage`."""
        with self.path.open("rb") as stream:
            reader = mcap_reader.MessageReader(stream)

            def read(place: tuple[int, ...]) -> bytes:
                chunk_at, at, length, *number = place
                try:
                    data = reader.read(None if chunk_at == _NO_CHUNK else chunk_at, at, length)
                except mcap_reader.McapDamagedError as error:
                    raise SourceError(f"{self.path}: {error}") from error
                return translated(number[0], data, f"{self.path}: a message") if number else data

            yield read


_READ = frozenset((*message_decoding.KNOWN, *messages.OTHER_TYPES, messages.CAMERA_INFO, messages.TF))
"""Types of ROS 2 from which something is read; messages of others are somebody else's."""


def translated(number: int, data: bytes, where: str) -> bytes:
    """A message in CDR, by the number of its translation.

    Raises:
        SourceError: it cannot be translated.
    """
    try:
        return TRANSLATIONS[number].convert(data)
    except DecodeError as error:
        raise SourceError(f"{where} is refused: {error}") from error


def translated_message(
    number: int, data: bytes, where: str, topic: str, logged_ns: int, place: tuple[int, ...]
) -> BagMessage:
    """A message of which something is read, in CDR; any other one as it is, because its translation takes time, and may
    fail."""
    type_name = TRANSLATIONS[number].type_name
    try:
        if type_name in _READ:
            data = translated(number, data, where)
    except SourceError as error:
        return BagMessage(topic, type_name, b"", logged_ns, place, error)
    return BagMessage(topic, type_name, data, logged_ns, place)


MAX_MESSAGE_BYTES = 256 * 2**20
"""Largest message, bytes; the same as for MCAP's chunks."""

MAX_TOPICS = 10_000
"""Most topics of a bag; a large vehicle has some 2,000."""

MAX_NAME = 1024
"""Most characters of the name of a topic or a type."""

MIN_ROW_BYTES = 4
"""Least bytes that a message takes in the file beside its data. Size of the cell, row, header and time take more."""

_TABLES = {"topics", "messages"}


# --- SQLite -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SqliteStorage:
    """The `BagStorage` of a SQLite file. A place is the row of a message."""

    path: Path

    def entries(self) -> Iterator[BagMessage]:
        """See `BagStorage`."""
        with self._connected() as connection:
            topics = self._topics(connection)
            left = self.path.stat().st_size
            # In the order of the file, without join or ORDER BY, so that nothing is sorted, whatever the schema says.
            for row, topic_id, logged_ns, data in connection.execute(
                "SELECT rowid, topic_id, timestamp, data FROM messages"
            ):
                if not (isinstance(row, int) and isinstance(logged_ns, int)) or topic_id not in topics:
                    raise SourceError(f"{self.path} is damaged: a message has no number, no time or no topic")
                message = self._bytes(row, data)
                # A file whose pages are used twice, or whose columns are computed, would give more bytes than it has.
                left -= len(message) + MIN_ROW_BYTES
                if left < 0:
                    raise SourceError(f"{self.path} is damaged: its messages are longer than the file")
                topic, type_name, serialization = topics[topic_id]
                if serialization == "cdr":
                    yield BagMessage(topic, type_name, message, logged_ns, (row,))

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """See `BagStorage`."""
        with self._connected() as connection:
            yield lambda place: self._read(connection, place[0])

    def _topics(self, connection: sqlite3.Connection) -> dict[int, tuple[str, str, str]]:
        """Name, type and serialization of each topic, by id."""
        topics = {}
        rows = connection.execute("SELECT id, name, type, serialization_format FROM topics LIMIT ?", (MAX_TOPICS + 1,))
        for number, *texts in rows:
            if not isinstance(number, int) or not all(isinstance(t, str) and len(t) <= MAX_NAME for t in texts):
                raise SourceError(f"{self.path} is damaged: a topic has no name, type or serialization")
            topics[number] = (texts[0], texts[1], texts[2])
        if len(topics) > MAX_TOPICS:
            raise SourceError(f"{self.path} has more than {MAX_TOPICS} topics")
        return topics

    def _read(self, connection: sqlite3.Connection, row: int) -> bytes:
        """The data of the message in a row."""
        row_data = connection.execute("SELECT data FROM messages WHERE rowid = ?", (row,)).fetchone()
        if row_data is None:
            raise SourceError(f"{self.path}: there is no message {row} any more: the file has changed")
        return self._bytes(row, row_data[0])

    def _bytes(self, row: int, data: object) -> bytes:
        if not isinstance(data, bytes):
            raise SourceError(f"{self.path} is damaged: message {row} holds no bytes")
        return data

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        """Connects to the file. If nobody is writing it, it is opened as immutable, so that SQLite needs no second file
        beside it."""
        if not self.path.is_file():
            raise SourceError(f"{self.path} does not exist")
        write_ahead_log = self.path.with_name(f"{self.path.name}-wal")
        mode = "mode=ro" if write_ahead_log.exists() and write_ahead_log.stat().st_size else "mode=ro&immutable=1"
        try:
            with closing(sqlite3.connect(f"file:{quote(str(self.path))}?{mode}", uri=True)) as connection:
                connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
                connection.execute("PRAGMA trusted_schema = OFF")
                connection.execute("PRAGMA cell_size_check = ON")
                named = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")
                if not {name for (name,) in named} >= _TABLES:
                    raise SourceError(f"{self.path} is no bag: it has no tables {' and '.join(sorted(_TABLES))}")
                yield connection
        except sqlite3.Error as error:
            if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_NOTADB:
                raise SourceError(f"{self.path} is no bag: it is no database of SQLite") from error
            raise SourceError(f"{self.path} is damaged: {error}. `ros2 bag reindex` may save it") from error


# --- bags of ROS 1 ----------------------------------------------------------------------------------------------------

MAGIC: Final = b"#ROSBAG V2.0\n"

MAX_HEADER_BYTES: Final = 1 << 20
"""Longest header of a record. A connection's has its topic; the definition of its messages is in the data."""

MAX_CONNECTION_BYTES: Final = 1 << 24
"""Longest data of a connection: the definition of a message has some 10 kB."""

_MESSAGE, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 5, 6, 7
"""Operations of records; others repeat what these say."""

_LENGTH: Final = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class _Record:
    """A record: its fields, and where its data begins."""

    fields: dict[bytes, bytes]
    data: bytes
    at: int

    @property
    def operation(self) -> int:
        return int.from_bytes(self.fields.get(b"op", b""), "little")

    def number(self, name: bytes) -> int:
        value = self.fields.get(name, b"")
        if len(value) != _LENGTH.size:
            raise ValueError(f"byte {self.at}: a record has no valid {name.decode()}")
        return int(_LENGTH.unpack(value)[0])

    def offset(self, name: bytes) -> int:
        value = self.fields.get(name, b"")
        if len(value) != 8:
            raise ValueError(f"byte {self.at}: a record has no valid {name.decode()}")
        return int.from_bytes(value, "little")


def _records(data: bytes, begin: int) -> Iterator[_Record]:
    """The records in some bytes. `begin` is where these stand in the file."""
    at = 0
    while at < len(data):
        header, at = _span(data, at, begin, MAX_HEADER_BYTES)
        body, end = _span(data, at, begin, MAX_CHUNK_BYTES)
        yield _Record(_fields(header, begin + at), body, at + _LENGTH.size)
        at = end


def _span(data: bytes, at: int, begin: int, most: int) -> tuple[bytes, int]:
    """The bytes behind their length, and where they end."""
    if at + _LENGTH.size > len(data):
        raise ValueError(f"byte {begin + at}: the file is cut off")
    (length,) = _LENGTH.unpack_from(data, at)
    at += _LENGTH.size
    if length > most or length > len(data) - at:
        raise ValueError(f"byte {begin + at}: a record of {length} bytes is too long, or cut off")
    return data[at : at + length], at + length


def _fields(header: bytes, place: int) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    at = 0
    while at < len(header):
        text, at = _span(header, at, place, MAX_HEADER_BYTES)
        name, separator, value = text.partition(b"=")
        if not separator:
            raise ValueError(f"byte {place}: a field of a record has no value")
        fields[name] = value
    return fields


@dataclass(frozen=True, slots=True)
class Ros1Storage:
    """The `BagStorage` of a bag of ROS 1. A place is: offset of the chunk (-1 outside chunks), offset in it, length,
    number of the translation."""

    path: Path

    def entries(self) -> Iterator[BagMessage]:
        """See `BagStorage`. Messages of types that are no longer in ROS 2 are left out."""
        connections: dict[int, tuple[str, int]] = {}
        try:
            with self.path.open("rb") as stream:
                index = _index_of(stream)
                left = MAX_CHUNK_BYTES + MAX_RATIO * self.path.stat().st_size
                begin = stream.tell()
                while True:
                    number = bisect.bisect_right(index.chunks_at, begin)
                    next_at = index.chunks_at[number] if number < len(index.chunks_at) else None
                    try:
                        record = _next(stream, next_at)
                        if record is None:
                            return
                        if record.operation != _CHUNK:
                            yield from self._entry(record, _NO_CHUNK, connections)
                        else:
                            chunk = _unpacked(record)
                            left -= len(chunk)
                            for inner in _records(chunk if left >= 0 else b"", record.at):
                                yield from self._entry(inner, begin, connections)
                    except ValueError as error:
                        if next_at is None:
                            raise
                        stream.seek(next_at)
                        yield BagMessage.damaged(begin, self._damage(error))
                        for record in index.connections:
                            yield from self._entry(record, _NO_CHUNK, connections)
                    if left < 0:
                        raise ValueError(f"byte {begin}: the file unpacks to more than {MAX_RATIO} times its size")
                    begin = stream.tell()
        except OSError as error:
            raise SourceError(f"cannot read {self.path}: {error.strerror}") from error
        except ValueError as error:
            raise self._damage(error) from error

    def _damage(self, error: ValueError) -> SourceError:
        return SourceError(f"{self.path} is damaged: {error}. `rosbag reindex` saves what is whole")

    def _entry(self, record: _Record, chunk_at: int, connections: dict[int, tuple[str, int]]) -> Iterator[BagMessage]:
        if record.operation == _CONNECTION and len(record.data) <= MAX_CONNECTION_BYTES:
            topic, number = _connection(record)
            if number is not None and len(connections) < MAX_TOPICS:
                connections[record.number(b"conn")] = topic, number
        elif record.operation == _MESSAGE and record.number(b"conn") in connections:
            topic, number = connections[record.number(b"conn")]
            stamp = record.fields.get(b"time", b"")
            if len(stamp) != 8:
                raise ValueError(f"byte {record.at}: a message has no valid time")
            seconds, nanoseconds = struct.unpack("<II", stamp)
            place = (chunk_at, record.at, len(record.data), number)
            logged_ns = seconds * 10**9 + nanoseconds
            where = f"{self.path}: a message on {topic}"
            yield translated_message(number, record.data, where, topic, logged_ns, place)

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """See `BagStorage`."""
        with self.path.open("rb") as stream:
            yield _Ros1Reader(self.path, stream).read


def _connection(record: _Record) -> tuple[str, int | None]:
    """The topic of a connection, and the number of the translation of its messages."""
    topic = record.fields.get(b"topic", b"").decode(errors="replace")
    described = _fields(record.data, record.at)
    schema = described.get(b"type", b"").decode(errors="replace")
    if not topic or len(topic) > MAX_NAME or len(schema) > MAX_NAME:
        raise ValueError(f"byte {record.at}: a connection has no valid topic or type")
    return topic, translation_of("ros1", schema)


@dataclass(frozen=True, slots=True)
class _Index:
    """What the end of a file repeats: where chunks begin, and where the index itself does, ascending; connections."""

    chunks_at: tuple[int, ...] = ()
    connections: tuple[_Record, ...] = ()


def _index_of(stream: BinaryIO) -> _Index:
    """The index of a file, which is then positioned behind its magic; empty without a sound one."""
    if stream.read(len(MAGIC)) != MAGIC:
        raise SourceError(f"{stream.name} is no bag of ROS 1 (version 2.0): byte 0: it does not begin as one does")
    chunks_at: list[int] = []
    connections: list[_Record] = []
    with suppress(ValueError):
        head = _next(stream, None)
        if head is not None and (index_at := head.offset(b"index_pos")):
            stream.seek(index_at)
            chunks_at.append(index_at)
            while (record := _next(stream, None)) is not None:
                if record.operation == _CONNECTION and len(connections) < MAX_TOPICS:
                    connections.append(record)
                elif record.operation == _CHUNK_INFO:
                    chunks_at.append(record.offset(b"chunk_pos"))
    stream.seek(len(MAGIC))
    return _Index(tuple(sorted(chunks_at)) if len(chunks_at) > 1 else (), tuple(connections))


def _next(stream: BinaryIO, end_at: int | None) -> _Record | None:
    """The next record of a file, which ends at `end_at` at the latest; None at the end of the file."""
    length = stream.read(_LENGTH.size)
    if not length:
        return None
    header = _read(stream, length, MAX_HEADER_BYTES, end_at)
    at = stream.tell() + _LENGTH.size
    return _Record(_fields(header, at), _read(stream, stream.read(_LENGTH.size), MAX_CHUNK_BYTES, end_at), at)


def _read(stream: BinaryIO, length: bytes, most: int, end_at: int | None) -> bytes:
    if len(length) != _LENGTH.size:
        raise ValueError(f"byte {stream.tell()}: the file is cut off")
    (size,) = _LENGTH.unpack(length)
    if size > most or (end_at is not None and stream.tell() + size > end_at):
        raise ValueError(f"byte {stream.tell()}: a record of {size} bytes is too long")
    data = stream.read(size)
    if len(data) != size:
        raise ValueError(f"byte {stream.tell()}: the file is cut off ({size - len(data)} bytes are missing)")
    return data


def _unpacked(record: _Record) -> bytes:
    """The records in a chunk."""
    size, compression = record.number(b"size"), record.fields.get(b"compression", b"none")
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"byte {record.at}: a chunk would unpack to {size} bytes, the limit is {MAX_CHUNK_BYTES}")
    try:
        match compression:
            case b"none":
                data = record.data
            case b"bz2":
                data = bz2.BZ2Decompressor().decompress(record.data, max_length=size + 1)
            case b"lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(record.data, max_length=size + 1)
            case _:
                raise ValueError(f"byte {record.at}: a chunk has a compression that is neither bz2 nor lz4")
    except (OSError, RuntimeError, EOFError) as error:
        raise ValueError(f"byte {record.at}: a chunk cannot be unpacked") from error
    if len(data) != size:
        raise ValueError(f"byte {record.at}: the size of a chunk does not agree")
    return data


@dataclass(slots=True)
class _Ros1Reader:
    """Reads messages again. It keeps the last unpacked chunk, so that reading in order unpacks each chunk once."""

    path: Path
    stream: BinaryIO
    chunk_at: int = _NO_CHUNK
    chunk: bytes = field(default=b"", repr=False)

    def read(self, place: tuple[int, ...]) -> bytes:
        """See `BagReader`."""
        chunk_at, at, length, number = place
        if chunk_at == _NO_CHUNK:
            self.stream.seek(at)
            data = self.stream.read(length)
        else:
            if chunk_at != self.chunk_at:
                self.chunk, self.chunk_at = self._chunk(chunk_at), chunk_at
            data = self.chunk[at : at + length]
        return translated(number, data, f"{self.path}: a message")

    def _chunk(self, chunk_at: int) -> bytes:
        self.stream.seek(chunk_at)
        try:
            record = _next(self.stream, None)
            return b"" if record is None else _unpacked(record)
        except ValueError as error:
            raise SourceError(f"{self.path}: the file has changed: {error}") from error


def open_storage(path: Path) -> BagStorage:
    """The storage of an `.mcap` or `.db3` file, or of a folder with rosbag2's `metadata.yaml`.

    Raises:
        SourceError: the path is none of them; the message lists what would be.
    """
    if path.is_dir():
        return open_folder(path)
    match path.suffix:
        case ".mcap":
            return McapStorage(path)
        case ".db3":
            return SqliteStorage(path)
        case ".bag":
            return Ros1Storage(path)
        case _:
            raise SourceError(f"{path} is no bag: .mcap, .db3, .bag, or a folder of them")


METADATA = "metadata.yaml"

MAX_FILES = 10_000
"""Most files of one bag: a day in files of ten seconds."""

# --- folders ----------------------------------------------------------------------------------------------------------

MAX_UNPACKED_MESSAGE_BYTES = 256 * 2**20
"""Largest unpacked size of one packed message, bytes; the same as for MCAP's chunks."""

MIN_FREE_BYTES = 2**30
"""Bytes that stay free on the disk of temporary files. A packed file that would leave less is refused."""

_COPY_BYTES = 2**20


class BagInformation(BaseModel):
    """The used fields of `rosbag2_bagfile_information`, versions 1 to 9; others are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    storage_identifier: str = Field(max_length=64)
    relative_file_paths: tuple[str, ...] = Field(min_length=1, max_length=MAX_FILES)
    compression_format: str = ""
    compression_mode: str = ""


@dataclass(frozen=True, slots=True, weakref_slot=True)
class FolderStorage:
    """The `BagStorage` of a folder. A place is: number of the file, place in that file.

    Attributes:
        packed_messages: whether each message is a zstd frame (`compression_mode: MESSAGE`).
    """

    path: Path
    files: tuple[BagStorage, ...]
    packed_messages: bool

    def entries(self) -> Iterator[BagMessage]:
        """See `BagStorage`."""
        for number, file in enumerate(self.files):
            left = MAX_UNPACKED_MESSAGE_BYTES
            for entry in file.entries():
                error, data = entry.error, b""
                try:
                    data = self.plain(entry.data) if error is None else b""
                except SourceError as refused:
                    error = refused
                left += MAX_RATIO * len(entry.data) - len(data)
                if left < 0:
                    raise SourceError(f"{file.path} unpacks to more than {MAX_RATIO} times its size")
                yield replace(entry, data=data, place=(number, *entry.place), error=error)

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """See `BagStorage`."""
        with ExitStack() as opened:
            yield _FolderReader(self, opened, {}).read

    def plain(self, data: bytes) -> bytes:
        """A message as it was before it was packed."""
        if not self.packed_messages:
            return data
        try:
            if zstandard.get_frame_parameters(data).content_size > MAX_UNPACKED_MESSAGE_BYTES:
                raise SourceError(
                    f"{self.path}: a message does not state that it unpacks to at most "
                    f"{MAX_UNPACKED_MESSAGE_BYTES} bytes"
                )
            unpacker = zstandard.ZstdDecompressor(max_window_size=mcap_reader.MAX_ZSTD_WINDOW)
            return unpacker.decompress(data, max_output_size=MAX_UNPACKED_MESSAGE_BYTES)
        except zstandard.ZstdError as error:
            raise SourceError(f"{self.path} is damaged: a message is no zstd frame: {error}") from error


@dataclass(frozen=True, slots=True)
class _FolderReader:
    """Keeps only the file open that was read last, because a bag may have more files than a process may open."""

    folder: FolderStorage
    opened: ExitStack
    current: dict[int, BagReader]

    def read(self, place: tuple[int, ...]) -> bytes:
        """See `BagReader`."""
        number, *rest = place
        if number not in self.current:
            self.opened.close()
            self.current.clear()
            self.current[number] = self.opened.enter_context(self.folder.files[number].open())
        return self.folder.plain(self.current[number](tuple(rest)))


def open_folder(path: Path) -> FolderStorage:
    """Opens the bag in a folder: the files that its `metadata.yaml` names; without one, or if it names none of them (a
    folder that was renamed), all files of a bag in the order of their numbers.

    Raises:
        SourceError: `metadata.yaml` cannot be used, or a file is absent; names it.
    """
    if not (path / METADATA).is_file():
        files = files_of_bag(path)
        if any(file.suffix == ".mcap" and is_window(file) for file in files[:1]):
            raise SourceError(f"{path} holds recorded windows, each a recording of its own: give one, as {files[0]}")
        return FolderStorage(path, tuple(map(open_storage, files)), packed_messages=False)
    information = _information(path)
    mode = information.compression_mode.upper() if information.compression_format else ""
    if mode and information.compression_format != "zstd":
        raise SourceError(f"{path / METADATA}: compression {information.compression_format!a} is not zstd")
    # Only the file's name counts: a bag must not reach outside its folder, and old versions wrote the folder in front.
    names = [path / Path(name).name for name in information.relative_file_paths]
    if len(set(names)) < len(names):
        raise SourceError(f"{path / METADATA} names a file twice")
    if mode != "FILE":
        present = names if any(name.is_file() for name in names) else files_of_bag(path) or names
        return FolderStorage(path, _files(path, information, present), mode == "MESSAGE")
    unpacked = Path(tempfile.mkdtemp(prefix="coec-bag-"))
    try:
        plain = [_unpacked_file(file, unpacked) for file in names]
        storage = FolderStorage(path, _files(path, information, plain), packed_messages=False)
    except BaseException:
        shutil.rmtree(unpacked, ignore_errors=True)
        raise
    weakref.finalize(storage, shutil.rmtree, unpacked, ignore_errors=True)
    return storage


def files_of_bag(path: Path) -> list[Path]:
    """The files of bags in a folder, in the order of the numbers in their names; all of one kind, of which there are
    most."""
    files = [file for file in path.iterdir() if file.suffix in BAG_SUFFIXES and file.is_file()]
    if len(files) > MAX_FILES:
        raise SourceError(f"{path} has more than {MAX_FILES} files")
    kinds = Counter(file.suffix for file in sorted(files))
    kind = kinds.most_common(1)[0][0] if kinds else ""
    return sorted((file for file in files if file.suffix == kind), key=_numbered)


def _numbered(file: Path) -> tuple[tuple[int, str], ...]:
    """A key by which `bag_10` comes after `bag_9`."""
    parts = re.split(r"(\d{1,18})", file.name)
    return tuple((int(part), "") if part.isdecimal() and part.isascii() else (-1, part) for part in parts)


def _files(path: Path, information: BagInformation, names: Sequence[Path]) -> tuple[BagStorage, ...]:
    """The files of a bag, by their suffix; without one, by the storage that the metadata names. `ros2 bag reindex` of
    Humble leaves that out."""
    kinds: dict[str, type[McapStorage | SqliteStorage]] = {"mcap": McapStorage, "sqlite3": SqliteStorage}
    kind = kinds.get(information.storage_identifier)
    if kind is None and any(name.suffix not in BAG_SUFFIXES for name in names):
        identifier = information.storage_identifier
        raise SourceError(f"{path / METADATA}: storage {identifier!a} is neither mcap nor sqlite3")
    for name in names:
        if not name.is_file():
            raise SourceError(f"{path} lacks {name.name}, which its {METADATA} names")
    return tuple(open_storage(name) if kind is None or name.suffix in BAG_SUFFIXES else kind(name) for name in names)


def _information(path: Path) -> BagInformation:
    file = path / METADATA
    if not file.is_file():
        raise SourceError(f"{path} has no {METADATA}; `ros2 bag reindex {path}` writes one")
    try:
        document: Any = load_yaml(file)
        return BagInformation.model_validate(document["rosbag2_bagfile_information"])
    except ConfigError as error:
        raise SourceError(str(error)) from error
    except ValidationError as error:
        raise SourceError(f"{file}: {describe(error)}") from error
    except (KeyError, TypeError) as error:
        raise SourceError(f"{file} is no metadata of rosbag2") from error


def _unpacked_file(file: Path, folder: Path) -> Path:
    """A packed file (`name.mcap.zstd`), unpacked (`name.mcap`)."""
    target = folder / file.name.removesuffix(".zstd")
    unpacker = zstandard.ZstdDecompressor(max_window_size=mcap_reader.MAX_ZSTD_WINDOW)
    try:
        with file.open("rb") as packed, target.open("wb") as plain:
            left = MAX_UNPACKED_MESSAGE_BYTES + MAX_RATIO * file.stat().st_size
            for block in unpacker.read_to_iter(packed, write_size=_COPY_BYTES):
                left -= len(block)
                if left < 0:
                    raise SourceError(f"{file} unpacks to more than {MAX_RATIO} times its size")
                if shutil.disk_usage(folder).free < MIN_FREE_BYTES:
                    raise SourceError(f"{file} unpacks to more than {folder.parent} has room for")
                plain.write(block)
    except FileNotFoundError as error:
        raise SourceError(f"{file} does not exist") from error
    except OSError as error:
        raise SourceError(f"cannot unpack {file}: {error.strerror}") from error
    except zstandard.ZstdError as error:
        raise SourceError(f"{file} is damaged: {error}") from error
    return target
