"""An MCAP writer that decides for each chunk whether to compress it: clouds shrink, encoded images do not.

The writer of the `mcap` package compresses either all chunks of a file or none, and copies each message three times. So
messages and chunks are written here; the other records are those of the package (MCAP specification, "Records").
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO

import lz4.frame
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from coec import __version__
from coec.adapters.mcap.files import MAGIC, Schema

PROFILE = "ros2"

LIBRARY = f"coec/{__version__}"

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
