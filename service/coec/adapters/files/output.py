"""Files that a command was asked to write."""

from __future__ import annotations

from pathlib import Path

from coec.errors import CoecError


class OutputError(CoecError):
    """A file that was asked for could not be written."""

    reply_code = "output_failed"


def write(path: Path, data: bytes) -> Path:
    """A whole file, its folder made if need be.

    Raises:
        OutputError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    return path
