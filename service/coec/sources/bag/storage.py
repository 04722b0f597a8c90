"""One interface to the messages of a bag, for MCAP files, SQLite files, and the folders of rosbag2 that hold them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from coec.errors import SourceError


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


def open_storage(path: Path) -> BagStorage:
    """The storage of an `.mcap` or `.db3` file, or of a folder with rosbag2's `metadata.yaml`.

    Raises:
        SourceError: the path is none of them; the message lists what would be.
    """
    if path.is_dir():
        from coec.sources.bag.folder import open_folder

        return open_folder(path)
    match path.suffix:
        case ".mcap":
            from coec.sources.bag.mcap_storage import McapStorage

            return McapStorage(path)
        case ".db3":
            from coec.sources.bag.sqlite_storage import SqliteStorage

            return SqliteStorage(path)
        case _:
            raise SourceError(f"{path} is no bag: .mcap, .db3, or a folder with metadata.yaml")
