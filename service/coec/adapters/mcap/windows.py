"""Windows on disk: one MCAP file each (profile `ros2`, CDR), written so that a reader never sees half a file.

Layout. First the attachments without which the rest means nothing (`rig.json`, `configuration.json`, `mask.png`), so
that whatever is cut off behind them can be salvaged. Then pair by pair the sweep, ego-motion, depth map, camera info
and image, each dated by its sensor and with the index of its pair as sequence number; the image comes last and
completes the pair. `write_result` adds `/diagnostics`, the result as a JSON channel and as attachment `result.json`.

A window may hold pairs of an earlier one that were kept for it. They come last, though they were taken first; the
metadata `coec_kept` name the window that they are from. A reader sorts pairs by their stamps.

The thinned pairs between those of the window have topics and indices of their own; of these the image comes last,
too. They are asked where the camera moved within the window: `write_result` leaves them out where it did not, which
more than halves what is kept of most windows.

The sender's own sequence numbers are not kept: the pairs of a window were chosen, so gaps between them mean nothing.
Chunks are not compressed: images are encoded already, clouds shrink by an eighth, lz4 costs a fifth of the throughput.
Equal pairs give equal bytes: nothing in the file tells when or where it was written.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from mcap.writer import CompressionType, Writer
from pydantic import BaseModel, ConfigDict, ValidationError

from coec import __version__
from coec.adapters.files import durable
from coec.adapters.files.rig import mask_to_png, matrix_rows, rig_from_json, rig_to_json, rigid_matrix
from coec.adapters.mcap.files import (
    Attachment,
    Channel,
    McapDamaged,
    Message,
    Metadata,
    Record,
    Schema,
    read_attachment,
    read_records,
)
from coec.adapters.ros import diagnostics, incoming, messages, outgoing
from coec.adapters.ros.point_cloud2 import WRITTEN_TIME
from coec.calibration.search.mount_prior import MOUNT_RAD
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame, Matrix4, Rig, Window
from coec.config import CalibrationConfig, LimitsConfig, Matrix4x4, describe
from coec.errors import ConfigError, DecodeError, RecordingError, SourceError, WindowError
from coec.schemas.base import from_json, to_json
from coec.schemas.replies import CalibrationResult
from coec.schemas.ros_names import DIAGNOSTICS, TF_STATIC

SUFFIX = ".mcap"
PART_SUFFIX = ".part"
"""Of a window that is being recorded; what is found at start can be salvaged."""

REWRITE_SUFFIX = ".tmp"
"""Of a finished window that is being written again; found at start it is of no use, the original is still there."""

RIG, CONFIGURATION, MASK, RESULT = "rig.json", "configuration.json", "mask.png", "result.json"

IMAGE, COMPRESSED, DEPTH = "camera/image", "camera/image/compressed", "camera/depth/compressed"
POINTS, CAMERA_INFO, RESULT_TOPIC = "lidar/points", "camera/camera_info", "result"
ODOMETRY, IMU = "odometry", "imu"
"""Topics below `/coec/<pair>/`."""

BETWEEN = "between/"
"""Below it the sweep, ego-motion and image of the thinned pairs, as above."""

BETWEEN_IMAGE = BETWEEN + "image/compressed"
"""Their images are compressed, whatever the camera sends."""


CHUNK_BYTES = 64 * 1024
"""A chunk is closed at the first message past this size, so that a killed recorder loses a pair at most."""

MAX_UNPACKED = 64
"""A window unpacks to at most this many times its size (plus `CHUNK_BYTES`). Ours are not compressed, other tools may
recompress them; images and clouds do not shrink to a sixtieth."""

MAX_STAMP_NS = 2**31 * 1_000_000_000
"""ROS 2 time has signed 32-bit seconds."""

_LIMITS = LimitsConfig(max_message_bytes=2**30, max_image_pixels=2**30, max_points=2**30)
"""The frames passed the limits of the recording daemon, which may be wider than the defaults. Their bytes are in memory
when they are looked at, images are not decoded here, and `MAX_UNPACKED` bounds the whole."""


class _RigAttachment(BaseModel):
    """`rig.json`: the rig, and with it what else belongs to the window but is no message."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    schema_version: int = 1
    window_id: str
    T_camera_lidar_start: Matrix4x4
    rig: dict[str, Any]


@dataclass(frozen=True, slots=True)
class RecordedWindow:
    """A finished file. `sha256` is hexadecimal and of the whole file, `pairs` their number. `bytes` and `modified_ns`
    (what the file system says of the last write) tell this version of the file from a later one."""

    path: Path
    window_id: str
    pairs: int
    bytes: int
    modified_ns: int
    sha256: str


# --- writing ------------------------------------------------------------------------------------------------


class _HashingFile(io.BufferedWriter):
    """Hashes what passes: the library only ever appends."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path, "wb"))
        self.sha256 = hashlib.sha256()

    def write(self, data: Any, /) -> int:
        """Hash and write."""
        self.sha256.update(data)
        return super().write(data)


class _WindowFile:
    """An MCAP file that appears under its final name when it is complete and on the disk, or not at all."""

    def __init__(self, temporary: Path, final: Path) -> None:
        self._temporary, self._final = temporary, final
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[str, int] = {}
        with _failing_as_recording_error(final):
            self._file = _HashingFile(temporary)
        with self._guarded():
            durable.sync_folder(temporary.parent)
            # The CRC over the data section also covers what lies outside the chunks.
            self._mcap = Writer(self._file, CHUNK_BYTES, CompressionType.NONE, enable_crcs=True, enable_data_crcs=True)
            self._mcap.start(profile="ros2", library=f"coec/{__version__}")

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Adds an attachment, dated 0: it belongs to no instant."""
        with self._guarded():
            self._mcap.add_attachment(0, 0, name, media_type, data)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds a metadata record."""
        with self._guarded():
            self._mcap.add_metadata(name, dict(values))

    def message(
        self, topic: str, schema: Schema | None, encoding: str, stamp_ns: int, sequence: int, data: bytes
    ) -> None:
        """Adds a message; channel and schema are registered at their first use, under an id of this file."""
        with self._guarded():
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._mcap.register_channel(topic, encoding, self._schema_id(schema))
                self._channels[topic] = channel
            self._mcap.add_message(channel, stamp_ns, data, stamp_ns, sequence)

    def sync(self) -> None:
        """Puts what was added on the disk: a little at a time, so that the end of a window does not wait for it all."""
        with self._guarded():
            self._file.flush()
            os.fdatasync(self._file.fileno())

    def finish(self, window_id: str, pairs: int) -> RecordedWindow:
        """Writes the index, and makes file and name durable."""
        with self._guarded():
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            status = os.fstat(self._file.fileno())
            durable.publish(self._file, self._temporary, self._final)
        sha256 = self._file.sha256.hexdigest()
        return RecordedWindow(self._final, window_id, pairs, status.st_size, status.st_mtime_ns, sha256)

    def abandon(self) -> None:
        """Removes the temporary file."""
        with suppress(OSError):  # closing flushes, which fails again on a full disk
            self._file.close()
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    def _schema_id(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        key = (schema.name, schema.encoding, schema.data)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(*key)
        return self._schemas[key]

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        with _failing_as_recording_error(self._final):
            try:
                yield
            except BaseException:
                self.abandon()
                raise


class WindowWriter:
    """Records one window, pair by pair. After a `RecordingError` the file is gone and the writer of no more use."""

    def __init__(
        self,
        path_final: Path,
        rig: Rig,
        T_camera_lidar_start: Matrix4,
        window_id: str,
        configuration: CalibrationConfig,
        metadata: Mapping[str, str],
        *,
        temporary: Path | None = None,
    ) -> None:
        """Opens `<path_final>.part` (or `temporary`) and writes what must not be lost.

        Args:
            path_final: `<folder>/<window_id>.mcap`, the name after `finish`; a file of that name is replaced.
            rig: of the pair.
            T_camera_lidar_start: (4, 4) extrinsic that is current now, where the search will start.
            window_id: of the window.
            configuration: with which the window will be calibrated.
            metadata: what else a reader may want to know, for example `vehicle`. It becomes part of the bytes.

        Raises:
            RecordingError: the file cannot be written.
        """
        self.pairs = 0
        self._between = 0
        self._rig, self._T_start, self._window_id = rig, T_camera_lidar_start, window_id
        self._file = _WindowFile(temporary or _beside(path_final, PART_SUFFIX), path_final)
        document = _RigAttachment(
            window_id=window_id, T_camera_lidar_start=matrix_rows(T_camera_lidar_start), rig=rig_to_json(rig)
        )
        self._file.attach(RIG, _JSON, to_json(document))
        self._file.attach(CONFIGURATION, _JSON, to_json(configuration))
        if rig.mask is not None:
            self._file.attach(MASK, "image/png", mask_to_png(rig.mask))
        self._file.metadata(_METADATA, {"window_id": window_id, **metadata})
        self._file.sync()

    def note_kept(self, from_window_id: str, since_ns: int) -> None:
        """The pairs that are added from now on are those of another window from a stamp on.

        Raises:
            RecordingError: it could not be written; the `.part` file has been removed.
        """
        self.note_of_kept({"from_window": from_window_id, "since_ns": str(since_ns)})

    def note_of_kept(self, values: Mapping[str, str]) -> None:
        """The same, in the words that were found in another file."""
        self._file.metadata(_KEPT, values)

    def add(self, pair: FramePair) -> None:
        """Appends a pair.

        Raises:
            RecordingError: it could not be written (disk full, or a stamp beyond ROS time); the `.part` file has been
                removed.
        """
        stamp_ns = pair.stamp_ns
        self._refuse_stamps_beyond_ros(pair)
        if self.pairs == 0:
            self._cdr(TF_STATIC, messages.TF, stamp_ns, outgoing.encode_tf_static(self._rig, self._T_start, stamp_ns))
        self._sweep_and_motion("", pair, self.pairs)
        if pair.camera.depth is not None:
            depth = outgoing.encode_depth(stamp_ns, pair.camera.frame_id, pair.camera.depth)
            self._cdr(self._topic(DEPTH), messages.COMPRESSED_IMAGE, stamp_ns, depth)
        info = outgoing.encode_camera_info(self._rig, stamp_ns)
        self._cdr(self._topic(CAMERA_INFO), messages.CAMERA_INFO, stamp_ns, info)
        image_type, image = outgoing.encode_image(pair.camera)
        topic = self._topic(IMAGE if image_type == messages.IMAGE else COMPRESSED)
        self._cdr(topic, image_type, stamp_ns, image)
        self._file.sync()
        self.pairs += 1

    def add_between(self, pair: FramePair) -> None:
        """Appends a thinned pair, whose image is compressed. It is on the disk with the next one of the window.

        Raises:
            RecordingError: as for `add`.
        """
        self._refuse_stamps_beyond_ros(pair)
        self._sweep_and_motion(BETWEEN, pair, self._between)
        image_type, image = outgoing.encode_image(pair.camera)
        self._cdr(self._topic(BETWEEN_IMAGE), image_type, pair.stamp_ns, image, self._between)
        self._between += 1

    def finish(self) -> RecordedWindow:
        """Writes the index, syncs, and gives the file its final name.

        Raises:
            RecordingError: it could not be written; the `.part` file has been removed.
        """
        return self._file.finish(self._window_id, self.pairs)

    def abandon(self) -> None:
        """Removes the `.part` file. May be called at any time before `finish`, and more than once."""
        self._file.abandon()

    def _sweep_and_motion(self, below: str, pair: FramePair, index: int) -> None:
        lidar, motion = pair.lidar, pair.motion
        points = outgoing.encode_cloud(lidar)
        self._cdr(self._topic(below + POINTS), messages.POINT_CLOUD, lidar.stamp_ns, points, index)
        if motion is not None:
            motion_type, data = outgoing.encode_motion(motion)
            name = below + (IMU if motion_type == messages.IMU else ODOMETRY)
            self._cdr(self._topic(name), motion_type, motion.stamp_ns, data, index)

    def _refuse_stamps_beyond_ros(self, pair: FramePair) -> None:
        for frame in (pair.camera, pair.lidar, pair.motion):
            if frame is not None and not 0 <= frame.stamp_ns < MAX_STAMP_NS:
                self.abandon()
                raise RecordingError(f"stamp {frame.stamp_ns} ns does not fit the 32-bit seconds of ROS 2")

    def _topic(self, name: str) -> str:
        return _topic(self._rig.pair, name)

    def _cdr(self, topic: str, type_name: str, stamp_ns: int, data: bytes, index: int | None = None) -> None:
        """A message of the pair of this index, or of the one that is being added."""
        sequence = self.pairs if index is None else index
        self._file.message(topic, _ros_schema(type_name), "cdr", stamp_ns, sequence, data)


def write_result(path: Path, result: CalibrationResult) -> RecordedWindow:
    """Writes the window again with its result (an earlier one is replaced): as `/diagnostics`, JSON message and
    attachment. The file is replaced at once; a reader sees the one or the other. The pairs between those of the window
    stay where the result says that the camera moved, as it took its time from them.

    Raises:
        WindowError: the window is damaged.
        RecordingError: it could not be written; the file is as it was.
    """
    file = _WindowFile(_beside(path, REWRITE_SUFFIX), path)
    try:
        earlier = (DIAGNOSTICS, _topic(result.pair, RESULT_TOPIC))
        moved = result.moved is not None
        window_id, pairs = _copy(path, file, lambda topic: topic in earlier or (_is_between(topic) and not moved))
        stamp_ns, document = result.data_stamp_ns, to_json(result)
        file.message(DIAGNOSTICS, _ros_schema(messages.DIAGNOSTICS), "cdr", stamp_ns, 0, _diagnostics(result))
        file.message(_topic(result.pair, RESULT_TOPIC), None, "json", stamp_ns, 0, document)
        file.attach(RESULT, _JSON, document)
    except WindowError:
        file.abandon()
        raise
    return file.finish(window_id, pairs)


def salvage(part_path: Path, progress: Callable[[], None]) -> RecordedWindow | None:
    """Makes a window of what a killed recorder left behind, and removes the `.part` file.

    Args:
        part_path: the `.part` file.
        progress: called after every pair.

    Returns:
        The window with every pair that is whole, or None when there was none or the rig is lost (or when the window was
        finished after all).

    Raises:
        RecordingError: it could not be written; the `.part` file is still there.
    """
    final = part_path.with_name(part_path.name.removesuffix(PART_SUFFIX))
    window = None if final.exists() else _salvaged(part_path, final, progress)
    with _failing_as_recording_error(final):
        durable.remove(part_path)
    return window


# --- reading ------------------------------------------------------------------------------------------------


def read_window(path: Path) -> tuple[Window, CalibrationConfig]:
    """The window exactly as it was recorded, and the configuration it was recorded for.

    Raises:
        WindowError: unreadable, cut off, damaged, not a window of ours, or without a pair.
    """
    content = _Content()
    size = _size(path)
    for record in _records(path, max_unpacked_bytes=size * MAX_UNPACKED + CHUNK_BYTES):
        content.take(record)
    rig, T_camera_lidar_start, window_id = content.head(path)
    places = sorted(content.parts)
    pairs, between = (
        tuple(sorted((content.pair(path, of) for of in places if of.between == asked), key=lambda pair: pair.stamp_ns))
        for asked in (False, True)
    )
    if not pairs:
        raise WindowError(f"{path} holds no camera-LiDAR pair")
    # The service began it at the extrinsic in use.
    window = Window(window_id, rig, T_camera_lidar_start, pairs, MOUNT_RAD, between)
    return window, content.parsed_configuration(path)


def pairs_since(path: Path, since_ns: int) -> Iterator[FramePair]:
    """The pairs of a window from a stamp on, in the order in which they are in its file, one at a time in memory.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    content = _Content()
    for record in _records(path, max_unpacked_bytes=_size(path) * MAX_UNPACKED + CHUNK_BYTES):
        place = content.take(record)
        if place is None:
            continue
        pair = content.pair(path, place)
        if pair.stamp_ns >= since_ns and not place.between:
            yield pair


def read_result(path: Path) -> CalibrationResult | None:
    """The result that was written into a window, None when it has none. Does not read the frames.

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
    """The vehicle that recorded a window, empty where the window does not say. Does not read the frames.

    Raises:
        WindowError: unreadable or damaged at its beginning.
    """
    for record in _records(path):
        match record:
            case Metadata() if record.name == _METADATA:
                return record.values.get("vehicle", "")
            case Message():
                break
    return ""


def is_window(path: Path) -> bool:
    """Whether a sound MCAP file is a window of ours. Does not read the frames.

    Raises:
        SourceError: unreadable, cut off or damaged, so that nobody can tell.
    """
    try:
        return read_attachment(path, RIG) is not None
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    except McapDamaged as error:
        raise SourceError(error.of(path)) from error


class _Place(NamedTuple):
    """Of a pair in the order in which we write: among those of the window, or among those between."""

    between: bool
    order: int


@dataclass(slots=True)
class _Parts:
    """What has been seen of one pair."""

    camera: CameraFrame | None = None
    lidar: LidarFrame | None = None
    motion: EgoMotion | None = None
    depth: CameraFrame | None = None


@dataclass(slots=True)
class _Content:
    """What has been read of a window so far."""

    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    kept: dict[str, str] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    parts: dict[_Place, _Parts] = field(default_factory=dict)

    def take(self, record: Record) -> _Place | None:
        """Adds a record. Returns the place of the pair that it completes, else None."""
        match record:
            case Schema():
                self.schemas[record.schema_id] = record
            case Channel():
                self.channels[record.channel_id] = record
            case Attachment():
                self.attachments[record.name] = record.data
            case Metadata() if record.name == _METADATA:
                self.metadata = record.values
            case Metadata() if record.name == _KEPT:
                self.kept = record.values
            case Message():
                return self._take_message(record)
        return None

    def head(self, path: Path) -> tuple[Rig, Matrix4, str]:
        """Rig, extrinsic at the start and window id."""
        if RIG not in self.attachments:
            raise WindowError(f"{path} is not a recorded window: it has no attachment {RIG}")
        try:
            document = _RigAttachment.model_validate_json(self.attachments[RIG])
            T_camera_lidar_start = rigid_matrix(document.T_camera_lidar_start, "T_camera_lidar_start")
            return rig_from_json(document.rig, self.attachments.get(MASK)), T_camera_lidar_start, document.window_id
        except ValidationError as error:
            raise WindowError(f"{path}: {RIG}: {describe(error)}") from error
        except (ConfigError, WindowError) as error:
            raise WindowError(f"{path}: {RIG}: {error}") from error

    def parsed_configuration(self, path: Path) -> CalibrationConfig:
        """The configuration of the window."""
        if CONFIGURATION not in self.attachments:
            raise WindowError(f"{path} is not a recorded window: it has no attachment {CONFIGURATION}")
        try:
            return CalibrationConfig.model_validate_json(self.attachments[CONFIGURATION])
        except ValidationError as error:
            raise WindowError(f"{path}: {CONFIGURATION}: {describe(error)}") from error

    def pair(self, path: Path, place: _Place) -> FramePair:
        """Takes out the pair of this place."""
        parts = self.parts.pop(place)
        if parts.camera is None or parts.lidar is None:
            named = f"{'thinned ' if place.between else ''}pair {place.order}"
            raise WindowError(f"{path}: {named} lacks its {'sweep' if parts.lidar is None else 'image'}")
        camera = parts.camera
        if parts.depth is not None:
            camera = CameraFrame(camera.stamp_ns, camera.frame_id, camera.image, depth=parts.depth.image)
        return FramePair(camera, parts.lidar, parts.motion)

    def _take_message(self, message: Message) -> _Place | None:
        channel = self.channels.get(message.channel_id)
        schema = None if channel is None else self.schemas.get(channel.schema_id)
        if channel is None or schema is None or schema.name not in _FRAME_TYPES:
            return None
        try:
            frame = incoming.decode(schema.name, message.data, _LIMITS, point_time=WRITTEN_TIME)
        except DecodeError as error:
            raise WindowError(f"a message on {channel.topic} cannot be decoded: {error}") from error
        place = _Place(_is_between(channel.topic), message.sequence)
        parts = self.parts.setdefault(place, _Parts())
        match frame:
            case LidarFrame():
                parts.lidar = frame
            case EgoMotion():
                parts.motion = frame
            case CameraFrame() if channel.topic.endswith(f"/{DEPTH}"):
                parts.depth = frame
            case CameraFrame():
                parts.camera = frame
                return place
        return None


def _salvaged(part_path: Path, final: Path, progress: Callable[[], None]) -> RecordedWindow | None:
    content = _Content()
    writer: WindowWriter | None = None
    try:
        # The error that ends the file also ends the loop; whatever came before it was sound.
        with suppress(WindowError):
            for record in _records(part_path):
                place = content.take(record)
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
    if content.kept:
        writer.note_of_kept(content.kept)
    return writer.finish()


def _writer_like(content: _Content, part_path: Path, final: Path) -> WindowWriter:
    rig, T_camera_lidar_start, window_id = content.head(part_path)
    configuration = content.parsed_configuration(part_path)
    temporary = _beside(final, REWRITE_SUFFIX)
    return WindowWriter(
        final, rig, T_camera_lidar_start, window_id, configuration, content.metadata, temporary=temporary
    )


def _copy(path: Path, file: _WindowFile, leave_out: Callable[[str], bool]) -> tuple[str, int]:
    """Copies a window record by record, without some topics and the result; returns its id and number of pairs."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    window_id, pairs = path.name.removesuffix(SUFFIX), 0
    for record in _records(path):
        match record:
            case Schema():
                schemas[record.schema_id] = record
            case Channel():
                channels[record.channel_id] = record
            case Attachment() if record.name != RESULT:
                file.attach(record.name, record.media_type, record.data)
            case Metadata():
                file.metadata(record.name, record.values)
                window_id = record.values.get("window_id", window_id)
            case Message():
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise WindowError(f"{path}: a message belongs to no channel")
                if leave_out(channel.topic):
                    continue
                file.message(
                    channel.topic,
                    schemas.get(channel.schema_id),
                    channel.message_encoding,
                    record.log_time_ns,
                    record.sequence,
                    record.data,
                )
                pairs += channel.topic.endswith((f"/{IMAGE}", f"/{COMPRESSED}"))
    return window_id, pairs


def _records(path: Path, max_unpacked_bytes: int | None = None) -> Iterator[Record]:
    try:
        with path.open("rb") as stream:
            yield from read_records(stream, max_unpacked_bytes=max_unpacked_bytes)
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
    except McapDamaged as error:
        raise WindowError(_damage(path, error)) from error


def _attachment(path: Path, name: str) -> bytes | None:
    try:
        return read_attachment(path, name)
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
    except McapDamaged as error:
        raise WindowError(_damage(path, error)) from error


def _damage(path: Path, error: McapDamaged) -> str:
    return f"{error.of(path)}; the daemon does so for its own at start"


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error


# --- small things -------------------------------------------------------------------------------------------

_JSON = "application/json"
_METADATA = "coec"
_KEPT = "coec_kept"
_FRAME_TYPES = (messages.COMPRESSED_IMAGE, messages.IMAGE, messages.POINT_CLOUD, messages.ODOMETRY, messages.IMU)


def _topic(pair: str, name: str) -> str:
    return f"/coec/{pair}/{name}"


def _is_between(topic: str) -> bool:
    """A pair may have any name."""
    return topic.split("/")[3:4] == [BETWEEN.rstrip("/")]


@lru_cache(maxsize=16)
def _ros_schema(type_name: str) -> Schema:
    return Schema(0, type_name, "ros2msg", messages.definition(type_name).encode())


def _diagnostics(result: CalibrationResult) -> bytes:
    """The verdict with its figures, as ROS tools show it."""
    return outgoing.encode_diagnostics(result.data_stamp_ns, [diagnostics.of_result(result)])


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


@contextmanager
def _failing_as_recording_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror}; free space or choose another directory"
        ) from error
