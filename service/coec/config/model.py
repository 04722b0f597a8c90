"""What every model of the configuration is built from: names, paths, matrices, and the base of all models."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

MAX_NAME = 64
"""Most characters of a name."""

Name = Annotated[str, Field(pattern=rf"^[A-Za-z0-9_.-]{{1,{MAX_NAME}}}$")]
"""A name that becomes one chunk of a Zenoh key and part of a file name."""

KeyExpression = Annotated[str, Field(pattern=r"^[^\s/*$?#]+(/[^\s/*$?#]+)*$", max_length=256)]
"""A Zenoh key without wildcards, and without empty chunks."""

MAX_NAME_BYTES = 255
"""Most bytes of one name in a path: what Linux's file systems take (limits.h, NAME_MAX)."""

MAX_PATH_BYTES = 2048
"""Most bytes of a path: half of what Linux takes (limits.h, PATH_MAX). The rest is for the folder that the path is
relative to."""


def _validated_path(path: Path) -> Path:
    if "\0" in str(path) or any(len(os.fsencode(name)) > MAX_NAME_BYTES for name in path.parts):
        raise ValueError(f"a name in a path has no zero byte, and at most {MAX_NAME_BYTES} bytes")
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise ValueError(f"a path has at most {MAX_PATH_BYTES} bytes")
    return path


FilePath = Annotated[Path, AfterValidator(_validated_path)]
"""A path that the operating system accepts. Text from a file may be no valid path, and Python raises various
exceptions on such a path; `_path` refuses it first."""

Matrix4x4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]

IDENTITY: Matrix4x4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


ERROR_MESSAGES = {
    # Pydantic's own message would name our class.
    "model_type": "give names with their values (a mapping)",
    "missing": "is missing",
    "extra_forbidden": "there is no such key",
}
"""Error messages by pydantic's error type, where pydantic's own message is written for programmers."""


class ConfigModel(BaseModel):
    """Base of every configuration model: frozen, no unknown keys, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


INVERSE_POSE = (
    "the pose maps LiDAR to camera coordinates: write this matrix, which is its inverse, under `T_lidar_camera`"
)
SAME_POSE = "the pose is called `T_camera_lidar`: its four rows, mapping LiDAR to camera coordinates"
FOREIGN_KEY_ADVICE = {
    "lidar_from_camera": INVERSE_POSE,
    "T_cam_lidar": SAME_POSE,
    "camera_from_lidar": SAME_POSE,
    "extrinsic": SAME_POSE,
    "extrinsics": SAME_POSE,
}
"""What to write in place of a key that other programs, or other files of coec, have."""


def _advice(name: str, kind: str) -> str:
    """What to do about a mistake at a key, beyond pydantic's own words; empty if they say it."""
    if kind == "extra_forbidden" and name in FOREIGN_KEY_ADVICE:
        return f"; {FOREIGN_KEY_ADVICE[name]}"
    if kind.startswith("int") and name.endswith("_ns"):
        return "; it counts nanoseconds, a whole number: multiply seconds by 1000000000"
    if kind == "model_type" and name == "intrinsics":
        return (
            " (model, width, height, fx, ...); `coec convert BAG OUT.yaml` writes them from a bag's CameraInfo, or "
            "from the camera_info.yaml in BAG?intrinsics=FILE"
        )
    return ""


def describe(error: ValidationError, names: Mapping[str, Sequence[str]] | None = None) -> str:
    """Pydantic's complaints in one line: where and what, with `; ` between them. `names` holds the names of the entries
    of each list at the top of the file; they stand in place of the entries' indices."""
    entry_names, lines = names or {}, []
    for item in error.errors():
        location = list(item["loc"])
        if (
            len(location) > 1
            and isinstance(location[1], int)
            and location[1] < len(entry_names.get(str(location[0]), ()))
        ):
            location[1] = entry_names[str(location[0])][location[1]]
        message = ERROR_MESSAGES.get(item["type"], item["msg"]) + _advice(
            str(location[-1]) if location else "", item["type"]
        )
        lines.append(f"{'.'.join(str(part) for part in location) or '(top)'}: {message}")
    return "; ".join(lines)
