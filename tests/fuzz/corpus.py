"""Inputs that lead somewhere: made by hand in `targets`, or found by fuzzing and kept in the folder `corpus`."""

from __future__ import annotations

from pathlib import Path

from fuzz.loop import Target

CORPUS = Path(__file__).resolve().parent / "corpus"
"""A folder for each target, a file for each input, named by its hash."""

MAX_RETAINED_BYTES = 8192
"""Of an input that is kept: none has to be large to lead somewhere."""


def inputs_of(target: Target) -> list[bytes]:
    """All that are known of a target, those made by hand first."""
    folder = CORPUS / target.name
    result = [path.read_bytes() for path in sorted(folder.iterdir())] if folder.is_dir() else []
    return [*target.seeds(), *result]
