"""Locks the state directory, so that only one daemon uses it."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coec.errors import UnavailableError


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Makes the state directory if it does not exist, and locks it against other daemons within the block.

    Raises:
        UnavailableError: the directory cannot be made or written, or another daemon uses it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / "lock").open("w")
    except OSError as error:
        text = f"state.directory {folder} cannot be made or written: {error.strerror}; see to its disk and its owner"
        raise UnavailableError(text) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UnavailableError(f"state.directory {folder} is in use by another daemon") from error
        yield
