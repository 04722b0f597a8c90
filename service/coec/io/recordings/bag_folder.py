"""Folders of bags: those of rosbag2 with their `metadata.yaml`, packed as a whole, message by message or not at all,
and folders of files without it.

Files that are packed as a whole (`compression_mode: FILE`) are unpacked into the system's temporary folder, and removed
when the recording is no longer used.
"""

import re
import shutil
import tempfile
import weakref
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zstandard
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coec.config import describe, load_yaml
from coec.errors import ConfigError, SourceError
from coec.io.mcap.reader import MAX_RATIO, MAX_ZSTD_WINDOW
from coec.io.mcap.windows import is_window
from coec.io.recordings.bag_storage import BagMessage, BagReader, BagStorage, McapStorage, Ros1Storage, SqliteStorage
from coec.io.recordings.recording_source import BAG_SUFFIXES


def open_storage(path: Path) -> BagStorage:
    """The storage of an `.mcap` or `.db3` file, or of a folder with rosbag2's `metadata.yaml`.

    Raises:
        SourceError: the path is none of them; the message lists what would be.
    """
    if path.is_dir():
        return open_folder(path)
    match path.suffix:
        case ".mcap":
            return McapStorage(path)
        case ".db3":
            return SqliteStorage(path)
        case ".bag":
            return Ros1Storage(path)
        case _:
            raise SourceError(f"{path} is no bag: .mcap, .db3, .bag, or a folder of them")


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
                    f"{self.path}: a message does not state that it unpacks to at most "
                    f"{MAX_UNPACKED_MESSAGE_BYTES} bytes"
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
    """Opens the bag in a folder: the files that its `metadata.yaml` names; without one, or if it names none of them (a
    folder that was renamed), all files of a bag in the order of their numbers.

    Raises:
        SourceError: `metadata.yaml` cannot be used, or a file is absent; names it.
    """
    if not (path / METADATA).is_file():
        files = files_of_bag(path)
        if any(file.suffix == ".mcap" and is_window(file) for file in files[:1]):
            raise SourceError(f"{path} holds recorded windows, each a recording of its own: give one, as {files[0]}")
        return FolderStorage(path, tuple(map(open_storage, files)), packed_messages=False)
    information = _information(path)
    mode = information.compression_mode.upper() if information.compression_format else ""
    if mode and information.compression_format != "zstd":
        raise SourceError(f"{path / METADATA}: compression {information.compression_format!a} is not zstd")
    # Only the file's name counts: a bag must not reach outside its folder, and old versions wrote the folder in front.
    names = [path / Path(name).name for name in information.relative_file_paths]
    if len(set(names)) < len(names):
        raise SourceError(f"{path / METADATA} names a file twice")
    if mode != "FILE":
        present = names if any(name.is_file() for name in names) else files_of_bag(path) or names
        return FolderStorage(path, _files(path, information, present), mode == "MESSAGE")
    unpacked = Path(tempfile.mkdtemp(prefix="coec-bag-"))
    try:
        plain = [_unpacked(file, unpacked) for file in names]
        storage = FolderStorage(path, _files(path, information, plain), packed_messages=False)
    except BaseException:
        shutil.rmtree(unpacked, ignore_errors=True)
        raise
    weakref.finalize(storage, shutil.rmtree, unpacked, ignore_errors=True)
    return storage


def files_of_bag(path: Path) -> list[Path]:
    """The files of bags in a folder, in the order of the numbers in their names; all of one kind, of which there are
    most."""
    files = [file for file in path.iterdir() if file.suffix in BAG_SUFFIXES and file.is_file()]
    if len(files) > MAX_FILES:
        raise SourceError(f"{path} has more than {MAX_FILES} files")
    kinds = Counter(file.suffix for file in sorted(files))
    kind = kinds.most_common(1)[0][0] if kinds else ""
    return sorted((file for file in files if file.suffix == kind), key=_numbered)


def _numbered(file: Path) -> tuple[tuple[int, str], ...]:
    """A key by which `bag_10` comes after `bag_9`."""
    parts = re.split(r"(\d{1,18})", file.name)
    return tuple((int(part), "") if part.isdecimal() and part.isascii() else (-1, part) for part in parts)


def _files(path: Path, information: BagInformation, names: Sequence[Path]) -> tuple[BagStorage, ...]:
    """The files of a bag, by their suffix; without one, by the storage that the metadata names. `ros2 bag reindex` of
    Humble leaves that out."""
    kinds: dict[str, type[McapStorage | SqliteStorage]] = {"mcap": McapStorage, "sqlite3": SqliteStorage}
    kind = kinds.get(information.storage_identifier)
    if kind is None and any(name.suffix not in BAG_SUFFIXES for name in names):
        identifier = information.storage_identifier
        raise SourceError(f"{path / METADATA}: storage {identifier!a} is neither mcap nor sqlite3")
    for name in names:
        if not name.is_file():
            raise SourceError(f"{path} lacks {name.name}, which its {METADATA} names")
    return tuple(open_storage(name) if kind is None or name.suffix in BAG_SUFFIXES else kind(name) for name in names)


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
