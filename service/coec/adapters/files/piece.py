"""A piece of a file that is fetched piece by piece."""

from __future__ import annotations

import os
from pathlib import Path

from coec.errors import NotFoundError, UsageError


def read_piece(path: Path, what: str, offset: int, length: int) -> bytes:
    """`length` bytes of a file from `offset`, fewer at its end. `what` names the file in error messages.

    Raises:
        NotFoundError: it cannot be read.
        UsageError: the offset lies beyond the end.
    """
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if offset > size:
                raise UsageError(f"`offset` lies beyond the end of the file ({size} bytes)")
            stream.seek(offset)
            return stream.read(length)
    except OSError as error:
        raise NotFoundError(f"{what} cannot be read: {error.strerror}") from error
