"""Export of a calibration into the files of other programs: whether it may be written, and the new text of the file."""

from __future__ import annotations

from pathlib import Path

from coec.adapters.exports import FORMATS
from coec.adapters.exports.extrinsic import Extrinsic
from coec.errors import NotAcceptedError, SourceError, UsageError
from coec.sources.reading import read_bytes

MAX_BYTES = 64 * 2**20
"""Largest file that is read or changed, bytes. A robot's URDF has less than one million."""


def accepted(extrinsic: Extrinsic, name: str, way: str, *, force: bool) -> None:
    """Returns if the extrinsic may be written. `name` (of the calibration) and `way` (the option that forces the
    export) appear in the error message.

    Raises:
        NotAcceptedError: its verdict is negative, and `force` is False.
    """
    if extrinsic.origin.objections and not force:
        raise NotAcceptedError(
            f"{name}: not accepted: {' '.join(extrinsic.origin.objections)} "
            f"`{way}` exports it all the same, and says so in the file."
        )


def text_of(extrinsic: Extrinsic, form: str, path: Path | None) -> str:
    """The new text of the file `path` (None: there is none). Its present content stays where the format has room for
    it.

    Raises:
        UsageError: no such format.
        SourceError: the present file cannot be read, or is not text.
        OutputError: the present content cannot be changed.
    """
    known(form)
    return FORMATS[form].text(extrinsic, None if path is None else _held(path))


def known(form: str) -> None:
    """Returns if the format exists.

    Raises:
        UsageError: there is no such format; the message lists those that exist.
    """
    if form not in FORMATS:
        raise UsageError(f"format {form}: known are {', '.join(FORMATS)}")


def _held(path: Path) -> str | None:
    """Text of the file that is to be changed; None where there is no file."""
    if not path.exists():
        return None
    try:
        return read_bytes(path, MAX_BYTES).decode()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is no text in UTF-8: it cannot be changed") from error
