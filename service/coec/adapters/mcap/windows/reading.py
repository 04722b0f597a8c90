"""Reads windows: completely, pair by pair, or only their result."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from coec.adapters.mcap.chunk_writer import CHUNK_BYTES
from coec.adapters.mcap.files import McapDamagedError, McapMessage, Metadata, Record, read_attachment, read_records
from coec.adapters.mcap.windows.content import WindowContent
from coec.adapters.mcap.windows.names import METADATA, RESULT, RIG
from coec.calibration.search.mount_prior import MOUNT_RAD
from coec.calibration.types import FramePair, Window
from coec.config import CalibrationConfig
from coec.errors import DecodeError, SourceError, WindowError
from coec.schemas.base import from_json
from coec.schemas.replies import CalibrationResult

MAX_UNPACKED = 64
"""A window may unpack to at most this many times its size (plus `CHUNK_BYTES`). No tool compresses images and clouds to
a sixtieth."""


def read_window(path: Path) -> tuple[Window, CalibrationConfig]:
    """The window exactly as it was recorded, and the configuration that it was recorded for.

    Raises:
        WindowError: unreadable, cut off, damaged, not a window of coec, or without a pair.
    """
    content = WindowContent()
    size = _size(path)
    for record in records_of(path, max_unpacked_bytes=size * MAX_UNPACKED + CHUNK_BYTES):
        content.add(record)
    rig, T_camera_lidar_start, window_id = content.head(path)
    places = sorted(content.parts)
    pairs, between = (
        tuple(
            sorted((content.pair(path, of) for of in places if of.between == thinned), key=lambda pair: pair.stamp_ns)
        )
        for thinned in (False, True)
    )
    if not pairs:
        raise WindowError(f"{path} holds no camera-LiDAR pair")
    # The service began the window at the extrinsic in use, which is off by about `MOUNT_RAD`.
    window = Window(window_id, rig, T_camera_lidar_start, pairs, MOUNT_RAD, between)
    return window, content.parsed_configuration(path)


def pairs_since(path: Path, since_ns: int) -> Iterator[FramePair]:
    """The pairs of a window from a stamp on, in the order of the file; holds one at a time in memory.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    content = WindowContent()
    for record in records_of(path, max_unpacked_bytes=_size(path) * MAX_UNPACKED + CHUNK_BYTES):
        place = content.add(record)
        if place is None:
            continue
        pair = content.pair(path, place)
        if pair.stamp_ns >= since_ns and not place.between:
            yield pair


def read_result(path: Path) -> CalibrationResult | None:
    """The result that was written into a window; None if it has none. Does not read the frames.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    data = _attachment(path, RESULT)
    if data is None:
        return None
    try:
        return from_json(CalibrationResult, data)
    except DecodeError as error:
        raise WindowError(f"{path}: {RESULT}: {error}") from error


def read_vehicle(path: Path) -> str:
    """The vehicle that recorded a window; empty if the window does not say. Does not read the frames.

    Raises:
        WindowError: unreadable or damaged at its beginning.
    """
    return metadata_of(path).get("vehicle", "")


def metadata_of(path: Path) -> dict[str, str]:
    """The metadata `coec` of a window, from before its first message; empty if there are none.

    Raises:
        WindowError: unreadable or damaged at its beginning.
    """
    for record in records_of(path):
        match record:
            case Metadata() if record.name == METADATA:
                return record.values
            case McapMessage():
                break
    return {}


def is_window(path: Path) -> bool:
    """Whether a sound MCAP file is a window of coec. Does not read the frames.

    Raises:
        SourceError: unreadable, cut off or damaged, so that it cannot be decided.
    """
    try:
        return read_attachment(path, RIG) is not None
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    except McapDamagedError as error:
        raise SourceError(error.of(path)) from error


def records_of(path: Path, max_unpacked_bytes: int | None = None) -> Iterator[Record]:
    """The records of a window's file; those before an error are sound.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    try:
        with path.open("rb") as stream:
            yield from read_records(stream, max_unpacked_bytes=max_unpacked_bytes)
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
    except McapDamagedError as error:
        raise WindowError(_damage(path, error)) from error


def _attachment(path: Path, name: str) -> bytes | None:
    try:
        return read_attachment(path, name)
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
    except McapDamagedError as error:
        raise WindowError(_damage(path, error)) from error


def _damage(path: Path, error: McapDamagedError) -> str:
    message = error.of(path)
    return f"{message}; the daemon does so for its own at start" if error.is_mcap else message


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
