"""MCAP files that appear completely written or not at all."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coec.adapters.files import durable
from coec.adapters.mcap.chunk_writer import ChunkWriter
from coec.adapters.mcap.files import Schema
from coec.adapters.mcap.ros_channels import CDR, SHRINK, RosChannel
from coec.errors import RecordingError


@dataclass(frozen=True, slots=True)
class FinishedFile:
    """A finished file. `sha256` is hexadecimal, over the whole file; `bytes` and `modified_ns` (the file system's time
    of the last write) distinguish this version of the file from a later one."""

    path: Path
    bytes: int
    modified_ns: int
    sha256: str


class _HashingFile(io.BufferedWriter):
    """Hashes all bytes written. It must only be appended to."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(durable.create(path), "wb"))
        self.sha256 = hashlib.sha256()

    def write(self, data: Any, /) -> int:
        """Hash and write."""
        self.sha256.update(data)
        return super().write(data)


class WholeFile:
    """An MCAP file that gets its final name only once it is complete and on the disk."""

    def __init__(self, temporary: Path, final: Path, *, packed: bool) -> None:
        """Opens `temporary`, which becomes `final`. If `packed`, messages that shrink are compressed.

        Raises:
            RecordingError: the file cannot be written. All methods raise it; then the temporary file is gone.
        """
        self._temporary, self._final = temporary, final
        self._packed = packed
        self._channels: dict[str, int] = {}
        with failing_as_recording_error(final):
            self._file = _HashingFile(temporary)
        with self._guarded():
            durable.sync_folder(temporary.parent)
            self._mcap = ChunkWriter(self._file)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Adds an attachment with time 0, as it belongs to no instant."""
        with self._guarded():
            self._mcap.attach(name, media_type, data)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds a metadata record."""
        with self._guarded():
            self._mcap.metadata(name, values)

    def ros(self, channel: RosChannel, stamp_ns: int, sequence: int, data: bytes) -> None:
        """Adds a ROS message."""
        self.message(channel.topic, CDR, channel.schema, channel.metadata, stamp_ns, sequence, data)

    def message(
        self,
        topic: str,
        encoding: str,
        schema: Schema | None,
        metadata: Mapping[str, str],
        stamp_ns: int,
        sequence: int,
        data: bytes,
    ) -> None:
        """Adds a message of any kind. The first message on a topic determines the topic's channel."""
        packed = self._packed and schema is not None and schema.name in SHRINK
        with self._guarded():
            if topic not in self._channels:
                self._channels[topic] = self._mcap.channel(topic, encoding, schema, metadata)
            self._mcap.message(self._channels[topic], stamp_ns, sequence, data, packed=packed)

    def sync(self) -> None:
        """Puts what was added on the disk. Called often, so that the end of a window need not wait for all of it."""
        with self._guarded():
            self._mcap.close_chunk()
            self._file.flush()
            os.fdatasync(self._file.fileno())

    def finish(self) -> FinishedFile:
        """Writes the index, and makes file and name durable."""
        with self._guarded():
            self._mcap.finish()
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
    """Turns an OSError about a file into a `RecordingError` with a clear message."""
    try:
        yield
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror}; free space or choose another directory"
        ) from error
