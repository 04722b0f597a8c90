"""Folders of rosbag2: `metadata.yaml`, and the files that it names, read one after the other as one bag.

Files that are packed as a whole (`compression_mode: FILE`) are unpacked into the system's temporary folder, and removed
when the recording is no longer used.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zstandard
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coec.adapters.mcap.files import MAX_RATIO, MAX_ZSTD_WINDOW
from coec.config import describe, load_yaml
from coec.errors import ConfigError, SourceError
from coec.sources.bag.mcap_storage import McapStorage
from coec.sources.bag.sqlite_storage import SqliteStorage
from coec.sources.bag.storage import BagMessage, BagReader, BagStorage

METADATA = "metadata.yaml"

MAX_FILES = 10_000
"""Most files of one bag: a day in files of ten seconds."""

MAX_UNPACKED_MESSAGE_BYTES = 256 * 2**20
"""Largest unpacked size of one packed message, bytes; the same as for MCAP's chunks."""

MIN_FREE_BYTES = 2**30
"""Bytes that stay free on the disk of temporary files. A packed file that would leave less is refused."""

_COPY_BYTES = 2**20


class BagInformation(BaseModel):
    """The used fields of `rosbag2_bagfile_information`, versions 1 to 9; others are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    storage_identifier: str = Field(max_length=64)
    relative_file_paths: tuple[str, ...] = Field(min_length=1, max_length=MAX_FILES)
    compression_format: str = ""
    compression_mode: str = ""


@dataclass(frozen=True, slots=True, weakref_slot=True)
class FolderStorage:
    """The `Storage` of a folder. A place is: number of the file, place in that file.

    Attributes:
        packed_messages: whether each message is a zstd frame (`compression_mode: MESSAGE`).
    """

    path: Path
    files: tuple[BagStorage, ...]
    packed_messages: bool

    def entries(self) -> Iterator[BagMessage]:
        """See `Storage`."""
        for number, file in enumerate(self.files):
            left = MAX_UNPACKED_MESSAGE_BYTES
            for entry in file.entries():
                data = self.plain(entry.data)
                left += MAX_RATIO * len(entry.data) - len(data)
                if left < 0:
                    raise SourceError(f"{file.path} unpacks to more than {MAX_RATIO} times its size")
                yield replace(entry, data=data, place=(number, *entry.place))

    @contextmanager
    def open(self) -> Iterator[BagReader]:
        """See `Storage`."""
        with ExitStack() as opened:
            yield _FolderReader(self, opened, {})

    def plain(self, data: bytes) -> bytes:
        """A message as it was before it was packed."""
        if not self.packed_messages:
            return data
        try:
            if zstandard.get_frame_parameters(data).content_size > MAX_UNPACKED_MESSAGE_BYTES:
                raise SourceError(
                    f"{self.path}: a message does not state that it unpacks to at most {MAX_UNPACKED_MESSAGE_BYTES} bytes"
                )
            unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_ZSTD_WINDOW)
            return unpacker.decompress(data, max_output_size=MAX_UNPACKED_MESSAGE_BYTES)
        except zstandard.ZstdError as error:
            raise SourceError(f"{self.path} is damaged: a message is no zstd frame: {error}") from error


@dataclass(frozen=True, slots=True)
class _FolderReader:
    """Keeps only the file open that was read last, because a bag may have more files than a process may open."""

    folder: FolderStorage
    opened: ExitStack
    current: dict[int, BagReader]

    def read(self, place: tuple[int, ...]) -> bytes:
        """See `Reader`."""
        number, *rest = place
        if number not in self.current:
            self.opened.close()
            self.current.clear()
            self.current[number] = self.opened.enter_context(self.folder.files[number].open())
        return self.folder.plain(self.current[number].read(tuple(rest)))


def open_folder(path: Path) -> FolderStorage:
    """Opens the bag in a folder.

    Raises:
        SourceError: `metadata.yaml` is absent or cannot be used, the storage is unknown, or a file is absent; names it.
    """
    information = _information(path)
    if information.storage_identifier not in ("mcap", "sqlite3"):
        raise SourceError(f"{path / METADATA}: storage {information.storage_identifier!a} is neither mcap nor sqlite3")
    mode = information.compression_mode.upper() if information.compression_format else ""
    if mode and information.compression_format != "zstd":
        raise SourceError(f"{path / METADATA}: compression {information.compression_format!a} is not zstd")
    # Only the file's name counts: a bag must not reach outside its folder, and old versions wrote the folder in front.
    names = [path / Path(name).name for name in information.relative_file_paths]
    if len(set(names)) < len(names):
        raise SourceError(f"{path / METADATA} names a file twice")
    if mode != "FILE":
        return FolderStorage(path, _files(path, information, names), mode == "MESSAGE")
    unpacked = Path(tempfile.mkdtemp(prefix="coec-bag-"))
    try:
        plain = [_unpacked(file, unpacked) for file in names]
        storage = FolderStorage(path, _files(path, information, plain), packed_messages=False)
    except BaseException:
        shutil.rmtree(unpacked, ignore_errors=True)
        raise
    weakref.finalize(storage, shutil.rmtree, unpacked, ignore_errors=True)
    return storage


def _files(path: Path, information: BagInformation, names: Sequence[Path]) -> tuple[BagStorage, ...]:
    for name in names:
        if not name.is_file():
            raise SourceError(f"{path} lacks {name.name}, which its {METADATA} names")
    kind = SqliteStorage if information.storage_identifier == "sqlite3" else McapStorage
    return tuple(kind(name) for name in names)


def _information(path: Path) -> BagInformation:
    file = path / METADATA
    if not file.is_file():
        raise SourceError(f"{path} has no {METADATA}; `ros2 bag reindex {path}` writes one")
    try:
        document: Any = load_yaml(file)
        return BagInformation.model_validate(document["rosbag2_bagfile_information"])
    except ConfigError as error:
        raise SourceError(str(error)) from error
    except ValidationError as error:
        raise SourceError(f"{file}: {describe(error)}") from error
    except (KeyError, TypeError) as error:
        raise SourceError(f"{file} is no metadata of rosbag2") from error


def _unpacked(file: Path, folder: Path) -> Path:
    """A packed file (`name.mcap.zstd`), unpacked (`name.mcap`)."""
    target = folder / file.name.removesuffix(".zstd")
    unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_ZSTD_WINDOW)
    try:
        with file.open("rb") as packed, target.open("wb") as plain:
            left = MAX_UNPACKED_MESSAGE_BYTES + MAX_RATIO * file.stat().st_size
            for block in unpacker.read_to_iter(packed, write_size=_COPY_BYTES):
                left -= len(block)
                if left < 0:
                    raise SourceError(f"{file} unpacks to more than {MAX_RATIO} times its size")
                if shutil.disk_usage(folder).free < MIN_FREE_BYTES:
                    raise SourceError(f"{file} unpacks to more than {folder.parent} has room for")
                plain.write(block)
    except FileNotFoundError as error:
        raise SourceError(f"{file} does not exist") from error
    except OSError as error:
        raise SourceError(f"cannot unpack {file}: {error.strerror}") from error
    except zstandard.ZstdError as error:
        raise SourceError(f"{file} is damaged: {error}") from error
    return target
