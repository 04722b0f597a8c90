"""Files that a command was asked to write."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from coec.adapters.files import durable
from coec.errors import DecodeError, OutputError
from coec.schemas.base import M, from_json


def try_folder(folder: Path) -> None:
    """Make the folder and write into it, before the work of which the result is to be there.

    Raises:
        OutputError: it cannot be made, or not be written to.
    """
    if folder.is_file():
        raise OutputError(f"cannot write to {folder}: it is a file; name a folder with --output")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Permissions do not tell: of a full or read-only disk, or to root.
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(b"\0")
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror}; name another folder with --output") from error


def try_file(path: Path) -> None:
    """Likewise of a file, which stays as it is, or absent.

    Raises:
        OutputError: it cannot be written.
    """
    try_folder(path.parent)
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder; name a file with --output")
    if path.exists() and not os.access(path, os.W_OK):
        raise OutputError(f"cannot write {path}: Permission denied; name another file with --output")


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


def replace(path: Path, data: bytes) -> Path:
    """Likewise, and at no moment is half of it there: for files that other programs read. One that is there keeps its
    permissions, and a link stays one.

    Raises:
        OutputError: it cannot be written; what was there is there still.
    """
    try:
        real = path.resolve()
        real.parent.mkdir(parents=True, exist_ok=True)
        mode = real.stat().st_mode if real.exists() else None
        durable.replace(real, data)
        if mode is not None:
            real.chmod(mode)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    return path


def kept(path: Path, model: type[M]) -> M | None:
    """A document that `to_json` made and that was written before; None where there is none, or a damaged one."""
    try:
        return from_json(model, path.read_bytes())
    except (OSError, DecodeError):
        return None
