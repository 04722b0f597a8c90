"""A reader for untrusted MCAP: every length is checked before it is used, and every CRC in the file is verified.

The readers of the `mcap` package return short reads as if they were whole, and unpack whatever a chunk promises (a 9.8
kB file can become 600 MB). So this module parses the records itself (MCAP specification, "Records").
"""

import bisect
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from coec.errors import CoecError

MAGIC = b"\x89MCAP0\r\n"

MAX_CHUNK_BYTES = 256 * 2**20
"""Largest unpacked size of one chunk. Writers use 0.75 to 4 MiB plus at most one message, and messages have up to some
32 MiB."""

MAX_RATIO = 1000
"""Largest ratio of unpacked to packed bytes of a whole recording, apart from one chunk; JPEG images and clouds have 1
to 20."""

MAX_ZSTD_WINDOW = 2**27
"""128 MiB, the default limit of the zstd tool; it bounds the memory of a decompression."""

_PREFIX = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQ")
_ATTACHMENT_INDEX = struct.Struct("<QQQQQ")
_FOOTER = struct.Struct("<QQI")
_TAIL_BYTES = _PREFIX.size + _FOOTER.size + len(MAGIC)


class McapDamagedError(CoecError):
    """The file is not MCAP, is cut off, or a CRC is wrong; the message begins with the offset of the byte.

    Attributes:
        is_mcap: whether the file begins like MCAP, so that parts of it may be whole.
    """

    def __init__(self, message: str, *, is_mcap: bool = True) -> None:
        super().__init__(message)
        self.is_mcap = is_mcap

    def of(self, path: Path) -> str:
        """The error message for a recording, with the path and what helps."""
        if not self.is_mcap:
            return f"{path} is no MCAP file: {self}"
        return f"{path} is damaged: {self}. `mcap recover` saves what is whole"


def _no_mcap() -> McapDamagedError:
    return McapDamagedError("byte 0: it does not begin as one does", is_mcap=False)


@dataclass(frozen=True, slots=True)
class Schema:
    """How the messages of a channel are laid out."""

    schema_id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic."""

    channel_id: int
    schema_id: int
    topic: str
    message_encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class McapMessage:
    """A message and its place: `chunk_at` is the file offset of its chunk record (None outside of chunks), `at` the
    offset of its data within the unpacked chunk (or within the file)."""

    channel_id: int
    sequence: int
    log_time_ns: int
    data: bytes
    chunk_at: int | None
    at: int


@dataclass(frozen=True, slots=True)
class McapAttachment:
    """A file within the file."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Metadata:
    """Named key-value pairs."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True, slots=True)
class DamagedRecord:
    """A record that was left out; the error begins with the offset of its byte."""

    at: int
    error: McapDamagedError


Record = Schema | Channel | McapMessage | McapAttachment | Metadata | DamagedRecord


def read_records(
    stream: BinaryIO, *, max_unpacked_bytes: int | None = None, skip_damaged: bool = False
) -> Iterator[Record]:
    """The records of the data section in the order of the file, including those in chunks.

    Records yielded before an error are sound, which salvaging a cut file relies on. Only a file that is read to the end
    is known to be whole.

    Args:
        stream: positioned at the start of the file, seekable.
        max_unpacked_bytes: bound on all chunks together, for readers that keep what they are given.
        skip_damaged: a damaged record in the middle gives a `DamagedRecord`; the next one that the index at the end of
            the file names is read, with the channels that the index repeats.

    Raises:
        McapDamaged: not MCAP, cut off, a wrong CRC or length, or a chunk that would unpack to more than
            `MAX_CHUNK_BYTES`.
    """
    size = _size(stream)
    if _read(stream, len(MAGIC), 0, size) != MAGIC:
        raise _no_mcap()
    index = _SummaryIndex.of(stream, size) if skip_damaged else _SummaryIndex()
    crc: int | None = zlib.crc32(MAGIC)
    unpacked = 0
    at = len(MAGIC)
    while True:
        begin, next_at = at, index.next_after(at)
        stream.seek(at)
        try:
            prefix = _read(stream, _PREFIX.size, at, size)
            opcode, length = _PREFIX.unpack(prefix)
            body_at = at + _PREFIX.size
            if opcode == Opcode.FOOTER:
                raise McapDamagedError(f"byte {at}: the data section has no end")
            if next_at is not None and (body_at + length > next_at or opcode == Opcode.DATA_END):
                raise McapDamagedError(f"byte {at}: a record reaches beyond the begin of the next chunk")
            if begin in index.chunks_at and opcode != Opcode.CHUNK:
                raise McapDamagedError(f"byte {at}: the chunk that the index names is none")
            body = _read(stream, length, body_at, size)
            at = body_at + length
            if opcode == Opcode.DATA_END:
                break
            crc = None if crc is None else zlib.crc32(body, zlib.crc32(prefix, crc))
            if opcode != Opcode.CHUNK:
                yield from _parse(opcode, memoryview(body), body_at, None)
                continue
            chunk = _unpack_chunk(body, body_at)
            unpacked += len(chunk)
            if max_unpacked_bytes is None or unpacked <= max_unpacked_bytes:
                yield from _chunk_records(chunk, begin)
                continue
        except McapDamagedError as error:
            if not skip_damaged or (at == begin and next_at is None):
                raise
            crc, at = None, next_at if at == begin and next_at is not None else at
            yield DamagedRecord(begin, error)
            yield from index.channels
        else:
            raise McapDamagedError(f"byte {begin}: the file unpacks to more than {max_unpacked_bytes} bytes")
    # What follows is a summary that begins right here (or none), a footer, and nothing else.
    expected, (_, summary_at) = _Cursor(body, body_at).unpack(struct.Struct("<I"))[0], _summary(stream, size)
    if summary_at != at:
        raise McapDamagedError(f"byte {at}: {summary_at - at} bytes between the data and the summary belong to neither")
    if crc is not None and expected not in (0, crc):
        disagreement = McapDamagedError(f"byte {begin}: the CRC of the data section does not agree")
        if not skip_damaged:
            raise disagreement
        yield DamagedRecord(begin, disagreement)


@dataclass(frozen=True, slots=True)
class _SummaryIndex:
    """What the summary repeats of the data: where chunks begin, ascending, and the data ends; schemas and channels."""

    chunks_at: tuple[int, ...] = ()
    data_end_at: int = 0
    channels: tuple[Record, ...] = ()

    @classmethod
    def of(cls, stream: BinaryIO, size: int) -> "_SummaryIndex":
        """From the end of the file; empty if it has no sound summary."""
        chunks_at: list[int] = []
        channels: list[Record] = []
        try:
            summary, summary_at = _summary(stream, size)
            cursor = _Cursor(summary, summary_at)
            while cursor.left:
                opcode, length = cursor.unpack(_PREFIX)
                body, at = cursor.take(length), cursor.at - length
                if opcode == Opcode.CHUNK_INDEX:
                    chunks_at.append(_Cursor(body, at).unpack(_CHUNK_INDEX)[2])
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    channels += _parse(opcode, body, at, None)
        except McapDamagedError:
            return cls()
        data_end_at = summary_at - _PREFIX.size - 4
        return cls(tuple(sorted(at for at in chunks_at if at < data_end_at)), data_end_at, tuple(channels))

    def next_after(self, at: int) -> int | None:
        """Where the next chunk behind a byte begins, or the data ends; None if the index names no chunk."""
        number = bisect.bisect_right(self.chunks_at, at)
        if number < len(self.chunks_at):
            return self.chunks_at[number]
        return self.data_end_at if self.chunks_at and at < self.data_end_at else None


class MessageReader:
    """Reads messages again by their place. It keeps the last unpacked chunk, so that reading in order unpacks each
    chunk once."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._size = _size(stream)
        self._chunk_at: int | None = None
        self._chunk = memoryview(b"")

    def read(self, chunk_at: int | None, at: int, length: int) -> bytes:
        """The data of the message that `read_records` found at this place.

        Raises:
            McapDamaged: the file has changed.
        """
        if chunk_at is None:
            self._stream.seek(at)
            return _read(self._stream, length, at, self._size)
        if chunk_at != self._chunk_at:
            self._stream.seek(chunk_at)
            opcode, span = _PREFIX.unpack(_read(self._stream, _PREFIX.size, chunk_at, self._size))
            if opcode != Opcode.CHUNK:
                raise McapDamagedError(f"byte {chunk_at}: the chunk is missing: the file has changed")
            body_at = chunk_at + _PREFIX.size
            self._chunk = _unpack_chunk(_read(self._stream, span, body_at, self._size), body_at)
            self._chunk_at = chunk_at
        return bytes(self._chunk[at : at + length])


def read_metadata(path: Path, name: str) -> dict[str, str]:
    """The metadata with a name that come before the first message; empty if there are none.

    Raises:
        McapDamaged: the file is damaged at its beginning.
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        for record in read_records(stream):
            match record:
                case Metadata() if record.name == name:
                    return record.values
                case McapMessage():
                    break
    return {}


def read_attachment(path: Path, name: str) -> bytes | None:
    """The last attachment with a name, found by the index at the end of the file; None if there is none.

    Raises:
        McapDamaged: the file is cut off, or the index or the attachment is damaged.
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        size = _size(stream)
        summary, summary_at = _summary(stream, size)
        location: tuple[int, int] | None = None
        cursor = _Cursor(summary, summary_at)
        while cursor.left:
            opcode, length = cursor.unpack(_PREFIX)
            body = _Cursor(cursor.take(length), cursor.at - length)
            if opcode == Opcode.ATTACHMENT_INDEX:
                at, span, *_ = body.unpack(_ATTACHMENT_INDEX)
                if body.text() == name:
                    location = at, span
        if location is None:
            return None
        at, span = location
        stream.seek(min(at, size))
        record = _read(stream, span, at, size)
        cursor = _Cursor(record, at)
        opcode, length = cursor.unpack(_PREFIX)
        if opcode != Opcode.ATTACHMENT or length != cursor.left:
            raise McapDamagedError(f"byte {at}: the index points to something that is not an attachment")
        return _attachment(cursor.take(length), at + _PREFIX.size).data


# --- the end of the file ------------------------------------------------------------------------------------


def _summary(stream: BinaryIO, size: int) -> tuple[bytes, int]:
    """The summary section, with verified CRC, and where it begins; empty if there is none."""
    if size < len(MAGIC) + _TAIL_BYTES:
        if size == 0:
            raise McapDamagedError("it is empty", is_mcap=False)
        raise McapDamagedError(f"byte {size}: the file is cut off")
    stream.seek(0)
    if _read(stream, len(MAGIC), 0, size) != MAGIC:
        raise _no_mcap()
    footer_at = size - _TAIL_BYTES
    stream.seek(footer_at)
    tail = _read(stream, _TAIL_BYTES, footer_at, size)
    opcode, length = _PREFIX.unpack_from(tail)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size) or tail[-len(MAGIC) :] != MAGIC:
        raise McapDamagedError(f"byte {size}: the file is cut off (it does not end as MCAP ends)")
    summary_at, _, expected = _FOOTER.unpack_from(tail, _PREFIX.size)
    if summary_at == 0:
        return b"", footer_at
    if not len(MAGIC) <= summary_at <= footer_at:
        raise McapDamagedError(f"byte {footer_at}: the footer points outside the file")
    stream.seek(summary_at)
    summary = _read(stream, footer_at - summary_at, summary_at, size)
    if expected not in (0, zlib.crc32(tail[: _PREFIX.size + _FOOTER.size - 4], zlib.crc32(summary))):
        raise McapDamagedError(f"byte {summary_at}: the CRC of the summary does not agree")
    return summary, summary_at


# --- records ------------------------------------------------------------------------------------------------


def _chunk_records(chunk: memoryview, chunk_at: int) -> Iterator[Record]:
    at = 0
    while at < len(chunk):
        if at + _PREFIX.size > len(chunk):
            raise McapDamagedError(f"byte {chunk_at}: a record of this chunk is cut at its end")
        opcode, length = _PREFIX.unpack_from(chunk, at)
        at += _PREFIX.size
        if at + length > len(chunk):
            raise McapDamagedError(f"byte {chunk_at}: a record of this chunk is cut at its end")
        yield from _parse(opcode, chunk[at : at + length], at, chunk_at)
        at += length


def _parse(opcode: int, body: memoryview, at: int, chunk_at: int | None) -> Iterator[Record]:
    """Yields the record, or nothing for records that only repeat others (indexes, statistics)."""
    cursor = _Cursor(body, at if chunk_at is None else chunk_at)
    match opcode:
        case Opcode.MESSAGE:
            channel_id, sequence, log_time_ns, _ = cursor.unpack(_MESSAGE)
            data = bytes(body[_MESSAGE.size :])
            yield McapMessage(channel_id, sequence, log_time_ns, data, chunk_at, at + _MESSAGE.size)
        case Opcode.SCHEMA:
            (schema_id,) = cursor.unpack(struct.Struct("<H"))
            yield Schema(schema_id, cursor.text(), cursor.text(), bytes(cursor.blob("<I")))
        case Opcode.CHANNEL:
            channel_id, schema_id = cursor.unpack(struct.Struct("<HH"))
            yield Channel(channel_id, schema_id, cursor.text(), cursor.text(), cursor.pairs())
        case Opcode.ATTACHMENT:
            yield _attachment(body, at)
        case Opcode.METADATA:
            yield Metadata(cursor.text(), cursor.pairs())


def _attachment(body: memoryview, at: int) -> McapAttachment:
    cursor = _Cursor(body, at)
    cursor.take(16)  # log time, create time
    attachment = McapAttachment(cursor.text(), cursor.text(), bytes(cursor.blob("<Q")))
    (expected,) = cursor.unpack(struct.Struct("<I"))
    if expected not in (0, zlib.crc32(body[:-4])):
        raise McapDamagedError(f"byte {at}: the CRC of an attachment does not agree")
    return attachment


def _unpack_chunk(body: bytes, at: int) -> memoryview:
    cursor = _Cursor(body, at)
    _, _, promised, expected = cursor.unpack(_CHUNK)
    compression, packed = cursor.text(), cursor.blob("<Q")
    data: bytes | memoryview
    if promised > MAX_CHUNK_BYTES:
        raise McapDamagedError(f"byte {at}: a chunk would unpack to {promised} bytes, the limit is {MAX_CHUNK_BYTES}")
    try:
        match compression:
            case "":
                data = packed
            case "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=promised + 1)
            case "zstd":
                # `decompress` trusts the size in the frame; the stream reader unpacks no more than requested.
                reader = zstandard.ZstdDecompressor(max_window_size=MAX_ZSTD_WINDOW).stream_reader(
                    packed, read_across_frames=True
                )
                data = reader.read(promised + 1)
            case _:
                raise McapDamagedError(f"byte {at}: a chunk has a compression that is neither lz4 nor zstd")
    except (RuntimeError, zstandard.ZstdError) as error:
        raise McapDamagedError(f"byte {at}: a chunk cannot be unpacked") from error
    if len(data) != promised or (expected and zlib.crc32(data) != expected):
        raise McapDamagedError(f"byte {at}: size or CRC of a chunk does not agree")
    return memoryview(data)


def _size(stream: BinaryIO) -> int:
    at = stream.tell()
    size = stream.seek(0, 2)
    stream.seek(at)
    return size


def _read(stream: BinaryIO, count: int, at: int, size: int) -> bytes:
    """Exactly `count` bytes; checks that they exist before allocating memory."""
    if at + count > size:
        raise McapDamagedError(f"byte {size}: the file is cut off ({at + count - size} bytes are missing here)")
    data = stream.read(count)
    if len(data) != count:
        raise McapDamagedError(f"byte {at + len(data)}: the file is cut off")
    return data


class _Cursor:
    """Walks through a record and checks every step against its end. It copies nothing."""

    def __init__(self, body: bytes | memoryview, at: int) -> None:
        self._body = memoryview(body)
        self._start = at
        self._offset = 0

    @property
    def at(self) -> int:
        """File offset of the next byte."""
        return self._start + self._offset

    @property
    def left(self) -> int:
        """Remaining bytes."""
        return len(self._body) - self._offset

    def take(self, count: int) -> memoryview:
        """The next `count` bytes."""
        if count > self.left:
            raise McapDamagedError(f"byte {self._start}: a length within a record passes its end")
        self._offset += count
        return self._body[self._offset - count : self._offset]

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        """The next integers."""
        return layout.unpack(self.take(layout.size))

    def blob(self, length: str) -> memoryview:
        """The next bytes, preceded by their length."""
        (count,) = self.unpack(struct.Struct(length))
        return self.take(count)

    def text(self) -> str:
        """The next text, UTF-8 preceded by its length in 32 bits."""
        try:
            return str(self.blob("<I"), "utf-8")
        except UnicodeDecodeError as error:
            raise McapDamagedError(f"byte {self._start}: a name is not UTF-8") from error

    def pairs(self) -> dict[str, str]:
        """The next keys and values, preceded by their total length."""
        inside, values = _Cursor(self.blob("<I"), self._start), dict[str, str]()
        while inside.left:
            key = inside.text()
            values[key] = inside.text()
        return values
