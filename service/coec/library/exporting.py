"""A calibration in the files of other programs: what may be written, and what is to stand in them."""

from __future__ import annotations

from pathlib import Path

from coec.adapters.exports import FORMATS
from coec.adapters.exports.extrinsic import Extrinsic
from coec.errors import NotAcceptedError, SourceError, UsageError
from coec.sources.reading import read_bytes

MAX_BYTES = 64 * 2**20
"""Of a file that is read, or of another program's that is changed: a robot's URDF has below one million."""


def accepted(extrinsic: Extrinsic, name: str, way: str, *, force: bool) -> None:
    """Nothing, where the extrinsic may be written; `name` is what people call it, `way` how they insist.

    Raises:
        NotAcceptedError: its verdict speaks against it, and nobody insists.
    """
    if extrinsic.origin.objections and not force:
        raise NotAcceptedError(
            f"{name}: not accepted: {' '.join(extrinsic.origin.objections)} "
            f"`{way}` exports it all the same, and says so in the file."
        )


def text_of(extrinsic: Extrinsic, form: str, path: Path | None) -> str:
    """What the file shall hold; what it holds already stays where the format has room for it. None: there is no file.

    Raises:
        UsageError: no such format.
        SourceError: the file that is there cannot be read, or is no text.
        OutputError: what it holds cannot be changed.
    """
    known(form)
    return FORMATS[form].text(extrinsic, None if path is None else _held(path))


def known(form: str) -> None:
    """Nothing, where there is such a format.

    Raises:
        UsageError: there is none; says which there are.
    """
    if form not in FORMATS:
        raise UsageError(f"format {form}: known are {', '.join(FORMATS)}")


def _held(path: Path) -> str | None:
    """What is in the file that is to be changed; None where there is none."""
    if not path.exists():
        return None
    try:
        return read_bytes(path, MAX_BYTES).decode()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is no text in UTF-8: it cannot be changed") from error
