"""Writes windows, one MCAP file each (profile `ros2`, CDR), so that a reader never sees half a file; rewrites a window
with its result; and salvages the window of a recorder that was killed.

Layout: first come the attachments that the rest depends on (`rig.json`, `configuration.json`, `mask.png`), so that a
file that is cut off behind them can be salvaged. Then come, pair by pair, the sweep, ego-motion, depth map, camera info
and image. Each has the stamp of its sensor and the index of its pair as sequence number; the image comes last and
completes the pair. `write_result` adds a picture (`overlay`), `/diagnostics`, and the result as a JSON channel and as
attachment `result.json`. Each pair ends a chunk, so that everything added is on the disk.

A window may hold pairs of an earlier window that were kept for it. They come last, though they were taken first; the
metadata `coec_kept` name that earlier window. A reader sorts pairs by their stamps.

The thinned pairs between those of the window have their own topics and indices; their image comes last, too. They tell
when the camera moved within the window. `write_result` drops them if it did not move, which more than halves the size
of most windows.

The sender's sequence numbers are not kept, because the pairs of a window are a selection and gaps mean nothing. Chunks
of clouds and raw images are compressed on request, other chunks never, because encoded images do not shrink. Equal
pairs give equal bytes: nothing in the file tells when or where it was written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from coec.calibration.types import FramePair, Matrix4, Rig
from coec.config import CalibrationConfig
from coec.errors import RecordingError, WindowError
from coec.io import storage
from coec.io.mcap import window_reader
from coec.io.mcap.reader import Channel, McapAttachment, McapMessage, Metadata, Schema
from coec.io.mcap.window_reader import (
    BETWEEN,
    BETWEEN_IMAGE,
    CAMERA_INFO,
    CARRIED_OVER,
    COMPRESSED,
    CONFIGURATION,
    DEPTH,
    IMAGE,
    IMU,
    JSON,
    LZ4,
    MASK,
    METADATA,
    ODOMETRY,
    OVERLAY,
    PACKING,
    PART_SUFFIX,
    POINTS,
    RESULT,
    RESULT_TOPIC,
    REWRITE_SUFFIX,
    RIG,
    SUFFIX,
    WindowContent,
    is_between,
    metadata_of,
    records_of,
    topic,
    with_suffix,
)
from coec.io.mcap.writer import FinishedFile, RosChannel, WholeFile, check_stamp, failing_as_recording_error
from coec.io.rig_files import mask_to_png
from coec.io.ros import message_encoding, messages
from coec.schemas.keys import DIAGNOSTICS, TF_STATIC
from coec.schemas.message import to_json
from coec.schemas.replies import CalibrationResult


@dataclass(frozen=True, slots=True)
class RecordedWindow:
    """A finished window. `sha256` is hexadecimal, over the whole file; `pairs` is the number of pairs. `bytes` and
    `modified_ns` (the file system's time of the last write) distinguish this version of the file from a later one."""

    path: Path
    window_id: str
    pairs: int
    bytes: int
    modified_ns: int
    sha256: str

    @classmethod
    def of(cls, file: FinishedFile, window_id: str, pairs: int) -> RecordedWindow:
        """The window in a finished file."""
        return cls(file.path, window_id, pairs, file.bytes, file.modified_ns, file.sha256)


class WindowWriter:
    """Records one window, pair by pair. After a `RecordingError` the file is gone and the writer unusable."""

    def __init__(
        self,
        path_final: Path,
        rig: Rig,
        T_camera_lidar_start: Matrix4,
        window_id: str,
        configuration: CalibrationConfig,
        metadata: Mapping[str, str],
        *,
        packed: bool = False,
        temporary: Path | None = None,
    ) -> None:
        """Opens `<path_final>.part` (or `temporary`) and writes the attachments.

        Args:
            path_final: `<folder>/<window_id>.mcap`, the name after `finish`; a file of that name is replaced.
            rig: of the pair.
            T_camera_lidar_start: (4, 4) current extrinsic, where the search will start.
            window_id: of the window.
            configuration: with which the window will be calibrated.
            metadata: further facts for readers, for example `vehicle`. They become part of the bytes.
            packed: compress messages that shrink.

        Raises:
            RecordingError: the file cannot be written.
        """
        self.pairs = 0
        self._between = 0
        self._rig, self._T_start, self._window_id = rig, T_camera_lidar_start, window_id
        self._file = WholeFile(temporary or with_suffix(path_final, PART_SUFFIX), path_final, packed=packed)
        self._file.attach(RIG, JSON, window_reader.encode_rig(rig, T_camera_lidar_start, window_id))
        self._file.attach(CONFIGURATION, JSON, to_json(configuration))
        if rig.mask is not None:
            self._file.attach(MASK, "image/png", mask_to_png(rig.mask))
        self._file.metadata(METADATA, {"window_id": window_id, PACKING: LZ4 if packed else "", **metadata})
        self._file.sync()

    def note_carried_over(self, from_window_id: str, since_ns: int) -> None:
        """Notes that the pairs added from now on come from another window, from stamp `since_ns` on.

        Raises:
            RecordingError: it could not be written; the `.part` file has been removed.
        """
        self.copy_carried_over({"from_window": from_window_id, "since_ns": str(since_ns)})

    def copy_carried_over(self, values: Mapping[str, str]) -> None:
        """The same, with the metadata found in another file."""
        self._file.metadata(CARRIED_OVER, values)

    def add(self, pair: FramePair) -> None:
        """Appends a pair.

        Raises:
            RecordingError: it could not be written (disk full, or a stamp beyond ROS time); the `.part` file has been
                removed.
        """
        stamp_ns = pair.stamp_ns
        self._refuse_stamps_beyond_ros(pair)
        if self.pairs == 0:
            self._cdr(
                TF_STATIC, messages.TF, stamp_ns, message_encoding.encode_tf_static(self._rig, self._T_start, stamp_ns)
            )
        self._sweep_and_motion("", pair, self.pairs)
        if pair.camera.depth is not None:
            depth = message_encoding.encode_depth(stamp_ns, pair.camera.frame_id, pair.camera.depth)
            self._cdr(self._topic(DEPTH), messages.COMPRESSED_IMAGE, stamp_ns, depth)
        info = message_encoding.encode_camera_info(self._rig, stamp_ns)
        self._cdr(self._topic(CAMERA_INFO), messages.CAMERA_INFO, stamp_ns, info)
        image_type, image = message_encoding.encode_image(pair.camera)
        name = IMAGE if image_type == messages.IMAGE else COMPRESSED
        self._cdr(self._topic(name), image_type, stamp_ns, image)
        self._file.sync()
        self.pairs += 1

    def add_between(self, pair: FramePair) -> None:
        """Appends a thinned pair, whose image is compressed. It is on the disk once the next pair of the window is.

        Raises:
            RecordingError: as for `add`.
        """
        self._refuse_stamps_beyond_ros(pair)
        self._sweep_and_motion(BETWEEN, pair, self._between)
        image_type, image = message_encoding.encode_image(pair.camera)
        self._cdr(self._topic(BETWEEN_IMAGE), image_type, pair.stamp_ns, image, self._between)
        self._between += 1

    def finish(self) -> RecordedWindow:
        """Writes the index, syncs, and gives the file its final name.

        Raises:
            RecordingError: it could not be written; the `.part` file has been removed.
        """
        return RecordedWindow.of(self._file.finish(), self._window_id, self.pairs)

    def abandon(self) -> None:
        """Removes the `.part` file. May be called at any time before `finish`, and more than once."""
        self._file.abandon()

    def _sweep_and_motion(self, below: str, pair: FramePair, index: int) -> None:
        lidar, motion = pair.lidar, pair.motion
        points = message_encoding.encode_cloud(lidar)
        self._cdr(self._topic(below + POINTS), messages.POINT_CLOUD, lidar.stamp_ns, points, index)
        if motion is not None:
            motion_type, data = message_encoding.encode_motion(motion)
            name = below + (IMU if motion_type == messages.IMU else ODOMETRY)
            self._cdr(self._topic(name), motion_type, motion.stamp_ns, data, index)

    def _refuse_stamps_beyond_ros(self, pair: FramePair) -> None:
        try:
            for frame in (pair.camera, pair.lidar, pair.motion):
                if frame is not None:
                    check_stamp(frame.stamp_ns)
        except RecordingError:
            self.abandon()
            raise

    def _topic(self, name: str) -> str:
        return topic(self._rig.pair, name)

    def _cdr(self, topic_name: str, type_name: str, stamp_ns: int, data: bytes, index: int | None = None) -> None:
        """Adds a message of the pair with this index; None: of the pair that is being added."""
        sequence = self.pairs if index is None else index
        self._file.ros(RosChannel(topic_name, type_name), stamp_ns, sequence, data)


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
            picture = message_encoding.encode_jpeg(stamp_ns, result.camera_frame, overlay_jpeg)
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
    return message_encoding.encode_diagnostics(result.data_stamp_ns, [message_encoding.status_of_result(result)])


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
        storage.remove(part_path)
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
