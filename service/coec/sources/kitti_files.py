"""What the two KITTI layouts share: number files, time stamps, Velodyne scans, image files."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.adapters.images.codec import probe
from coec.calibration.types import CameraFrame, EncodedImage
from coec.config import LimitsConfig
from coec.errors import DecodeError, SourceError
from coec.sources.reading import read_bytes

NS_PER_S = 1_000_000_000

MAX_TEXT_BYTES = 32 * 2**20
"""Largest text file, bytes. The poses of the longest drive of KITTI-360, 19,240 frames, have 4 MB."""

_STAMP = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(?:\.(\d{1,9}))?")


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        SourceError: it is absent or not text.
    """
    try:
        return read_bytes(path, MAX_TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not a text file (byte {error.start})") from error


def read_numbers(path: Path) -> dict[str, NDArray[np.float64]]:
    """Lines `key: number number ...` by key; lines whose values are not numbers (dates) are left out.

    Raises:
        SourceError: the file is absent or not text.
    """
    result: dict[str, NDArray[np.float64]] = {}
    for line in read_text(path).splitlines():
        key, colon, values = line.partition(":")
        if not colon:
            continue
        try:
            result[key.strip()] = np.array([float(value) for value in values.split()])
        except ValueError:
            continue
    return result


def numbers_of(path: Path, numbers: dict[str, NDArray[np.float64]], key: str, count: int) -> NDArray[np.float64]:
    """The `count` finite numbers of a key.

    Raises:
        SourceError: the key is absent, has another count, or holds NaN; names file and key.
    """
    values = numbers.get(key)
    if values is None:
        raise SourceError(f"{path} has no entry {key}")
    if values.size != count or not np.isfinite(values).all():
        raise SourceError(f"{path}: {key} must hold {count} finite numbers, found {values.size}")
    return values


def homogeneous(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) from the 12 numbers of a 3 by 4 matrix, or the 9 numbers of a rotation."""
    T = np.eye(4)
    block = rows.reshape(3, -1)
    T[:3, : block.shape[1]] = block
    return T


def rigid(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """T with its rotation made orthonormal. The files print six digits, so products of their matrices are off by 1e-6.

    Takes the nearest rotation in the Frobenius norm, by singular value decomposition.
    """
    u, _, vt = np.linalg.svd(T[:3, :3])
    result = T.copy()
    result[:3, :3] = u @ vt
    return result


def read_stamps(path: Path) -> list[int]:
    """Stamps of `timestamps.txt` (`2013-05-28 08:46:02.904483072`, taken as UTC), nanoseconds since 1970.

    Raises:
        SourceError: the file is absent, or a line is no stamp; names the line.
    """
    stamps = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        match = _STAMP.fullmatch(line.strip())
        try:
            if match is None:
                raise ValueError
            seconds = datetime.strptime(match[1], "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        except ValueError as error:
            raise SourceError(f"{path}, line {number}: not a time stamp like 2013-05-28 08:46:02.904483072") from error
        stamps.append(int(seconds.timestamp()) * NS_PER_S + int((match[2] or "0").ljust(9, "0")))
    return stamps


def numbered_files(folder: Path, suffix: str) -> dict[int, Path]:
    """Files of a folder whose name is a frame number, by that number.

    Raises:
        SourceError: there is no such folder.
    """
    if not folder.is_dir():
        raise SourceError(f"there is no folder {folder}")
    return {int(path.stem): path for path in sorted(folder.glob(f"*{suffix}")) if path.stem.isdecimal()}


def select_one(candidates: list[str], requested: str | None, what: str, root: Path) -> str:
    """The candidate that was asked for, or the only one there.

    Raises:
        SourceError: there is none, there are several and none was asked for, or the one asked for is absent; lists what
            is there.
    """
    there = ", ".join(candidates[:12]) or "none"
    if requested is not None:
        if requested not in candidates:
            raise SourceError(f"{root} has no {what} {requested}; there: {there}")
        return requested
    if not candidates:
        raise SourceError(f"{root} has no {what}: give the folder that holds the {what}s as they were unpacked")
    if len(candidates) != 1:
        raise SourceError(f"{root} has {len(candidates)} {what}s, choose one with ?{what}=...; there: {there}")
    return candidates[0]


def stamp_of(stamps_ns: list[int], index: int, path: Path) -> int:
    """Stamp of frame `index`.

    Raises:
        SourceError: the file has fewer lines.
    """
    if index >= len(stamps_ns):
        raise SourceError(f"{path} ends before frame {index}: it has {len(stamps_ns)} stamps")
    return stamps_ns[index]


def median_period_s(stamps_ns: list[int], default_s: float) -> float:
    """Median distance of consecutive stamps in seconds; the default if there are fewer than two."""
    if len(stamps_ns) < 2:
        return default_s
    return float(np.median(np.diff(np.array(stamps_ns, dtype=np.int64)))) / NS_PER_S


def load_image(path: Path) -> EncodedImage:
    """A JPEG or PNG file as it is, its size read from its header.

    Raises:
        SourceError: the file is absent or not an image; names it.
    """
    try:
        return probe(read_bytes(path), LimitsConfig())
    except DecodeError as error:
        raise SourceError(f"{path}: {error}") from error


def load_camera(stamp_ns: int, frame_id: str, image: Path, depth: Path | None) -> CameraFrame:
    """A camera frame from its image file and, where there is one, its depth map (16-bit PNG).

    Raises:
        SourceError: a file cannot be read; names it.
    """
    return CameraFrame(stamp_ns, frame_id, load_image(image), depth=None if depth is None else load_image(depth))
