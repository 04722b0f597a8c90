"""Files that a user names: bounded reads of untrusted files, output files of commands, and paths below a home
directory.
"""

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from coec.errors import DecodeError, OutputError, SourceError
from coec.io import storage
from coec.schemas.message import M, from_json


def try_folder(folder: Path) -> None:
    """Make the folder and try to write into it, before the work whose result is to go there. Then remove what was made:
    work that fails leaves no empty folder, and `write` makes its own.

    Raises:
        OutputError: the folder cannot be made or written to.
    """
    if folder.is_file():
        raise OutputError(f"cannot write to {folder}: it is a file; name a folder with --output")
    absent = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A real write, because permissions say nothing about a full or read-only disk, and nothing at all to root.
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(b"\0")
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror}; name another folder with --output") from error
    finally:
        # Innermost first; one into which somebody else has written by now stays.
        with suppress(OSError):
            for made in absent:
                made.rmdir()


def try_file(path: Path) -> None:
    """Check that a file can be written; it is neither changed nor created.

    Raises:
        OutputError: it cannot be written.
    """
    try_folder(path.parent)
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder; name a file with --output")
    if path.exists() and not os.access(path, os.W_OK):
        raise OutputError(f"cannot write {path}: Permission denied; name another file with --output")


def require_absent(*paths: Path, force: bool) -> None:
    """Check, before the work, that no file is there whose content is somebody's work: a configuration, a recording, a
    mask. Reports and pictures that a command has drawn are written anew instead.

    Args:
        force: the person has said `--force`; then nothing is checked.

    Raises:
        OutputError: a file is there.
    """
    present = [str(path) for path in paths if path.is_file()]  # a device such as /dev/stdout is no file
    if present and not force:
        verb = "is" if len(present) == 1 else "are"
        raise OutputError(
            f"{' and '.join(present)} {verb} there already, and nothing was written: name another file, or overwrite "
            f"{'it' if len(present) == 1 else 'them'} with --force"
        )


def write_output(path: Path, data: bytes) -> Path:
    """Write a whole file, and make its folder if needed.

    Raises:
        OutputError: it cannot be written; half a file is not left.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            try:
                file.write(data)
                file.flush()
            except OSError:
                if path.is_file():  # a device stays
                    path.unlink()
                raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    return path


def replace_output(path: Path, data: bytes) -> Path:
    """The same, but atomically, for files that other programs read. An existing file keeps its permissions, and a link
    stays a link.

    Raises:
        OutputError: it cannot be written; then the old file is still there.
    """
    try:
        real = path.resolve()
        real.parent.mkdir(parents=True, exist_ok=True)
        mode = real.stat().st_mode if real.exists() else None
        storage.replace(real, data, mode=storage.BY_UMASK)
        if mode is not None:
            real.chmod(mode)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    return path


def load_document(path: Path, model: type[M]) -> M | None:
    """A document that `to_json` made, read from a file; None if there is none or it is damaged."""
    try:
        return from_json(model, path.read_bytes())
    except (OSError, DecodeError):
        return None


MAX_FILE_BYTES = 256 * 2**20
"""Largest image, cloud or table, bytes. An 8K image has 100 MB as raw pixels, a million points with eight columns have
32 MB."""


def read_bytes(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """A whole file.

    Raises:
        SourceError: the file is absent, not readable or too large.
    """
    try:
        with path.open("rb") as stream:
            large = os.fstat(stream.fileno()).st_size > max_bytes
            data = b"" if large else stream.read(max_bytes + 1)
    except FileNotFoundError as error:
        raise SourceError(f"{path} does not exist") from error
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    if large or len(data) > max_bytes:
        raise SourceError(f"{path} has more than {max_bytes} bytes: too large for a single file of a recording")
    return data


def expand_home(path: str) -> Path:
    """A path with a leading `~` or `~name` replaced by that user's home. It stays as it is if the user has no home, as
    the dynamic user that a service manager creates for a service."""
    return Path(os.path.expanduser(path))  # noqa: PTH111  pathlib's own raises where there is no home
