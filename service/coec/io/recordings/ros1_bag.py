"""Bags of ROS 1 (`.bag`, format 2.0: wiki.ros.org/Bags/Format/2.0) as bags of ROS 2. Records are read one after the
other, so that a bag without index (`.bag.active`) reads like another one. Sizes are checked before they are used;
`rosbags` reads bags that it trusts.
"""

import bz2
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final

import lz4.frame

from coec.errors import SourceError
from coec.io.mcap.reader import MAX_CHUNK_BYTES, MAX_RATIO
from coec.io.recordings.bag_storage import MAX_NAME, MAX_TOPICS, BagMessage, BagReader, translated, translated_if_read
from coec.io.ros.translations import TRANSLATIONS, translation_of

MAGIC: Final = b"#ROSBAG V2.0\n"

MAX_HEADER_BYTES: Final = 1 << 20
"""Longest header of a record. A connection's has its topic; the definition of its messages is in the data."""

MAX_CONNECTION_BYTES: Final = 1 << 24
"""Longest data of a connection: the definition of a message has some 10 kB."""

_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
"""Operations of records; others repeat what these say."""

_NO_CHUNK: Final = -1

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
    """The `Storage` of a bag of ROS 1. A place is: offset of the chunk (-1 outside chunks), offset in it, length,
    number of the translation."""

    path: Path

    def entries(self) -> Iterator[BagMessage]:
        """See `Storage`. Messages of types that are no longer in ROS 2 are left out."""
        connections: dict[int, tuple[str, int]] = {}
        try:
            with self.path.open("rb") as stream:
                left = MAX_CHUNK_BYTES + MAX_RATIO * self.path.stat().st_size
                for record, begin in _of_file(stream):
                    if record.operation != _CHUNK:
                        yield from self._entry(record, _NO_CHUNK, connections)
                        continue
                    chunk = _unpacked(record)
                    left -= len(chunk)
                    if left < 0:
                        raise ValueError(f"byte {record.at}: the file unpacks to more than {MAX_RATIO} times its size")
                    for inner in _records(chunk, record.at):
                        yield from self._entry(inner, begin, connections)
        except OSError as error:
            raise SourceError(f"cannot read {self.path}: {error.strerror}") from error
        except ValueError as error:
            raise SourceError(f"{self.path} is damaged: {error}. `rosbag reindex` saves what is whole") from error

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
            data = translated_if_read(number, record.data, f"{self.path}: a message on {topic}")
            logged_ns = seconds * 10**9 + nanoseconds
            yield BagMessage(topic, TRANSLATIONS[number].type_name, data, logged_ns, place)

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """See `Storage`."""
        with self.path.open("rb") as stream:
            yield _Ros1Reader(self.path, stream)


def _connection(record: _Record) -> tuple[str, int | None]:
    """The topic of a connection, and the number of the translation of its messages."""
    topic = record.fields.get(b"topic", b"").decode(errors="replace")
    described = _fields(record.data, record.at)
    schema = described.get(b"type", b"").decode(errors="replace")
    if not topic or len(topic) > MAX_NAME or len(schema) > MAX_NAME:
        raise ValueError(f"byte {record.at}: a connection has no valid topic or type")
    return topic, translation_of("ros1", schema)


def _of_file(stream: BinaryIO) -> Iterator[tuple[_Record, int]]:
    """The records of a file, each with the byte at which it begins."""
    if stream.read(len(MAGIC)) != MAGIC:
        raise ValueError("byte 0: it does not begin as a bag of ROS 1 (version 2.0) does")
    begin = stream.tell()
    while (record := _next(stream)) is not None:
        yield record, begin
        begin = stream.tell()


def _next(stream: BinaryIO) -> _Record | None:
    """The next record of a file; None at its end."""
    length = stream.read(_LENGTH.size)
    if not length:
        return None
    header = _read(stream, length, MAX_HEADER_BYTES)
    at = stream.tell() + _LENGTH.size
    return _Record(_fields(header, at), _read(stream, stream.read(_LENGTH.size), MAX_CHUNK_BYTES), at)


def _read(stream: BinaryIO, length: bytes, most: int) -> bytes:
    if len(length) != _LENGTH.size:
        raise ValueError(f"byte {stream.tell()}: the file is cut off")
    (size,) = _LENGTH.unpack(length)
    if size > most:
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
        """See `Reader`."""
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
            record = _next(self.stream)
            return b"" if record is None else _unpacked(record)
        except ValueError as error:
            raise SourceError(f"{self.path}: the file has changed: {error}") from error
