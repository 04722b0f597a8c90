"""An MCAP file that is there as a whole, or not at all."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from coec import __version__
from coec.adapters.files import durable
from coec.adapters.mcap.files import Schema
from coec.errors import RecordingError

CHUNK_BYTES = 64 * 1024
"""A chunk is closed at the first message past this size, so that a killed recorder loses a pair at most."""


@dataclass(frozen=True, slots=True)
class FinishedFile:
    """What became of it. `sha256` is hexadecimal and of the whole file; `bytes` and `modified_ns` (what the file system
    says of the last write) tell this version of the file from a later one."""

    path: Path
    bytes: int
    modified_ns: int
    sha256: str


class _HashingFile(io.BufferedWriter):
    """Hashes what passes: the library only ever appends."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path, "wb"))
        self.sha256 = hashlib.sha256()

    def write(self, data: Any, /) -> int:
        """Hash and write."""
        self.sha256.update(data)
        return super().write(data)


class WholeFile:
    """An MCAP file that appears under its final name when it is complete and on the disk, or not at all."""

    def __init__(self, temporary: Path, final: Path) -> None:
        """Opens `temporary`, which becomes `final`.

        Raises:
            RecordingError: the file cannot be written. So does everything below, and the temporary file is gone then.
        """
        self._temporary, self._final = temporary, final
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[str, int] = {}
        with failing_as_recording_error(final):
            self._file = _HashingFile(temporary)
        with self._guarded():
            durable.sync_folder(temporary.parent)
            # The CRC over the data section also covers what lies outside the chunks.
            self._mcap = Writer(self._file, CHUNK_BYTES, CompressionType.NONE, enable_crcs=True, enable_data_crcs=True)
            self._mcap.start(profile="ros2", library=f"coec/{__version__}")

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Adds an attachment, dated 0: it belongs to no instant."""
        with self._guarded():
            self._mcap.add_attachment(0, 0, name, media_type, data)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds a metadata record."""
        with self._guarded():
            self._mcap.add_metadata(name, dict(values))

    def message(
        self, topic: str, schema: Schema | None, encoding: str, stamp_ns: int, sequence: int, data: bytes
    ) -> None:
        """Adds a message; channel and schema are registered at their first use, under an id of this file."""
        with self._guarded():
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._mcap.register_channel(topic, encoding, self._schema_id(schema))
                self._channels[topic] = channel
            self._mcap.add_message(channel, stamp_ns, data, stamp_ns, sequence)

    def sync(self) -> None:
        """Puts what was added on the disk: a little at a time, so that the end of a window does not wait for it all."""
        with self._guarded():
            self._file.flush()
            os.fdatasync(self._file.fileno())

    def finish(self) -> FinishedFile:
        """Writes the index, and makes file and name durable."""
        with self._guarded():
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            status = os.fstat(self._file.fileno())
            durable.publish(self._file, self._temporary, self._final)
        return FinishedFile(self._final, status.st_size, status.st_mtime_ns, self._file.sha256.hexdigest())

    def abandon(self) -> None:
        """Removes the temporary file."""
        with suppress(OSError):  # closing flushes, which fails again on a full disk
            self._file.close()
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    def _schema_id(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        key = (schema.name, schema.encoding, schema.data)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(*key)
        return self._schemas[key]

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
    """What the disk refuses of a file is said in our words."""
    try:
        yield
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror}; free space or choose another directory"
        ) from error
