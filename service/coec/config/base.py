"""What every model of the configuration is built of: names, paths, matrices, and the base of all models."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

MAX_NAME = 64
"""Characters of a name."""

Name = Annotated[str, Field(pattern=rf"^[A-Za-z0-9_.-]{{1,{MAX_NAME}}}$")]
"""A name that becomes one chunk of a Zenoh key and part of a file name."""

KeyExpression = Annotated[str, Field(pattern=r"^[^\s/*$?#]+(/[^\s/*$?#]+)*$", max_length=256)]
"""A Zenoh key without wildcards, and without empty chunks."""

MAX_NAME_BYTES = 255
"""Of one name in a path: what Linux's file systems take (limits.h, NAME_MAX)."""

MAX_PATH_BYTES = 2048
"""Of a path: half of what Linux takes (limits.h, PATH_MAX); the folder that it is relative to may have the rest."""


def _path(path: Path) -> Path:
    if "\0" in str(path) or any(len(os.fsencode(name)) > MAX_NAME_BYTES for name in path.parts):
        raise ValueError(f"a name in a path has no zero byte, and at most {MAX_NAME_BYTES} bytes")
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise ValueError(f"a path has at most {MAX_PATH_BYTES} bytes")
    return path


FilePath = Annotated[Path, AfterValidator(_path)]
"""A path that can be asked for. What a text file says may be none, and Python raises whatever it likes about it."""

Matrix4x4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]

IDENTITY: Matrix4x4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


OUR_WORDS = {
    # Pydantic would name the class of ours.
    "model_type": "give names with their values (a mapping)",
    "missing": "is missing",
    "extra_forbidden": "there is no such key",
}
"""What a file says wrongly, by pydantic's name of it, where its own words are those of a programmer."""


class Stage(BaseModel):
    """Base of every configuration model: frozen, no unknown keys, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def describe(error: ValidationError, names: Mapping[str, Sequence[str]] | None = None) -> str:
    """Each complaint of pydantic on a line: where, what. `names` are those of the entries of lists at the top, by which
    people know them."""
    known, lines = names or {}, []
    for item in error.errors():
        place = list(item["loc"])
        if len(place) > 1 and isinstance(place[1], int) and place[1] < len(known.get(str(place[0]), ())):
            place[1] = known[str(place[0])][place[1]]
        what = OUR_WORDS.get(item["type"], item["msg"])
        lines.append(f"{'.'.join(str(part) for part in place) or '(top)'}: {what}")
    return "; ".join(lines)
