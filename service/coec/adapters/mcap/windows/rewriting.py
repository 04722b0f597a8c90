"""Rewrites a window with its result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from coec.adapters.mcap.files import Channel, McapAttachment, McapMessage, Metadata, Schema
from coec.adapters.mcap.ros_channels import RosChannel
from coec.adapters.mcap.whole_file import WholeFile
from coec.adapters.mcap.windows.names import (
    COMPRESSED,
    IMAGE,
    JSON,
    LZ4,
    OVERLAY,
    PACKING,
    RESULT,
    RESULT_TOPIC,
    REWRITE_SUFFIX,
    SUFFIX,
    is_between,
    topic,
    with_suffix,
)
from coec.adapters.mcap.windows.reading import metadata_of, records_of
from coec.adapters.mcap.windows.writer import RecordedWindow
from coec.adapters.ros import diagnostics, messages, outgoing
from coec.errors import WindowError
from coec.schemas.base import to_json
from coec.schemas.replies import CalibrationResult
from coec.schemas.ros_names import DIAGNOSTICS


def write_result(path: Path, result: CalibrationResult, overlay_jpeg: bytes | None = None) -> RecordedWindow:
    """Rewrites the window with its result (an earlier one is replaced): as `/diagnostics`, as JSON message and as
    attachment, plus a picture of the points at the result if there is one. The file is replaced atomically, so that a
    reader sees either version. The thinned pairs between those of the window stay only if the result says that the
    camera moved, because they determined when.

    Raises:
        WindowError: the window is damaged.
        RecordingError: it could not be written; then the file is unchanged.
    """
    packed = metadata_of(path).get(PACKING) == LZ4
    file = WholeFile(with_suffix(path, REWRITE_SUFFIX), path, packed=packed)
    result_topic, overlay = topic(result.pair, RESULT_TOPIC), topic(result.pair, OVERLAY)
    try:
        earlier, moved = (DIAGNOSTICS, result_topic, overlay), result.moved is not None
        window_id, pairs = _copy(path, file, lambda topic: topic in earlier or (is_between(topic) and not moved))
        stamp_ns, document = result.data_stamp_ns, to_json(result)
        if overlay_jpeg is not None:
            picture = outgoing.encode_jpeg(stamp_ns, result.camera_frame, overlay_jpeg)
            file.ros(RosChannel(overlay, messages.COMPRESSED_IMAGE), stamp_ns, 0, picture)
        file.ros(RosChannel(DIAGNOSTICS, messages.DIAGNOSTICS), stamp_ns, 0, _diagnostics(result))
        file.message(result_topic, "json", None, {}, stamp_ns, 0, document)
        file.attach(RESULT, JSON, document)
    except WindowError:
        file.abandon()
        raise
    return RecordedWindow.of(file.finish(), window_id, pairs)


def _copy(path: Path, file: WholeFile, leave_out: Callable[[str], bool]) -> tuple[str, int]:
    """Copies a window record by record, without its result and the topics to leave out. Returns its id and number of
    pairs."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    window_id, pairs = path.name.removesuffix(SUFFIX), 0
    for record in records_of(path):
        match record:
            case Schema():
                schemas[record.schema_id] = record
            case Channel():
                channels[record.channel_id] = record
            case McapAttachment() if record.name != RESULT:
                file.attach(record.name, record.media_type, record.data)
            case Metadata():
                file.metadata(record.name, record.values)
                window_id = record.values.get("window_id", window_id)
            case McapMessage():
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise WindowError(f"{path}: a message belongs to no channel")
                if leave_out(channel.topic):
                    continue
                file.message(
                    channel.topic,
                    channel.message_encoding,
                    schemas.get(channel.schema_id),
                    channel.metadata,
                    record.log_time_ns,
                    record.sequence,
                    record.data,
                )
                pairs += channel.topic.endswith((f"/{IMAGE}", f"/{COMPRESSED}"))
    return window_id, pairs


def _diagnostics(result: CalibrationResult) -> bytes:
    """The verdict with its figures, for ROS tools."""
    return outgoing.encode_diagnostics(result.data_stamp_ns, [diagnostics.status_of_result(result)])
