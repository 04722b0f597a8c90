"""A candidate: a calibration that was found but is not served, read from a file of `coec calibrate --json`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from coec.adapters.files.conversions import matrix_of
from coec.calibration.types import Matrix4
from coec.errors import DecodeError, SourceError
from coec.geometry.se3 import is_rigid
from coec.schemas.base import from_json
from coec.schemas.replies import CalibrationResult
from coec.sources.reading import read_bytes

MAX_BYTES = 2**20
"""Most bytes of a result, which has some 5 kB."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """What the file holds, and its T_camera_lidar (4, 4)."""

    result: CalibrationResult
    T_camera_lidar: Matrix4


def candidate_in(path: Path) -> Candidate:
    """The result in a file.

    Raises:
        SourceError: the file cannot be read, or holds no result, or one that is no rigid transform.
    """
    try:
        result = from_json(CalibrationResult, read_bytes(path, MAX_BYTES))
    except DecodeError as error:
        raise SourceError(f"{path} is not the result of `coec calibrate --json`: {error}") from error
    T_camera_lidar = matrix_of(result.camera_from_lidar)
    if not is_rigid(T_camera_lidar):
        raise SourceError(f"{path}: camera_from_lidar is no rotation and translation")
    return Candidate(result, T_camera_lidar)
