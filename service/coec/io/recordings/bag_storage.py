"""One interface to the messages of a bag, and its files: MCAP and SQLite. Sizes are bounded before they are used;
`rosbags` reads bags that it trusts.

Files are not trusted: their schema is not, nothing in them may be longer than a message, and the tables must be real
tables.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from urllib.parse import quote

from coec.errors import DecodeError, SourceError
from coec.io.mcap.reader import (
    MAX_CHUNK_BYTES,
    MAX_RATIO,
    Channel,
    McapDamagedError,
    McapMessage,
    MessageReader,
    Schema,
    read_records,
)
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
    """

    topic: str
    type_name: str
    data: bytes
    logged_ns: int
    place: tuple[int, ...]


class BagReader(Protocol):
    """Reads messages again while the files are open."""

    def read(self, place: tuple[int, ...]) -> bytes:
        """The data of the message at a place.

        Raises:
            SourceError: the file is no longer what it was.
        """
        ...


class BagStorage(Protocol):
    """The messages of a bag.

    Attributes:
        path: path of the bag, as a person gives it.
    """

    @property
    def path(self) -> Path:
        """See above."""
        ...

    def entries(self) -> Iterator[BagMessage]:
        """All CDR messages, in the order in which they lie in the bag.

        Raises:
            SourceError: a file is absent, cut off or damaged; names it.
        """
        ...

    def open(self) -> AbstractContextManager[BagReader]:
        """A context manager that gives a reader; the files are closed at its end."""
        ...


_NO_CHUNK = -1


@dataclass(frozen=True, slots=True)
class McapStorage:
    """The `Storage` of an MCAP file. A place is: file offset of the chunk (-1 outside chunks), offset in the chunk,
    length; and the number of the translation of a message that is not in CDR."""

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
                            if channel is not None and schema is not None:
                                yield from self._entry(channel, schema.name, record)
        except OSError as error:
            raise SourceError(f"cannot read {self.path}: {error.strerror}") from error
        except McapDamagedError as error:
            raise SourceError(error.of(self.path)) from error

    def _entry(self, channel: Channel, type_name: str, message: McapMessage) -> Iterator[BagMessage]:
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
            place, type_name = (*place, number), TRANSLATIONS[number].type_name
            data = translated_if_read(number, data, f"{self.path}: a message on {channel.topic}")
        yield BagMessage(channel.topic, type_name, data, message.log_time_ns, place)

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
        chunk_at, at, length, *number = place
        try:
            data = self.reader.read(None if chunk_at == _NO_CHUNK else chunk_at, at, length)
        except McapDamagedError as error:
            raise SourceError(f"{self.path}: {error}") from error
        return translated(number[0], data, f"{self.path}: a message") if number else data


_READ = frozenset((*message_decoding.KNOWN, messages.CAMERA_INFO, messages.TF))
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


def translated_if_read(number: int, data: bytes, where: str) -> bytes:
    """The same for a message of which something is read; any other one as it is, because its translation takes time,
    and may fail."""
    return translated(number, data, where) if TRANSLATIONS[number].type_name in _READ else data


MAX_MESSAGE_BYTES = 256 * 2**20
"""Largest message, bytes; the same as for MCAP's chunks."""

MAX_TOPICS = 10_000
"""Most topics of a bag; a large vehicle has some 2,000."""

MAX_NAME = 1024
"""Most characters of the name of a topic or a type."""

MIN_ROW_BYTES = 4
"""Least bytes that a message takes in the file beside its data. Size of the cell, row, header and time take more."""

_TABLES = {"topics", "messages"}


@dataclass(frozen=True, slots=True)
class SqliteStorage:
    """The `Storage` of a SQLite file. A place is the row of a message."""

    path: Path

    def entries(self) -> Iterator[BagMessage]:
        """See `Storage`."""
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
        """See `Storage`."""
        with self._connected() as connection:
            yield _SqliteReader(self, connection)

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

    def read_from(self, connection: sqlite3.Connection, row: int) -> bytes:
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
            raise SourceError(f"{self.path} is damaged: {error}. `ros2 bag reindex` may save it") from error


@dataclass(frozen=True, slots=True)
class _SqliteReader:
    storage: SqliteStorage
    connection: sqlite3.Connection

    def read(self, place: tuple[int, ...]) -> bytes:
        """See `Reader`."""
        return self.storage.read_from(self.connection, place[0])
