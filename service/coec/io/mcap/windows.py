"""Windows, one MCAP file each (profile `ros2`, CDR): written so that a reader never sees half a file, read completely,
pair by pair, or only their result, rewritten with their result, and salvaged after the recorder was killed.

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

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, ValidationError

from coec.calibration.types import MOUNT_RAD, CameraFrame, EgoMotion, FramePair, LidarFrame, Matrix4, Rig, Window
from coec.config import CalibrationConfig, LimitsConfig, Matrix4x4, describe
from coec.errors import ConfigError, DecodeError, RecordingError, SourceError, WindowError
from coec.io import storage
from coec.io.mcap import reader
from coec.io.mcap import writer as mcap_writer
from coec.io.mcap.reader import Channel, McapAttachment, McapMessage, Metadata, Schema
from coec.io.rig_files import mask_to_png, matrix_rows, rig_from_json, rig_to_json, rigid_matrix
from coec.io.ros import message_decoding, message_encoding, messages
from coec.io.ros.point_clouds import WRITTEN_TIME
from coec.schemas.keys import DIAGNOSTICS, TF_STATIC
from coec.schemas.message import from_json, to_json
from coec.schemas.replies import CalibrationResult

SUFFIX = ".mcap"

RIG, CONFIGURATION, MASK, RESULT = "rig.json", "configuration.json", "mask.png", "result.json"
"""Attachments."""

JSON = "application/json"

METADATA, CARRIED_OVER = "coec", "coec_kept"
"""Metadata records: what the window is, and which other window it holds pairs of."""

IMAGE, COMPRESSED, DEPTH = "camera/image", "camera/image/compressed", "camera/depth/compressed"
POINTS, CAMERA_INFO, RESULT_TOPIC, OVERLAY = "lidar/points", "camera/camera_info", "result", "overlay"
ODOMETRY, IMU = "odometry", "imu"
"""Topics below `/coec/<pair>/`."""

BETWEEN = "between/"
"""Below it are the topics for sweep, ego-motion and image of the thinned pairs."""

BETWEEN_IMAGE = BETWEEN + "image/compressed"
"""The images of thinned pairs are compressed, whatever the camera sends."""


def topic(pair: str, name: str) -> str:
    """The full topic of a pair for one of these names."""
    return f"/coec/{pair}/{name}"


def is_between(topic: str) -> bool:
    """Whether a topic belongs to the thinned pairs. Only the fourth part counts, as a pair may have any name."""
    return topic.split("/")[3:4] == [BETWEEN.rstrip("/")]


class _RigAttachment(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    schema_version: int = 1
    window_id: str
    T_camera_lidar_start: Matrix4x4
    rig: dict[str, Any]


def encode_rig(rig: Rig, T_camera_lidar_start: Matrix4, window_id: str) -> bytes:
    """The attachment, without the rig's mask, which is a separate one."""
    start = matrix_rows(T_camera_lidar_start)
    return to_json(_RigAttachment(window_id=window_id, T_camera_lidar_start=start, rig=rig_to_json(rig)))


def decode_rig(path: Path, data: bytes, mask_png: bytes | None) -> tuple[Rig, Matrix4, str]:
    """Rig, extrinsic at the start (4, 4) and window id of the window at `path`.

    Raises:
        WindowError: the attachment is not valid.
    """
    try:
        document = _RigAttachment.model_validate_json(data)
        T_camera_lidar_start = rigid_matrix(document.T_camera_lidar_start, "T_camera_lidar_start")
        return rig_from_json(document.rig, mask_png), T_camera_lidar_start, document.window_id
    except ValidationError as error:
        raise WindowError(f"{path}: {RIG}: {describe(error)}") from error
    except (ConfigError, WindowError) as error:
        raise WindowError(f"{path}: {RIG}: {error}") from error


_LIMITS = LimitsConfig(max_message_bytes=2**30, max_image_pixels=2**30, max_points=2**30)
"""Wide limits, because the frames passed those of the recording daemon, which may be wider than the defaults. Their
bytes are in memory already, images are not decoded here, and `reading.MAX_UNPACKED` bounds the whole."""

_FRAME_TYPES = (messages.COMPRESSED_IMAGE, messages.IMAGE, messages.POINT_CLOUD, messages.ODOMETRY, messages.IMU)


class PairKey(NamedTuple):
    """The index of a pair in writing order: among the pairs of the window, or among the thinned pairs between them."""

    between: bool
    order: int


@dataclass(slots=True)
class _Parts:
    """The parts of one pair that have been read so far."""

    camera: CameraFrame | None = None
    lidar: LidarFrame | None = None
    motion: EgoMotion | None = None
    depth: CameraFrame | None = None


@dataclass(slots=True)
class WindowContent:
    """What has been read of a window so far.

    Attributes:
        attachments: by name.
        metadata: what the window is.
        carried_over: which other window it holds pairs of; empty: none.
    """

    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    carried_over: dict[str, str] = field(default_factory=dict)
    schemas: dict[int, reader.Schema] = field(default_factory=dict)
    channels: dict[int, reader.Channel] = field(default_factory=dict)
    parts: dict[PairKey, _Parts] = field(default_factory=dict)

    def add(self, record: reader.Record) -> PairKey | None:
        """Adds a record. Returns the place of the pair that it completes; None if it completes none."""
        match record:
            case reader.Schema():
                self.schemas[record.schema_id] = record
            case reader.Channel():
                self.channels[record.channel_id] = record
            case reader.McapAttachment():
                self.attachments[record.name] = record.data
            case reader.Metadata() if record.name == METADATA:
                self.metadata = record.values
            case reader.Metadata() if record.name == CARRIED_OVER:
                self.carried_over = record.values
            case reader.McapMessage():
                return self._add_message(record)
        return None

    def head(self, path: Path) -> tuple[Rig, Matrix4, str]:
        """Rig, extrinsic at the start and window id."""
        if RIG not in self.attachments:
            raise WindowError(f"{path} is not a recorded window: it has no attachment {RIG}")
        return decode_rig(path, self.attachments[RIG], self.attachments.get(MASK))

    def parsed_configuration(self, path: Path) -> CalibrationConfig:
        """The configuration of the window."""
        if CONFIGURATION not in self.attachments:
            raise WindowError(f"{path} is not a recorded window: it has no attachment {CONFIGURATION}")
        try:
            return CalibrationConfig.model_validate_json(self.attachments[CONFIGURATION])
        except ValidationError as error:
            raise WindowError(f"{path}: {CONFIGURATION}: {describe(error)}") from error

    def is_whole(self, key: PairKey, *, with_motion: bool) -> bool:
        """Whether the pair at a place has both its frames, and its motion."""
        parts = self.parts[key]
        return None not in (parts.camera, parts.lidar) and not (with_motion and parts.motion is None)

    def pair(self, path: Path, key: PairKey) -> FramePair:
        """Removes and returns the pair at a place."""
        parts = self.parts.pop(key)
        if parts.camera is None or parts.lidar is None:
            named = f"{'thinned ' if key.between else ''}pair {key.order}"
            raise WindowError(f"{path}: {named} lacks its {'sweep' if parts.lidar is None else 'image'}")
        camera = parts.camera
        if parts.depth is not None:
            camera = CameraFrame(camera.stamp_ns, camera.frame_id, camera.image, depth=parts.depth.image)
        return FramePair(camera, parts.lidar, parts.motion)

    def _add_message(self, message: reader.McapMessage) -> PairKey | None:
        channel = self.channels.get(message.channel_id)
        schema = None if channel is None else self.schemas.get(channel.schema_id)
        if channel is None or schema is None or schema.name not in _FRAME_TYPES:
            return None
        if channel.topic.endswith(f"/{OVERLAY}"):
            return None
        try:
            frame = message_decoding.decode(schema.name, message.data, _LIMITS, point_time=WRITTEN_TIME)
        except DecodeError as error:
            what = f"message {message.sequence} on {channel.topic} cannot be decoded"
            raise WindowError(f"{what}: {error}") from error
        key = PairKey(is_between(channel.topic), message.sequence)
        parts = self.parts.setdefault(key, _Parts())
        match frame:
            case LidarFrame():
                parts.lidar = frame
            case EgoMotion():
                parts.motion = frame
            case CameraFrame() if channel.topic.endswith(f"/{DEPTH}"):
                parts.depth = frame
            case CameraFrame():
                parts.camera = frame
                return key
        return None


# --- reading ----------------------------------------------------------------------------------------------------------

MAX_UNPACKED = 64
"""A window may unpack to at most this many times its size (plus `CHUNK_BYTES`). No tool compresses images and clouds to
a sixtieth."""


def read_window(
    path: Path, on_damaged: Callable[[object, WindowError], None] | None = None
) -> tuple[Window, CalibrationConfig]:
    """The window exactly as it was recorded, and the configuration that it was recorded for.

    Args:
        path: of the file.
        on_damaged: takes the place of each damaged record or message, and why it is left out with its pair; None: the
            first of them is raised.

    Raises:
        WindowError: unreadable, cut off, damaged, not a window of coec, or without a pair.
    """
    content, damaged = WindowContent(), False
    limit = _size(path) * MAX_UNPACKED + mcap_writer.CHUNK_BYTES
    for record in records_of(path, limit, skip_damaged=on_damaged is not None):
        try:
            if isinstance(record, reader.DamagedRecord):
                raise WindowError(f"{path}: {record.error}")
            content.add(record)
        except WindowError as error:
            if on_damaged is None:
                raise
            damaged = True
            on_damaged((record.chunk_at, record.at) if isinstance(record, McapMessage) else str(error), error)
    rig, T_camera_lidar_start, window_id = content.head(path)
    pairs: list[FramePair] = []
    between: list[FramePair] = []
    with_motion = damaged and any(parts.motion is not None for parts in content.parts.values())
    for key in sorted(content.parts):
        if not damaged or content.is_whole(key, with_motion=with_motion):
            (between if key.between else pairs).append(content.pair(path, key))
    if not pairs:
        raise WindowError(f"{path} holds no camera-LiDAR pair{' that is not damaged' if damaged else ''}")
    pairs.sort(key=lambda pair: pair.stamp_ns)
    between.sort(key=lambda pair: pair.stamp_ns)
    # The service began the window at the extrinsic in use, which is off by about `MOUNT_RAD`.
    window = Window(window_id, rig, T_camera_lidar_start, tuple(pairs), MOUNT_RAD, tuple(between))
    return window, content.parsed_configuration(path)


def pairs_since(path: Path, since_ns: int) -> Iterator[FramePair]:
    """The pairs of a window from a stamp on, in the order of the file; holds one at a time in memory.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    content = WindowContent()
    for record in records_of(path, max_unpacked_bytes=_size(path) * MAX_UNPACKED + mcap_writer.CHUNK_BYTES):
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
    with _failing_as_window_error(path):
        return reader.read_metadata(path, METADATA)


def is_window(path: Path) -> bool:
    """Whether a sound MCAP file is a window of coec. Does not read the frames.

    Raises:
        SourceError: unreadable, cut off or damaged, so that it cannot be decided.
    """
    try:
        return reader.read_attachment(path, RIG) is not None
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    except reader.McapDamagedError as error:
        raise SourceError(error.of(path)) from error


def records_of(
    path: Path, max_unpacked_bytes: int | None = None, *, skip_damaged: bool = False
) -> Iterator[reader.Record]:
    """The records of a window's file; those before an error are sound. `skip_damaged` as in `read_records`.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    with _failing_as_window_error(path), path.open("rb") as stream:
        yield from reader.read_records(stream, max_unpacked_bytes=max_unpacked_bytes, skip_damaged=skip_damaged)


@contextmanager
def _failing_as_window_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
    except reader.McapDamagedError as error:
        message = error.of(path)
        more = "; the daemon does so for its own at start" if error.is_mcap else ""
        raise WindowError(f"{message}{more}") from error


def _attachment(path: Path, name: str) -> bytes | None:
    with _failing_as_window_error(path):
        return reader.read_attachment(path, name)


def _size(path: Path) -> int:
    with _failing_as_window_error(path):
        return path.stat().st_size


# --- writing ----------------------------------------------------------------------------------------------------------


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
    def of(cls, file: mcap_writer.FinishedFile, window_id: str, pairs: int) -> RecordedWindow:
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
        self._file = mcap_writer.WholeFile(
            temporary or mcap_writer.with_suffix(path_final, mcap_writer.PART_SUFFIX), path_final, packed=packed
        )
        self._file.attach(RIG, JSON, encode_rig(rig, T_camera_lidar_start, window_id))
        self._file.attach(CONFIGURATION, JSON, to_json(configuration))
        if rig.mask is not None:
            self._file.attach(MASK, "image/png", mask_to_png(rig.mask))
        self._file.metadata(
            METADATA, {"window_id": window_id, mcap_writer.PACKING: mcap_writer.LZ4 if packed else "", **metadata}
        )
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
                    mcap_writer.check_stamp(frame.stamp_ns)
        except RecordingError:
            self.abandon()
            raise

    def _topic(self, name: str) -> str:
        return topic(self._rig.pair, name)

    def _cdr(self, topic_name: str, type_name: str, stamp_ns: int, data: bytes, index: int | None = None) -> None:
        """Adds a message of the pair with this index; None: of the pair that is being added."""
        sequence = self.pairs if index is None else index
        self._file.ros(mcap_writer.RosChannel(topic_name, type_name), stamp_ns, sequence, data)


def write_result(path: Path, result: CalibrationResult, overlay_jpeg: bytes | None = None) -> RecordedWindow:
    """Rewrites the window with its result (an earlier one is replaced): as `/diagnostics`, as JSON message and as
    attachment, plus a picture of the points at the result if there is one. The file is replaced atomically, so that a
    reader sees either version. The thinned pairs between those of the window stay only if the result says that the
    camera moved, because they determined when.

    Raises:
        WindowError: the window is damaged.
        RecordingError: it could not be written; then the file is unchanged.
    """
    packed = metadata_of(path).get(mcap_writer.PACKING) == mcap_writer.LZ4
    file = mcap_writer.WholeFile(mcap_writer.with_suffix(path, mcap_writer.REWRITE_SUFFIX), path, packed=packed)
    result_topic, overlay = topic(result.pair, RESULT_TOPIC), topic(result.pair, OVERLAY)
    try:
        earlier, moved = (DIAGNOSTICS, result_topic, overlay), result.moved is not None
        window_id, pairs = _copy(path, file, lambda topic: topic in earlier or (is_between(topic) and not moved))
        stamp_ns, document = result.data_stamp_ns, to_json(result)
        if overlay_jpeg is not None:
            picture = message_encoding.encode_jpeg(stamp_ns, result.camera_frame, overlay_jpeg)
            file.ros(mcap_writer.RosChannel(overlay, messages.COMPRESSED_IMAGE), stamp_ns, 0, picture)
        file.ros(mcap_writer.RosChannel(DIAGNOSTICS, messages.DIAGNOSTICS), stamp_ns, 0, _diagnostics(result))
        file.message(result_topic, "json", None, {}, stamp_ns, 0, document)
        file.attach(RESULT, JSON, document)
    except WindowError:
        file.abandon()
        raise
    return RecordedWindow.of(file.finish(), window_id, pairs)


def _copy(path: Path, file: mcap_writer.WholeFile, leave_out: Callable[[str], bool]) -> tuple[str, int]:
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
                file.copy(record, schemas, channel)
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
    final = part_path.with_name(part_path.name.removesuffix(mcap_writer.PART_SUFFIX))
    window = None if final.exists() else _salvaged(part_path, final, progress)
    with mcap_writer.failing_as_recording_error(final):
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
        packed=content.metadata.get(mcap_writer.PACKING) == mcap_writer.LZ4,
        temporary=mcap_writer.with_suffix(final, mcap_writer.REWRITE_SUFFIX),
    )
