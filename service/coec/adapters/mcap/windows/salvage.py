"""Salvages the window of a recorder that was killed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from coec.adapters.files import durable
from coec.adapters.mcap.whole_file import failing_as_recording_error
from coec.adapters.mcap.windows.content import WindowContent
from coec.adapters.mcap.windows.names import LZ4, PACKING, PART_SUFFIX, REWRITE_SUFFIX, with_suffix
from coec.adapters.mcap.windows.reading import records_of
from coec.adapters.mcap.windows.writer import RecordedWindow, WindowWriter
from coec.errors import WindowError


def salvage(part_path: Path, progress: Callable[[], None]) -> RecordedWindow | None:
    """Makes a window from the `.part` file that a killed recorder left behind, and removes that file.

    Args:
        part_path: the `.part` file.
        progress: called after every pair.

    Returns:
        The window with every whole pair; None if there is none, if the rig is lost, or if the window was finished after
        all.

    Raises:
        RecordingError: it could not be written; the `.part` file is still there.
    """
    final = part_path.with_name(part_path.name.removesuffix(PART_SUFFIX))
    window = None if final.exists() else _salvaged(part_path, final, progress)
    with failing_as_recording_error(final):
        durable.remove(part_path)
    return window


def _salvaged(part_path: Path, final: Path, progress: Callable[[], None]) -> RecordedWindow | None:
    content = WindowContent()
    writer: WindowWriter | None = None
    try:
        # The error at the damaged end of the file ends the loop; everything before it is sound.
        with suppress(WindowError):
            for record in records_of(part_path):
                place = content.add(record)
                if place is None:
                    continue
                if writer is None:
                    writer = _writer_like(content, part_path, final)
                pair = content.pair(part_path, place)
                if place.between:
                    writer.add_between(pair)
                else:
                    writer.add(pair)
                progress()
    except BaseException:
        if writer is not None:
            writer.abandon()
        raise
    if writer is None:
        return None
    if writer.pairs == 0:
        writer.abandon()
        return None
    if content.carried_over:
        writer.copy_carried_over(content.carried_over)
    return writer.finish()


def _writer_like(content: WindowContent, part_path: Path, final: Path) -> WindowWriter:
    rig, T_camera_lidar_start, window_id = content.head(part_path)
    configuration = content.parsed_configuration(part_path)
    return WindowWriter(
        final,
        rig,
        T_camera_lidar_start,
        window_id,
        configuration,
        content.metadata,
        packed=content.metadata.get(PACKING) == LZ4,
        temporary=with_suffix(final, REWRITE_SUFFIX),
    )
