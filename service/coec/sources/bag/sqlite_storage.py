"""Bags that are SQLite files, as `ros2 bag` wrote them by default up to Humble.

Nobody vouches for a file: its schema is not trusted, nothing in it may be longer than a message, and what is called a
table must be one.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from coec.errors import SourceError
from coec.sources.bag.storage import Entry, Reader

MAX_MESSAGE_BYTES = 256 * 2**20
"""Of one message, as in MCAP's chunks."""

_TABLES = {"topics", "messages"}


@dataclass(frozen=True, slots=True)
class SqliteStorage:
    """A `Storage`. A place is: the row of a message."""

    path: Path

    def entries(self) -> Iterator[Entry]:
        """See `Storage`."""
        with self._connected() as connection:
            rows = connection.execute(
                "SELECT messages.id, topics.name, topics.type, messages.data, messages.timestamp FROM messages "
                "JOIN topics ON topics.id = messages.topic_id WHERE topics.serialization_format = 'cdr' "
                "ORDER BY messages.id"
            )
            for row, topic, type_name, data, logged_ns in rows:
                if not (isinstance(topic, str) and isinstance(type_name, str) and isinstance(logged_ns, int)):
                    raise SourceError(f"{self.path} is damaged: message {row} has no topic, or no time")
                yield Entry(topic, type_name, self._bytes(row, data), logged_ns, (int(row),))

    @contextmanager
    def open(self) -> Iterator[Reader]:
        """See `Storage`."""
        with self._connected() as connection:
            yield _SqliteReader(self, connection)

    def read_from(self, connection: sqlite3.Connection, row: int) -> bytes:
        """The data of a message by its row."""
        found = connection.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
        if found is None:
            raise SourceError(f"{self.path}: there is no message {row} any more: the file has changed")
        return self._bytes(row, found[0])

    def _bytes(self, row: int, data: object) -> bytes:
        if not isinstance(data, bytes):
            raise SourceError(f"{self.path} is damaged: message {row} holds no bytes")
        return data

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        """A file that nobody is writing is opened as one that cannot change, which needs no second file beside it."""
        if not self.path.is_file():
            raise SourceError(f"{self.path} does not exist")
        beside = self.path.with_name(f"{self.path.name}-wal")
        mode = "mode=ro" if beside.exists() and beside.stat().st_size else "mode=ro&immutable=1"
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
