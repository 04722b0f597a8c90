"""Bags that are MCAP files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from coec.adapters.mcap.files import (
    MAX_CHUNK_BYTES,
    MAX_RATIO,
    Channel,
    McapDamagedError,
    McapMessage,
    MessageReader,
    Schema,
    read_records,
)
from coec.errors import SourceError
from coec.sources.bag.storage import BagMessage, BagReader

_NO_CHUNK = -1


@dataclass(frozen=True, slots=True)
class McapStorage:
    """The `Storage` of an MCAP file. A place is: file offset of the chunk (-1 outside chunks), offset in the chunk,
    length."""

    path: Path

    def entries(self) -> Iterator[BagMessage]:
        """See `Storage`."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        try:
            with self.path.open("rb") as stream:
                limit = MAX_CHUNK_BYTES + MAX_RATIO * self.path.stat().st_size
                for record in read_records(stream, max_unpacked_bytes=limit):
                    match record:
                        case Schema():
                            schemas[record.schema_id] = record
                        case Channel():
                            channels[record.channel_id] = record
                        case McapMessage():
                            channel = channels.get(record.channel_id)
                            schema = None if channel is None else schemas.get(channel.schema_id)
                            if channel is not None and schema is not None and channel.message_encoding == "cdr":
                                yield _entry(channel.topic, schema.name, record)
        except OSError as error:
            raise SourceError(f"cannot read {self.path}: {error.strerror}") from error
        except McapDamagedError as error:
            raise SourceError(error.of(self.path)) from error

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """See `Storage`."""
        with self.path.open("rb") as stream:
            yield _McapReader(self.path, MessageReader(stream))


@dataclass(frozen=True, slots=True)
class _McapReader:
    path: Path
    reader: MessageReader

    def read(self, place: tuple[int, ...]) -> bytes:
        """See `Reader`."""
        chunk_at, at, length = place
        try:
            return self.reader.read(None if chunk_at == _NO_CHUNK else chunk_at, at, length)
        except McapDamagedError as error:
            raise SourceError(f"{self.path}: {error}") from error


def _entry(topic: str, type_name: str, message: McapMessage) -> BagMessage:
    chunk_at = _NO_CHUNK if message.chunk_at is None else message.chunk_at
    place = (chunk_at, message.at, len(message.data))
    return BagMessage(topic, type_name, message.data, message.log_time_ns, place)
