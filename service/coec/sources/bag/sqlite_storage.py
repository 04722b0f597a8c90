"""Bags that are SQLite files, as `ros2 bag` wrote them by default up to Humble.

Files are not trusted: their schema is not, nothing in them may be longer than a message, and the tables must be real
tables.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from coec.errors import SourceError
from coec.sources.bag.storage import BagMessage, BagReader

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
